"""The target page's work: where a model's lines lie, models learned as the command learns them, files written back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_chase
import yaml
from console_client import SAME, open_client
from fastapi.testclient import TestClient
from run_command import paceline
from tiny_clips import put_clip

from paceline.cameras import Camera
from paceline.console.editing.clip_document import FileChanged
from paceline.console.editing.follow_document import FollowSetup, read_follow_setup, save_follow_setup
from paceline.console.editing.target_model import learn_model, project_model
from paceline.console.frames.frame_cache import ChaseFrames
from paceline.documents.loading import load_follow, load_target
from paceline.documents.yaml_editing import set_values
from paceline.errors import UnusableInput
from paceline.targets.stated_width import StatedWidth

K = np.array([[300.0, 0, 127.5], [0, 310.0, 120.5], [0, 0, 1]])


def box_of(frame: int) -> list[float]:
    """The rear's sides in a picture, px."""
    x, y, z = tiny_chase.truth(frame)
    left, top, right, bottom, _ = tiny_chase.BOXES["body"]
    F, cx, cy = tiny_chase.F, tiny_chase.CX, tiny_chase.CY
    return [cx + F * (x + left) / z, cy + F * (y + top) / z, cx + F * (x + right) / z, cy + F * (y + bottom) / z]


@pytest.mark.parametrize("distortion", [[], [-0.25, 0.08, 0.001, -0.002, 0.01]])
def test_model_lines_are_projected_through_the_lens(distortion: list[float]) -> None:
    camera = Camera((256, 242), K, np.array(distortion))
    start = {"frame": 0, "center": [90.0, 150.0], "scale": 0.8}
    shown = project_model(camera, tiny_chase.TARGET, start)
    corners: Any = tiny_chase.TARGET["corners"]
    for (a, b), line in zip(tiny_chase.TARGET["segments"], shown["lines"], strict=True):  # type: ignore[call-overload]
        rays = (np.linalg.inv(K) @ np.append(camera.undistort_points(np.array([[90.0, 150.0]]))[0], 1))[:2]
        for end, pixel in ((corners[a], line[0]), (corners[b], line[-1])):
            point = 12.5 * np.append(rays, 1) + np.array([*end, 0.0])  # 10 m / 0.8
            ideal = camera.undistort_points(np.array([pixel]))[0]
            assert np.abs(ideal - (K @ (point / point[2]))[:2]).max() < 0.05
    assert shown["range_m"] == pytest.approx(12.5) and shown["size_m"] == [2.0, 1.5]
    assert shown["size_px"] == pytest.approx([2 * 24, 1.5 * 24.8], abs=0.06)
    assert "problem" not in shown and "warning" not in shown


def test_problems_of_a_placed_model_are_reported() -> None:
    camera = Camera((256, 242), K)
    far = project_model(camera, tiny_chase.TARGET, {"frame": 0, "center": [300.0, 9.0], "scale": 1.0})
    assert "lies outside the image" in far["problem"] and np.isfinite(far["lines"]).all()
    few = {**tiny_chase.TARGET, "segments": [["a", "b"], ["b", "c"], ["c", "d"], ["d", "a"]]}
    assert (
        "4 lines are few" in project_model(camera, few, {"frame": 0, "center": [99.0, 99.0], "scale": 1.0})["warning"]
    )


def test_a_note_comes_with_a_learned_model() -> None:
    """Dark wheels stand out by 2 px on both sides of the body: their lines lie outside of the box."""
    picture = np.full((242, 256), 100.0, np.float32)
    picture[100:140, 90:160] = 60.0
    for y in (104, 112, 120, 128):
        picture[y : y + 3, 100:150] = 160.0
    picture[118:150, 88:90] = picture[118:150, 160:162] = 20.0
    camera = Camera((256, 242), K)
    found = learn_model(camera, picture, 0, [89.2, 99.5, 159.8, 139.5], StatedWidth(1.8), "saloon")
    (note,) = found["notices"]
    assert "outside the vehicle's sides" in note and "draw the box again" in note


