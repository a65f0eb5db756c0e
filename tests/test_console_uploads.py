"""What browsers send to the console: recordings, set-ups, settings; bounded, checked, refused in one line."""

from __future__ import annotations

import io
import json
import signal
import socket
import time
import urllib.request
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from console_client import SAME
from console_served import serving
from fastapi.testclient import TestClient
from tiny_clips import put_clip

from paceline.console.confinement import check_name
from paceline.console.frames import uploads
from paceline.console.frames.uploads import Uploads
from paceline.errors import UnusableInput


def begin(client: TestClient, name: str = "new") -> str:
    answer = client.post("/api/import", json={"name": name}, headers=SAME)
    assert answer.status_code == 200, answer.text
    return str(answer.json()["key"])


def send(client: TestClient, key: str, slot: str, name: str, content: bytes) -> Any:
    return client.put(f"/api/import/{key}/{slot}", params={"name": name}, content=content, headers=SAME)


def images(folder: Path, side: str) -> list[tuple[str, bytes]]:
    return [(p.name, p.read_bytes()) for p in sorted((folder / "road" / side).iterdir())]


def zipped(files: list[tuple[str, bytes]]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files:
            archive.writestr(name, content)
    return buffer.getvalue()


def test_a_clip_is_imported_from_images_and_a_zip(folder: Path, client: TestClient) -> None:
    key = begin(client, "Main road, north")
    for name, content in images(folder, "left"):
        assert send(client, key, "left", f"recording/{name}", content).status_code == 200
    members = [(f"a/../../../{name}", content) for name, content in images(folder, "right")]
    archive = zipped([*members, ("__MACOSX/._x.png", b""), ("x.sh", b"")])
    assert send(client, key, "right", "r.zip", archive).status_code == 200
    assert send(client, key, "rig", "any.yaml", (folder / "road" / "rig.yaml").read_bytes()).status_code == 200
    assert client.post(f"/api/import/{key}", json={}, headers=SAME).status_code == 422  # images need a rate
    done = client.post(f"/api/import/{key}", json={"rate": 5}, headers=SAME)
    assert done.json() == {"name": "Main road, north"}
    new = folder / "Main road, north"
    assert sorted(p.name for p in new.iterdir()) == ["clip.yaml", "left", "rig.yaml", "right"]
    assert images(folder, "right") == [(p.name, p.read_bytes()) for p in sorted((new / "right").iterdir())]
    assert client.get("/api/setup", params={"clip": "Main road, north"}).json()["frames"] == list(range(5))
    assert client.post("/api/import", json={"name": "Main road, north"}, headers=SAME).status_code == 422
    for path in sorted(new.rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    new.rmdir()


@pytest.mark.parametrize("name", ["", "..", "../x", "a/b", "a\\b", ".x", "x" * 81, "a\0b", "C:x", " x"])
def test_names_that_a_clip_may_not_have(folder: Path, client: TestClient, name: str) -> None:
    assert client.post("/api/import", json={"name": name}, headers=SAME).status_code == 422
    with pytest.raises(UnusableInput):
        check_name(name)
    assert sorted(p.name for p in folder.iterdir()) == ["road"]


@pytest.mark.parametrize(
    ("slot", "name", "content", "words"),
    [
        ("left", "x.exe", b"MZ", "is no video, zip or image"),
        ("rig", "x.png", b"", "is no rig.yaml"),
        ("up", "x.png", b"", "is no video"),
        ("rig", "rig.yaml", b"x" * (1 << 20 | 1), "larger than 1 MiB"),
    ],
)
def test_a_file_that_is_no_recording_is_refused(
    folder: Path, client: TestClient, slot: str, name: str, content: bytes, words: str
) -> None:
    key = begin(client)
    answer = send(client, key, slot, name, content)
    assert answer.status_code == 422 and words in answer.json()["reason"]
    assert client.request("DELETE", f"/api/import/{key}", headers=SAME).status_code == 200
    assert sorted(p.name for p in folder.iterdir()) == ["road"]


def test_uploads_are_bounded(folder: Path, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both by what the browser announces and by what really comes; a zip by what it really holds."""
    monkeypatch.setattr(uploads, "MAX_RECORDING_BYTES", 3 << 20)
    key = begin(client)
    pieces = (b"x" * (1 << 20) for _ in range(64))
    endless = client.put(f"/api/import/{key}/left", params={"name": "a.mp4"}, content=pieces, headers=SAME)
    assert endless.status_code == 422 and "is larger than 3 MiB" in endless.json()["reason"]
    announced = {**SAME, "content-length": str(4 << 20)}
    refused = client.put(f"/api/import/{key}/left", params={"name": "a.mp4"}, content=b"x", headers=announced)
    assert refused.status_code == 422 and "is larger" in refused.json()["reason"]
    bomb = zipped([(f"{i}.png", bytes(1 << 20)) for i in range(8)])
    assert len(bomb) < 100_000 and send(client, key, "left", "a.zip", bomb).status_code == 200
    assert send(client, key, "right", "a.zip", bomb).status_code == 200
    done = client.post(f"/api/import/{key}", json={"rate": 5}, headers=SAME)
    assert done.status_code == 422 and "more than fits on the disk" in done.json()["reason"]
    monkeypatch.setattr(uploads, "MIN_FREE_DISK_BYTES", 1 << 62)
    full = send(client, key, "rig", "b.yaml", b"x")
    assert full.status_code == 422 and "not enough free disk space" in full.json()["reason"]
    client.request("DELETE", f"/api/import/{key}", headers=SAME)
    assert sorted(p.name for p in folder.iterdir()) == ["road"]


@pytest.mark.parametrize("name", ["a.mp4", "a.png"])
def test_the_disk_may_fill_while_an_upload_without_a_length_arrives(
    folder: Path, client: TestClient, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """What it has written is removed, and the upload goes on with a smaller file."""
    free = 3 << 20  # bytes, beyond those that stay free

    def disk_usage(place: Path) -> SimpleNamespace:
        written = sum(p.stat().st_size for p in folder.glob(".paceline-import.*/**/*") if p.is_file())
        return SimpleNamespace(free=uploads.MIN_FREE_DISK_BYTES + free - written)

    monkeypatch.setattr(uploads.shutil, "disk_usage", disk_usage)
    key = begin(client)
    pieces = (b"x" * (1 << 20) for _ in range(64))
    full = client.put(f"/api/import/{key}/left", params={"name": name}, content=pieces, headers=SAME)
    assert full.status_code == 422 and full.json()["reason"] == f"{name}: there is not enough free disk space for it"
    assert [list(p.iterdir()) for p in folder.glob(".paceline-import.*")] == [[]]
    assert send(client, key, "left", name, b"x").status_code == 200
    client.request("DELETE", f"/api/import/{key}", headers=SAME)
    assert sorted(p.name for p in folder.iterdir()) == ["road"]


def test_a_request_of_json_is_bounded(client: TestClient) -> None:
    body = b'{"paths": {}, "vehicles": [' + b" " * (5 << 20) + b"]}"
    answer = client.post("/api/check?clip=road", content=body, headers=SAME)
    assert answer.status_code == 422 and "larger than" in answer.json()["reason"]


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b"{}", b'{"paths": [], "vehicles": {}}', b"[" * 100_000,
                                  b'{"paths": {}, "vehicles": [{"left": [[NaN, 1]]}]}',
                                  b'{"paths": {}, "vehicles": [{"left": "x"}]}',
                                  b'{"paths": {"a": {"shape": "spiral"}}, "vehicles": []}',
                                  b'{"paths": {"a": {"left": [[1, 1]]}}, "vehicles": []}'])  # fmt: skip
def test_an_invalid_set_up_is_refused(client: TestClient, body: bytes) -> None:
    for method, address in (("POST", "/api/check"), ("PUT", "/api/setup")):
        answer = client.request(method, f"{address}?clip=road", content=body, headers=SAME)
        assert answer.status_code == 422 and answer.json()["reason"]


@pytest.mark.parametrize(
    "options",
    [{"particles": "1; rm"}, {"particles": 10**9}, {"seed": -1}, {"motion": "--out=/tmp/x"}, {"units": "furlong"},
     {"particles": True}, {"particles": [1]}, {"particles": 19}, {"seed": 1.5}],
)  # fmt: skip
def test_only_known_settings_reach_the_command(client: TestClient, options: dict[str, object]) -> None:
    answer = client.post("/api/run?clip=road", json={"kind": "speed", "options": options}, headers=SAME)
    assert answer.status_code == 422
    assert client.post("/api/run?clip=road", json={"kind": "simulate"}, headers=SAME).status_code == 422


def test_a_name_may_be_too_long_in_bytes(client: TestClient) -> None:
    answer = client.post("/api/import", json={"name": "\N{AUTOMOBILE}" * 80}, headers=SAME)
    assert answer.status_code == 422 and "cannot be used" in answer.json()["reason"]


def test_a_file_that_comes_twice_keeps_the_first(folder: Path, client: TestClient) -> None:
    key = begin(client)
    assert send(client, key, "left", "one/a.png", b"first").status_code == 200
    again = send(client, key, "left", "two/a.png", b"second")
    assert again.status_code == 422 and "sent twice" in again.json()["reason"]
    long = send(client, key, "left", "x" * 300 + ".png", b"x")
    assert long.status_code == 422 and "cannot be written" in long.json()["reason"]
    assert [p.read_bytes() for p in folder.glob(".paceline-import.*/left/*")] == [b"first"]
    client.request("DELETE", f"/api/import/{key}", headers=SAME)


@pytest.mark.parametrize(("where", "words"), [(slice(60, 200), "cannot be unpacked"), (slice(-30, -20), "unpacked")])
def test_a_damaged_zip_is_reported_and_removed(folder: Path, client: TestClient, where: slice, words: str) -> None:
    archive = bytearray(zipped(images(folder, "left")))
    archive[where] = b"\xff" * len(archive[where])
    key = begin(client)
    for view in ("left", "right"):
        assert send(client, key, view, "a.zip", bytes(archive)).status_code == 200
    for _ in range(2):  # asked again, it says the same
        done = client.post(f"/api/import/{key}", json={"rate": 5}, headers=SAME)
        assert done.status_code == 422 and words in done.json()["reason"]
    assert not list(folder.glob(".paceline-import.*/left"))
    client.request("DELETE", f"/api/import/{key}", headers=SAME)


def test_aliases_that_multiply_are_refused(folder: Path, client: TestClient) -> None:
    """A kilobyte of YAML may stand for a thousand million numbers."""
    rows = ["&a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]", *(f"&a{i} [{f'*a{i - 1}, ' * 10}]" for i in range(1, 9))]
    bomb = f"left: {{K: [{', '.join(rows)}]}}\n".encode()
    key = begin(client)
    for view in ("left", "right"):
        assert send(client, key, view, "a.zip", zipped(images(folder, view))).status_code == 200
    assert send(client, key, "rig", "rig.yaml", bomb).status_code == 200
    done = client.post(f"/api/import/{key}", json={"rate": 5}, headers=SAME)
    assert done.status_code == 422 and "holds more than 1000000 values" in done.json()["reason"]
    client.request("DELETE", f"/api/import/{key}", headers=SAME)


def test_nothing_is_imported_into_a_clip(tmp_path: Path) -> None:
    """It would lie in the clip and be listed nowhere."""
    clip = put_clip(tmp_path.resolve())
    with pytest.raises(UnusableInput, match="open the console on the folder above"):
        Uploads(clip).begin("new")


@pytest.mark.parametrize("entry", [{}, {"left": []}, {"left": [[1, 1], [9, 9]]}, {"left": [[1, 1]] * 5},
                                   {"shape": "line"}, {"shape": "curve", "left": [[1, 1]]}])  # fmt: skip
def test_only_lines_and_outlines_are_proposed(client: TestClient, entry: dict[str, Any]) -> None:
    body = {"view": 0, "frame": 0, "entry": entry}
    answer = client.post("/api/propose?clip=road", json=body, headers=SAME)
    assert answer.status_code == 422 and "four corners" in answer.json()["reason"]


def test_an_outline_in_a_missing_frame_is_reported(client: TestClient) -> None:
    given = client.get("/api/setup?clip=road", headers=SAME).json()
    (vehicle,), paths = given["vehicles"], given["paths"]
    body = {"paths": paths, "vehicles": [vehicle, vehicle | {"frame": 99_999}, vehicle | {"frame": [0]}]}
    facts = client.post("/api/check?clip=road", json=body, headers=SAME).json()["vehicles"]
    assert "problem" not in facts[0] and "frame 99999 is not in the recording" in facts[1]["problem"]
    assert "is not in the recording" in facts[2]["problem"]


def test_an_interrupted_upload_leaves_nothing(tmp_path: Path) -> None:
    """As when its tab is closed, or the network goes."""
    root = tmp_path / "clips"
    root.mkdir()
    with serving(root) as (address, process):
        host = address.removeprefix("http://")
        given = urllib.request.Request(f"{address}/api/import", data=b'{"name": "new"}')
        with urllib.request.urlopen(given) as answer:
            key = json.load(answer)["key"]
        with socket.create_connection((host.split(":")[0], int(host.split(":")[1]))) as line:
            head = f"PUT /api/import/{key}/left?name=a.mp4 HTTP/1.1\r\nHost: {host}\r\nContent-Length: 9000000\r\n\r\n"
            line.sendall(head.encode() + bytes(2 << 20))
            wait_until(lambda: [f for f in root.glob(".*/left.mp4") if f.stat().st_size > 0])
        wait_until(lambda: not list(root.glob(".*/left.mp4")))
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0 and process.stderr is not None and process.stderr.read() == ""
    assert list(root.iterdir()) == []


def wait_until(true: Callable[[], object]) -> None:
    end = time.monotonic() + 30
    while not true():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_unfinished_imports_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".paceline-import.0123" / "left").mkdir(parents=True)
    Uploads(tmp_path.resolve())
    assert list(tmp_path.iterdir()) == []
