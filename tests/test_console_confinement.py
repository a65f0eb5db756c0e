"""The console touches nothing outside its folder."""

from __future__ import annotations

import json
import shutil
import threading
import time
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from tiny_clips import put_clip

from paceline.console import document_references
from paceline.console.confinement import NotFound, check_document, file_below, folder_below, named_files
from paceline.console.frames import uploads
from paceline.console.library import ClipContents, Library
from paceline.console.routes import decode_clip, result_address
from paceline.errors import UnusableInput

CLIMBING = [
    "../secret", "road/../../secret", "/etc", "//etc", "", "..", "...", ".hidden", "road/", "./road", "road/.",
    "road\\..\\..\\secret", "road\0", "r" * 5000, "road\n",
]  # fmt: skip


@pytest.mark.parametrize("name", CLIMBING)
def test_names_with_parent_folders_are_not_found(folder: Path, client: TestClient, name: str) -> None:
    with pytest.raises(NotFound):
        folder_below(folder, name)
    with pytest.raises(NotFound):
        file_below(folder, name)
    if "\0" not in name:
        for address in ("/api/setup", "/api/thumbnail", "/api/run?number=1"):
            answer = client.get(address, params={"clip": name, "number": 1})
            assert answer.status_code == 404 and "secret" not in answer.text.replace(name, "")


def test_links_are_not_followed(folder: Path, client: TestClient) -> None:
    link = folder / "linked"
    link.symlink_to(folder.parent / "secret")
    try:
        assert client.get("/api/setup", params={"clip": "linked"}).status_code == 404
    finally:
        link.unlink()
    road = folder / "road"
    (road / "runs" / "0001").mkdir(parents=True)
    (road / "runs" / "0001" / "run.json").symlink_to(folder.parent / "secret" / "secret.txt")
    assert client.get("/api/run", params={"clip": "road", "number": 1}).status_code == 404
    (road / "runs" / "0001" / "run.json").unlink()
    (road / "runs" / "0001").rmdir()
    (road / "runs").rmdir()


@pytest.mark.parametrize("address", ["Li4vc2VjcmV0", "L2V0Yw", "%%%", "_w"])
def test_results_of_other_folders_are_not_given(client: TestClient, address: str) -> None:
    for name in ("report.html", "..%2F..%2Fsecret.txt", "secret.txt", "run.json"):
        assert client.get(f"/results/{address}/1/{name}").status_code == 404


def test_only_pictures_of_vehicles_are_given_from_folders_of_a_run(folder: Path, client: TestClient) -> None:
    run = folder / "road" / "runs" / "0001"
    record = {"clip": "road", "number": 1, "kind": "speed", "options": [], "state": "measured", "created": 1.0}
    for place in ("pictures", "outlines", "plots"):
        (run / "out" / place).mkdir(parents=True)
        (run / "out" / place / "v0.jpg").write_bytes(b"picture")
    (run / "run.json").write_text(json.dumps(record))
    try:
        for place, status in (("pictures", 200), ("outlines", 200), ("plots", 404), ("..", 404), ("..%2Fout", 404)):
            address = result_address("road", 1, f"{place}/v0.jpg")
            assert client.get(address).status_code == status, address
    finally:
        shutil.rmtree(folder / "road" / "runs")


def test_a_lane_centre_that_is_no_number_is_refused(folder: Path, client: TestClient) -> None:
    for offset in ("1", [], 1e300, True):
        path = {"shape": "line", "left": [], "right": [], "lateral_offset": offset}
        answer = client.post("/api/check", params={"clip": "road"}, json={"paths": {"a": path}, "vehicles": []})
        assert answer.status_code == 422 and "expected a number" in answer.json()["reason"]


@pytest.mark.parametrize("name", [".", "a/b", "Strasse – Süd", "100%?#"])
def test_addresses_of_results_keep_every_name(name: str) -> None:
    assert decode_clip(result_address(name, 3, "report.html").split("/")[2]) == name


@pytest.mark.parametrize(
    ("key", "value"),
    [("left", "../../secret/left"), ("rig", "../../secret/rig.yaml"), ("right", "/etc/hostname"),
     ("left", "../../secret/left/*.png"), ("times", "/etc/passwd"), ("left", "link"), ("left", "images"),
     ("rig", "link.yaml")],
)  # fmt: skip
def test_a_clip_that_names_files_outside_is_refused(tmp_path: Path, key: str, value: str) -> None:
    root = tmp_path.resolve() / "mine"
    secret = put_clip(root.parent, "secret")
    clip = put_clip(root)
    (clip / "link").symlink_to(secret / "left")
    (clip / "link.yaml").symlink_to(secret / "rig.yaml")
    (clip / "images").mkdir()
    for image in (secret / "left").iterdir():
        (clip / "images" / image.name).symlink_to(image)
    file = clip / "clip.yaml"
    lines = [line for line in file.read_text().splitlines() if not line.startswith(f"{key}:")]
    if key == "times":
        lines = [line for line in lines if not line.startswith("rate:")]
    file.write_text("\n".join([*lines, f"{key}: {value}"]) + "\n")
    with pytest.raises(UnusableInput, match=f"{key}: leads out of"):
        check_document(root, file)


