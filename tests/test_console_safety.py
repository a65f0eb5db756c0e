"""The console touches nothing outside its folder and answers nobody but its own pages."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import anyio
import pytest
from fastapi import FastAPI, WebSocket
from fastapi.testclient import TestClient
from small_clips import put_clip
from starlette.websockets import WebSocketDisconnect

from paceline.console import importing
from paceline.console.api import add_api, clip_of, results_address
from paceline.console.guard import Guard
from paceline.console.importing import Imports
from paceline.console.library import Library
from paceline.console.safety import NotHere, check_clip, check_name, file_below, folder_below
from paceline.console.server import _address, _names
from paceline.errors import UnusableInput

HOST = "127.0.0.1:8640"
SAME = {"host": HOST, "origin": f"http://{HOST}", "sec-fetch-site": "same-origin"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one clip, beside another folder that the console must not see."""
    base = tmp_path_factory.mktemp("safety").resolve()
    put_clip(base / "mine")
    secret = put_clip(base, "secret")
    (secret / "secret.txt").write_text("secret")
    return base / "mine"


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[TestClient]:
    library, imports = Library(folder), Imports(folder)
    app = FastAPI()
    add_api(app, library, imports)
    guarded: Any = Guard(app, {HOST}, None)
    with TestClient(guarded, base_url=f"http://{HOST}") as client:
        yield client
    library.runs.close()
    imports.close()


# --- names -----------------------------------------------------------------------------------------------------------

CLIMBING = [
    "../secret", "road/../../secret", "/etc", "//etc", "", "..", "...", ".hidden", "road/", "./road", "road/.",
    "road\\..\\..\\secret", "road\0", "r" * 5000, "road\n",
]  # fmt: skip


@pytest.mark.parametrize("name", CLIMBING)
def test_names_that_climb_lead_nowhere(folder: Path, client: TestClient, name: str) -> None:
    with pytest.raises(NotHere):
        folder_below(folder, name)
    with pytest.raises(NotHere):
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


@pytest.mark.parametrize("name", [".", "a/b", "Strasse – Süd", "100%?#"])
def test_addresses_of_results_keep_every_name(name: str) -> None:
    assert clip_of(results_address(name, 3, "report.html").split("/")[2]) == name


@pytest.mark.parametrize(
    ("key", "value"),
    [("left", "../../secret/left"), ("rig", "../../secret/rig.yaml"), ("right", "/etc/hostname"),
     ("left", "../../secret/left/*.png"), ("times", "/etc/passwd"), ("left", "link"), ("left", "images"),
     ("rig", "link.yaml")],
)  # fmt: skip
def test_a_clip_that_leads_out_is_refused(tmp_path: Path, key: str, value: str) -> None:
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
        check_clip(root, file)


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


def test_a_clip_of_its_own_is_let_through(folder: Path) -> None:
    check_clip(folder, folder / "road" / "clip.yaml")


def test_a_playlist_is_no_video(tmp_path: Path, folder: Path) -> None:
    """Decoders open what a playlist names; the file need not even look like one."""
    root = tmp_path.resolve()
    secret = folder.parent / "secret" / "left" / "0000.png"
    (root / "left.m3u8").write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nfile://{secret}\n#EXT-X-ENDLIST\n")
    (root / "right.mp4").write_text(f"ffconcat version 1.0\nfile {secret}\n")
    (root / "clip.yaml").write_text("left: left.m3u8\nright: right.mp4\nrig: rig.yaml\n")
    for video in ("left.m3u8", "right.mp4"):
        with pytest.raises(UnusableInput, match="cannot be read as a video"):
            importing.check_container(root / video)
    with pytest.raises(UnusableInput, match="cannot be read as a video"):
        check_clip(root, root / "clip.yaml")


# --- who may ask -----------------------------------------------------------------------------------------------------

FOREIGN = [
    {"host": "evil.example"},  # another name pointed at this machine
    {"host": "127.0.0.1:9999"},
    {"host": HOST, "origin": "http://evil.example"},
    {"host": HOST, "origin": "null"},
    {"host": HOST, "origin": "http://127.0.0.1:3000"},
    {"host": HOST, "sec-fetch-site": "cross-site"},
    {"host": HOST, "sec-fetch-site": "same-site", "sec-fetch-dest": "image"},
    {"host": HOST, "sec-fetch-site": "cross-site", "sec-fetch-dest": "iframe"},
]