def test_a_learned_model_equals_that_of_the_command(tmp_path: Path) -> None:
    file = tiny_chase.write(tmp_path, 2)
    pictures, box = ChaseFrames(file), [round(v, 2) for v in box_of(1)]
    found = learn_model(pictures.camera, pictures.picture(0, 1), 1, box, StatedWidth(2.0), "small van")
    picture, out = tmp_path / "frames" / "0001.png", tmp_path / "learned.yaml"
    given = ["--box", ",".join(map(str, box)), "--width", "2±0", "--camera", tmp_path / "camera.yaml", "-o", out]
    assert paceline("target", "learn", picture, *given, "--name", "small van").returncode == 0
    by_command, before = load_target(out), read_follow_setup(file)
    saved = save_follow_setup(file, pictures.camera, FollowSetup(found["target"], found["start"], before.revision))
    here = load_follow(file)
    assert saved.start is not None and (here.frame, here.scale) == (1, 1.0) and saved.start["frame"] == 1
    assert here.target.name == by_command.name
    assert np.abs(here.target.ends - by_command.ends).max() < 2e-4
    assert here.target.nominal_range == pytest.approx(by_command.nominal_range, abs=1e-3)
    assert here.target.nominal_range == pytest.approx(tiny_chase.truth(1)[2], rel=0.02)
    assert yaml.safe_load(file.read_text())["target"] == "target-2.yaml"  # the one that was there stays
    assert yaml.safe_load((tmp_path / "target.yaml").read_text()) == tiny_chase.TARGET


def test_a_box_without_lines_is_refused(tmp_path: Path) -> None:
    pictures = ChaseFrames(tiny_chase.write(tmp_path, 2))
    for box, words in (([5.0, 5.0, 40.0, 40.0], "the box shows"), ([9.0, 9.0, 8.0, 8.0], "^box 9,9,8,8")):
        with pytest.raises(UnusableInput, match=words):
            learn_model(pictures.camera, pictures.picture(0, 0), 0, box, StatedWidth(2.0), "x")


def test_only_the_start_is_written_where_the_model_is_the_same(tmp_path: Path) -> None:
    file = tiny_chase.write(tmp_path, 3)
    text = "# my drive\n" + file.read_text() + "\n# the end\n"
    file.write_text(text)
    chase, camera = read_follow_setup(file), ChaseFrames(file).camera
    start = {"frame": 2, "center": [120.127, 99.5], "scale": 1.234567}
    saved = save_follow_setup(file, camera, FollowSetup(chase.target, start, chase.revision))
    assert saved.start == {"frame": 2, "center": [120.13, 99.5], "scale": 1.23457}
    assert sorted(p.name for p in tmp_path.iterdir()) == ["camera.yaml", "follow.yaml", "frames", "target.yaml"]
    before, after = text.splitlines(), file.read_text().splitlines()
    assert [line for line in after if line not in before] == [
        "start: {frame: 2, center: [120.13, 99.5], scale: 1.23457}"
    ]
    assert {"# my drive", "# the end"} <= set(after)
    with pytest.raises(FileChanged):
        save_follow_setup(file, camera, FollowSetup(chase.target, start, chase.revision))


@pytest.mark.parametrize(
    ("target", "start", "words"),
    [
        (None, {"frame": 0, "center": [99.0, 99.0], "scale": 1.0}, "target: "),
        ({"name": "x"}, {"frame": 0, "center": [99.0, 99.0], "scale": 1.0}, "target: .*missing|required"),
        ({**tiny_chase.TARGET, "segments": [["a", "c"]]}, None, "oblique"),
        ({**tiny_chase.TARGET, "segments": [["a", "z"]]}, None, "no corner is called 'z'"),
        (tiny_chase.TARGET, None, "start: "),
        (tiny_chase.TARGET, {"frame": 0, "center": [999.0, 9.0], "scale": 1.0}, "center: .*outside"),
        (tiny_chase.TARGET, {"frame": 0, "center": [99.0, 99.0], "scale": 99.0}, "scale: .*large"),
    ],
)
def test_a_target_that_cannot_be_followed_is_not_saved(tmp_path: Path, target: Any, start: Any, words: str) -> None:
    file = tiny_chase.write(tmp_path, 2)
    before = {p.name: p.read_bytes() for p in tmp_path.glob("*.yaml")}
    with pytest.raises(UnusableInput, match=words):
        save_follow_setup(file, ChaseFrames(file).camera, FollowSetup(target, start, read_follow_setup(file).revision))
    assert {p.name: p.read_bytes() for p in tmp_path.glob("*.yaml")} == before