@pytest.mark.parametrize("value", ['"a\\0b"', "x" * 5000, "loop"])
def test_one_clip_that_names_no_file_leaves_the_others_shown(tmp_path: Path, value: str) -> None:
    root = tmp_path.resolve()
    put_clip(root)
    clip = put_clip(root, "odd")
    (clip / "loop").symlink_to(clip / "loop")
    text = (clip / "clip.yaml").read_text().replace("left: left\n", f"left: {value}\n")
    (clip / "clip.yaml").write_text(text)
    library = Library(root)
    shown = {name: library.entry(name) for name in library.names()}
    library.runs.close()
    assert shown["road"].state == "ready" and shown["odd"].state == "unreadable"
    assert "left: " in shown["odd"].reason and "cannot be read" in shown["odd"].reason


def test_a_clip_inside_the_folder_is_allowed(folder: Path) -> None:
    check_document(folder, folder / "road" / "clip.yaml")


def test_a_playlist_is_no_video(tmp_path: Path, folder: Path) -> None:
    """Decoders open what a playlist names; the file need not even look like one."""
    root = tmp_path.resolve()
    secret = folder.parent / "secret" / "left" / "0000.png"
    (root / "left.m3u8").write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n")
    (root / "right.mp4").write_text(f"ffconcat version 1.0\nfile {secret}\n")
    (root / "clip.yaml").write_text("left: left.m3u8\nright: right.mp4\nrig: rig.yaml\n")
    for video in ("left.m3u8", "right.mp4"):
        with pytest.raises(UnusableInput, match="cannot be read as a video"):
            uploads.check_container(root / video)
    with pytest.raises(UnusableInput, match="cannot be read as a video"):
        check_document(root, root / "clip.yaml")


def test_a_document_is_parsed_once_for_all_questions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path.resolve()
    file = put_clip(root) / "clip.yaml"
    parsed: list[Path] = []
    read = document_references.read_document
    monkeypatch.setattr(
        document_references, "read_document", lambda model, path: parsed.append(path) or read(model, path)
    )
    for _ in range(3):
        check_document(root, file)
        named_files(root, file)
        document_references.live_views(file)
    assert parsed == [file]
    file.write_text("left: [")  # and once for what is wrong with it
    for _ in range(3):
        with pytest.raises(UnusableInput, match="line 2, column 1"):
            check_document(root, file)
    assert parsed == [file, file]


def test_the_list_does_not_wait_for_a_slow_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    root = tmp_path.resolve()
    for name in ("fine", "slow"):
        put_clip(root, name)
    may_go_on = threading.Event()
    examine = Library._examine

    def slowly(library: Library, file: Path) -> ClipContents:
        if file.parent.name == "slow":
            may_go_on.wait(60)
        return examine(library, file)

    monkeypatch.setattr(Library, "_examine", slowly)
    library = Library(root)
    for _ in range(2):
        slow, fine = library.entry("slow", 0.1), library.entry("fine", 30)
        assert (slow.state, fine.state) == ("being read", "ready") and not slow.contents.pictures
    may_go_on.set()
    assert library.entry("slow").state == library.entry("slow", 0).state == "ready"
    library.runs.close()


def test_a_document_above_the_bound_is_refused_unread(tmp_path: Path) -> None:
    root = tmp_path.resolve()
    file = put_clip(root) / "clip.yaml"
    text = file.read_bytes() + b"\n#"
    file.write_bytes(text.ljust(document_references.MAX_DOCUMENT_BYTES, b"x"))
    check_document(root, file)
    file.write_bytes(text.ljust(document_references.MAX_DOCUMENT_BYTES + 1, b"x"))
    with pytest.raises(UnusableInput, match="clip.yaml: is larger than 512 KiB; no such file needs to be"):
        check_document(root, file)


@pytest.mark.parametrize("name", ["clip.yaml", "rig.yaml"])
def test_a_huge_document_does_not_keep_the_others_waiting(tmp_path: Path, name: str) -> None:
    root = tmp_path.resolve()
    put_clip(root, "fine")
    document = put_clip(root, "huge") / name
    with document.open("a") as stream:
        stream.write("# " + 30 * (1 << 20) * "x")
    library = Library(root)
    began = time.process_time()
    entries = {clip: library.entry(clip) for clip in library.names()}
    assert time.process_time() - began < 5  # s; to read it takes forty
    library.runs.close()
    assert entries["fine"].state == "ready"
    assert entries["huge"].state == "unreadable" and f"huge/{name}: is larger than" in entries["huge"].reason