@pytest.mark.parametrize("headers", FOREIGN)
def test_requests_of_other_sites_are_refused(client: TestClient, headers: dict[str, str]) -> None:
    for method, address in (("GET", "/api/setup?clip=road"), ("POST", "/api/run?clip=road"), ("PUT", "/api/setup")):
        assert client.request(method, address, headers=headers).status_code == 403


@pytest.mark.parametrize("headers", [SAME, {"host": HOST}, {"host": HOST, "sec-fetch-site": "cross-site",
                                                            "sec-fetch-dest": "document"}])  # fmt: skip
def test_its_own_pages_and_links_to_it_are_answered(client: TestClient, headers: dict[str, str]) -> None:
    answer = client.get("/api/setup?clip=road", headers=headers)
    assert answer.status_code == 200
    assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_followed_link_changes_nothing(client: TestClient) -> None:
    headers = {"host": HOST, "sec-fetch-site": "cross-site", "sec-fetch-dest": "document"}
    assert client.post("/api/run?clip=road", headers=headers, json={"kind": "speed"}).status_code == 403


def test_an_address_that_others_reach_asks_for_its_token() -> None:
    app = FastAPI()

    @app.get("/")
    def page() -> str:
        return "the console"

    guarded: Any = Guard(app, set(), "s3cret")
    with TestClient(guarded, base_url="http://road.example:8640") as client:
        for given in ("/", "/?token=", "/?token=wrong", "/?token=s3cre"):
            assert client.get(given).status_code == 403
        assert client.get("/", headers={"cookie": "paceline-token-8640=wrong"}).status_code == 403
        assert "the console" not in client.get("/?token=s3cret").text
        assert client.cookies["paceline-token-8640"] == "s3cret"
        assert "the console" in client.get("/").text
        assert client.get("/", headers={"origin": "http://evil.example"}).status_code == 403


def test_sockets_of_other_sites_are_refused() -> None:
    app = FastAPI()

    @app.websocket("/ws")
    async def speak(socket: WebSocket) -> None:
        await socket.accept()
        await socket.send_text("the console")

    guarded: Any = Guard(app, {HOST}, None)
    with TestClient(guarded, base_url=f"http://{HOST}") as client:
        for headers in ({"host": HOST, "origin": "http://evil.example"}, {"host": HOST}, {"host": "evil.example"}):
            with pytest.raises(WebSocketDisconnect), client.websocket_connect("/ws", headers=headers):
                pass
        with client.websocket_connect("/ws", headers=SAME) as socket:
            assert socket.receive_text() == "the console"


@pytest.mark.parametrize(
    ("host", "port", "shown", "names"),
    [
        ("127.0.0.1", 8640, "http://127.0.0.1:8640/", {"127.0.0.1:8640", "localhost:8640"}),
        ("localhost", 80, "http://localhost:80/", {"localhost", "127.0.0.1"}),
        ("::1", 9000, "http://[::1]:9000/", {"[::1]:9000"}),
    ],
)
def test_this_machine_is_known_by_its_own_names_only(host: str, port: int, shown: str, names: set[str]) -> None:
    assert _address(host, port) == (shown, None) and _names(shown) == names


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.0.7", "road.example"])
def test_every_other_address_has_a_token_of_its_own(host: str) -> None:
    (address, token), (_, another) = _address(host, 8640), _address(host, 8640)
    assert token and another and token != another and address.endswith(f":8640/?token={token}")


# --- what is sent ----------------------------------------------------------------------------------------------------


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
def test_what_is_no_recording_is_refused(
    folder: Path, client: TestClient, slot: str, name: str, content: bytes, words: str
) -> None:
    key = begin(client)
    answer = send(client, key, slot, name, content)
    assert answer.status_code == 422 and words in answer.json()["reason"]
    assert client.request("DELETE", f"/api/import/{key}", headers=SAME).status_code == 200
    assert sorted(p.name for p in folder.iterdir()) == ["road"]