STYLES = [
    "a: 1\nstart: {frame: 0}\nb: 2\n",
    "a: 1\nstart: {frame: 0}  # where\nb: 2\n",
    "a: 1\nstart:\n  frame: 0\n  center:\n  - 1\n  - 2\n\n# about b\nb: 2\n",
    "start:\n  frame: 0",
    "a: 1\n",
    "a: 1\nb: [1,\n  2]",
    "{a: 1, start: {frame: 0}, b: 2}",
    "a: 'start: 5'\nstart: &x\n  frame: 1\n",
    "a: 1\r\nstart:\r\n  frame: 0\r\nb: 2\r\n",
]


@pytest.mark.parametrize("text", STYLES)
def test_one_value_is_changed_however_it_is_written(text: str) -> None:
    start = {"frame": 3, "center": [1.5, 2.25]}
    new = set_values(text, "follow.yaml", {"start": start})
    assert yaml.safe_load(new) == {**yaml.safe_load(text), "start": start}
    assert [line for line in text.splitlines() if "#" in line and "start" not in line] == [
        line for line in new.splitlines() if "#" in line and "start" not in line
    ]
    assert ("# where" in new) == ("# where" in text)


@pytest.mark.parametrize("text", ["", "- 1\n", "a: &x {frame: 0}\nstart: *x\n<<: {c: 1}\n", "{a: 1}"])
def test_yaml_that_cannot_be_edited_is_refused(text: str) -> None:
    with pytest.raises(UnusableInput, match="cannot be added to|is written in a way"):
        set_values(text, "follow.yaml", {"start": {"frame": 3}})


def test_pictures_come_in_any_order(tmp_path: Path) -> None:
    pictures = ChaseFrames(tiny_chase.write(tmp_path, 20))
    for frame in (3, 4, 19, 0, 18, 2):
        assert np.array_equal(pictures.picture(0, frame), tiny_chase.picture(frame))
    assert pictures.times == pytest.approx(np.arange(20) / 15)
    with pytest.raises(UnusableInput, match="frame 20: is not in the recording"):
        pictures.picture(0, 20)
    with pytest.raises(UnusableInput, match="one view only"):
        pictures.picture(1, 0)


# --- by address ------------------------------------------------------------------------------------------------------


def ask(client: TestClient, method: str, address: str, body: object) -> Any:
    return client.request(method, address, content=json.dumps(body), headers=SAME)


def test_a_chase_is_imported_placed_and_saved(tmp_path: Path) -> None:
    tiny_chase.write(tmp_path / "given", 4)
    root = tmp_path / "clips"
    root.mkdir()
    with open_client(root.resolve()) as client:
        key = ask(client, "POST", "/api/import", {"name": "drive", "kind": "chase"}).json()["key"]
        sent = [("video", p) for p in sorted((tmp_path / "given" / "frames").iterdir())]
        for slot, file in [*sent, ("camera", tmp_path / "given" / "camera.yaml")]:
            address = f"/api/import/{key}/{slot}?name={file.name}"
            assert client.put(address, content=file.read_bytes(), headers=SAME).status_code == 200
        refused = client.put(f"/api/import/{key}/rig?name=rig.yaml", content=b"x", headers=SAME)
        assert refused.status_code == 422 and "is no rig.yaml" in refused.json()["reason"]
        assert ask(client, "POST", f"/api/import/{key}", {"rate": 15}).json() == {"name": "drive"}
        follow = root / "drive" / "follow.yaml"
        assert yaml.safe_load(follow.read_text()) == {"video": "video", "rate": 15, "camera": "camera.yaml"}
        found = client.get("/api/target?clip=drive", headers=SAME).json()
        assert (found["size"], found["frames"], found["target"]) == ([256, 242], [0, 1, 2, 3], None)
        assert found["times"] == pytest.approx([0, 1 / 15, 2 / 15, 0.2], abs=1e-4)
        assert ask(client, "POST", "/api/run?clip=drive", {"kind": "speed"}).status_code == 404

        content = (tmp_path / "given" / "target.yaml").read_bytes()
        opened = client.post("/api/model?clip=drive&frame=2", content=content, headers=SAME).json()
        assert opened["target"] == tiny_chase.TARGET and opened["start"]["frame"] == 2
        assert opened["start"]["scale"] * 2.0 * 30 == pytest.approx(64, abs=0.1)  # a quarter of the picture
        wrong = client.post("/api/model?clip=drive&frame=2", content=b"name: [", headers=SAME)
        assert wrong.status_code == 422 and wrong.json()["reason"].startswith("the model file: line ")
        late = {**opened, "start": {**opened["start"], "frame": 4}, "revision": found["revision"]}
        assert "frame 4: is not in" in ask(client, "PUT", "/api/target?clip=drive", late).json()["reason"]
        body = {"target": opened["target"], "start": tiny_chase.start(2), "revision": found["revision"]}
        assert ask(client, "PUT", "/api/target?clip=drive", body).status_code == 200
        assert ask(client, "PUT", "/api/target?clip=drive", body).status_code == 409
        assert load_follow(follow).frame == 2 and load_follow(follow).target.name == "small van"


def test_an_import_without_a_camera_file_is_refused(tmp_path: Path) -> None:
    tiny_chase.write(tmp_path / "given", 2)
    (tmp_path / "clips").mkdir()
    with open_client((tmp_path / "clips").resolve()) as client:
        key = ask(client, "POST", "/api/import", {"name": "drive", "kind": "chase"}).json()["key"]
        for file in sorted((tmp_path / "given" / "frames").iterdir()):
            client.put(f"/api/import/{key}/video?name={file.name}", content=file.read_bytes(), headers=SAME)
        done = ask(client, "POST", f"/api/import/{key}", {"rate": 15})
        assert done.status_code == 422 and done.json()["reason"].startswith("camera: missing")
        wide = yaml.safe_dump({**tiny_chase.CAMERA, "image_size": [640, 480]})
        client.put(f"/api/import/{key}/camera?name=camera.yaml", content=wide.encode(), headers=SAME)
        done = ask(client, "POST", f"/api/import/{key}", {"rate": 15})
        assert "has 256 × 242 pixels, but the camera has 640 × 480" in done.json()["reason"]


def test_target_routes_need_a_follow_yaml_inside_the_folder(tmp_path: Path) -> None:
    root = tmp_path.resolve() / "clips"
    put_clip(root)
    tiny_chase.write(root / "drive", 2)
    elsewhere = tiny_chase.write(tmp_path / "secret", 2).parent
    with open_client(root) as client:
        for address in ("/api/target?clip=road", "/api/setup?clip=drive", "/api/target?clip=../secret"):
            assert client.get(address, headers=SAME).status_code == 404
        body = {"target": tiny_chase.TARGET, "start": tiny_chase.start(0)}
        assert ask(client, "POST", "/api/outline?clip=drive", body).status_code == 200
        for wrong in ({}, {**body, "start": 5}, {**body, "target": []}, {**body, "start": {"frame": 0, "center": [1]}}):
            assert ask(client, "POST", "/api/outline?clip=drive", wrong).status_code == 422
        for wrong in ({}, {"box": [1, 2, 3]}, {"box": [1, 2, 3, "4"], "frame": 0, "width": 1},
                      {"box": [1, 2, 99, 99], "frame": 9, "width": 1}):  # fmt: skip
            assert ask(client, "POST", "/api/learn?clip=drive", wrong).status_code == 422
        learned = {"box": box_of(1), "frame": 1, "width": 2.0}
        states = {None: True, 0.05: False}
        for half_width, assumed in states.items():
            found = ask(client, "POST", "/api/learn?clip=drive", {**learned, "half_width": half_width}).json()
            assert found["target"].get("width_assumed", False) == assumed
            assert found["target"]["tolerance"] > 0.02 and any("± 3 %" in n for n in found["notices"]) == assumed
        for wrong in ({"width": None}, {"half_width": "0.05"}, {"half_width": 1.5}):
            answer = ask(client, "POST", "/api/learn?clip=drive", {**learned, **wrong})
            assert answer.status_code == 422 and "--" not in answer.json()["reason"]
        assert client.get("/api/frame?clip=drive&view=0&frame=1", headers=SAME).status_code == 200
        assert client.get("/api/frame?clip=drive&view=1&frame=1", headers=SAME).status_code == 422
        file = root / "drive" / "follow.yaml"
        for key, out in (("target", "../../secret/target.yaml"), ("camera", str(elsewhere / "camera.yaml")),
                         ("video", "../../secret/frames")):  # fmt: skip
            given = yaml.safe_load(tiny_chase.write(tmp_path / key, 2).read_text())
            file.write_text(yaml.safe_dump({**given, key: out}))
            answer = client.get("/api/target?clip=drive", headers=SAME)
            assert answer.status_code == 422 and f"{key}: leads out of" in answer.json()["reason"]