def test_uploads_are_bounded(folder: Path, client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both by what the browser announces and by what really comes; a zip by what it really holds."""
    monkeypatch.setattr(importing, "LARGEST_FILE", 3 << 20)
    key = begin(client)
    pieces = (b"x" * (1 << 20) for _ in range(64))
    endless = client.put(f"/api/import/{key}/left", params={"name": "a.mp4"}, content=pieces, headers=SAME)
    assert endless.status_code == 422 and "is larger than 3 MiB" in endless.json()["reason"]
    announced = {**SAME, "content-length": str(4 << 20)}
    told = client.put(f"/api/import/{key}/left", params={"name": "a.mp4"}, content=b"x", headers=announced)
    assert told.status_code == 422 and "is larger" in told.json()["reason"]
    bomb = zipped([(f"{i}.png", bytes(1 << 20)) for i in range(8)])
    assert len(bomb) < 100_000 and send(client, key, "left", "a.zip", bomb).status_code == 200
    assert send(client, key, "right", "a.zip", bomb).status_code == 200
    done = client.post(f"/api/import/{key}", json={"rate": 5}, headers=SAME)
    assert done.status_code == 422 and "more than there is room for" in done.json()["reason"]
    monkeypatch.setattr(importing, "SPARE", 1 << 62)
    full = send(client, key, "rig", "b.yaml", b"x")
    assert full.status_code == 422 and "not enough room" in full.json()["reason"]
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
def test_what_is_no_set_up_is_refused(client: TestClient, body: bytes) -> None:
    for method, address in (("POST", "/api/check"), ("PUT", "/api/setup")):
        answer = client.request(method, f"{address}?clip=road", content=body, headers=SAME)
        assert answer.status_code == 422 and answer.json()["reason"]


@pytest.mark.parametrize(
    "options",
    [{"particles": "1; rm"}, {"particles": 10**9}, {"seed": -1}, {"motion": "--out=/tmp/x"}, {"units": "furlong"},
     {"particles": True}, {"particles": [1]}, {"seed": 1.5}],
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
    assert again.status_code == 422 and "came twice" in again.json()["reason"]
    long = send(client, key, "left", "x" * 300 + ".png", b"x")
    assert long.status_code == 422 and "cannot be written" in long.json()["reason"]
    assert [p.read_bytes() for p in folder.glob(".paceline-import.*/left/*")] == [b"first"]
    client.request("DELETE", f"/api/import/{key}", headers=SAME)


@pytest.mark.parametrize(("where", "words"), [(slice(60, 200), "cannot be unpacked"), (slice(-30, -20), "unpacked")])
def test_a_damaged_zip_is_told_and_leaves_nothing(folder: Path, client: TestClient, where: slice, words: str) -> None:
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
        Imports(clip).begin("new")


@pytest.mark.parametrize("entry", [{}, {"left": []}, {"left": [[1, 1], [9, 9]]}, {"left": [[1, 1]] * 5}])
def test_only_lines_and_outlines_are_proposed(client: TestClient, entry: dict[str, Any]) -> None:
    body = {"view": 0, "frame": 0, "entry": entry}
    answer = client.post("/api/propose?clip=road", json=body, headers=SAME)
    assert answer.status_code == 422 and "four corners" in answer.json()["reason"]


def test_half_done_imports_are_cleared_away(tmp_path: Path) -> None:
    (tmp_path / ".paceline-import.0123" / "left").mkdir(parents=True)
    Imports(tmp_path.resolve())
    assert list(tmp_path.iterdir()) == []


def test_an_asker_who_has_gone_needs_no_answer() -> None:
    """The framework complains of it; anything else that it complains of is told."""

    def answered(message: dict[str, Any]) -> None:
        async def app(scope: Any, receive: Any, send: Any) -> None:
            await receive()
            raise RuntimeError("No response returned.")

        async def receive() -> dict[str, Any]:
            return message

        scope = {"type": "http", "server": ("127.0.0.1", 8640), "headers": [(b"host", HOST.encode())], "method": "GET"}
        anyio.run(Guard(app, {HOST}, None), scope, receive, None)

    answered({"type": "http.disconnect"})
    with pytest.raises(RuntimeError, match="No response"):
        answered({"type": "http.request"})
