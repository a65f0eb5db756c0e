"""camera.yaml, target.yaml and follow.yaml: what is read, and what is refused in one line that names the key."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_chase
import yaml
from damaged_inputs import changed

from paceline.documents.loading import load_camera, load_follow, load_target
from paceline.errors import UnusableInput

FOLLOW = {"video": "frames", "rate": 15, "camera": "camera.yaml", "target": "target.yaml", "start": tiny_chase.start()}
SHARED = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    put("camera", tiny_chase.CAMERA)
    put("target", tiny_chase.TARGET)
    put("follow", FOLLOW)


def put(name: str, document: Any) -> None:
    Path(f"{name}.yaml").write_text(yaml.safe_dump(document))


def refusal() -> str:
    with pytest.raises(UnusableInput) as caught:
        load_follow("follow.yaml")
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_a_recording_is_read_whole() -> None:
    put(
        "follow",
        FOLLOW
        | {"odometry": "odometry.csv", "wheelbase": 2.7, "camera_ahead": -0.4, "lookahead": 1.1, "bit_depth": 12},
    )
    clip = load_follow("follow.yaml")
    assert (clip.video, clip.rate, clip.bit_depth, clip.frame) == ("frames", 15, 12, 0)
    assert (clip.odometry, clip.wheelbase) == (Path("odometry.csv"), 2.7)
    assert (clip.camera_ahead, clip.lookahead) == (-0.4, 1.1)
    assert clip.scale == pytest.approx(10 / 8.5)
    np.testing.assert_allclose(clip.center, tiny_chase.start()["center"])
    assert clip.camera.image_size == (256, 242)
    target = clip.target
    assert (target.name, target.nominal_range, len(target.corners)) == ("small van", 10.0, 10)
    np.testing.assert_array_equal(target.segments[:5], [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5]])
    np.testing.assert_array_equal(target.corners[5], [0.72, -0.5])
    np.testing.assert_allclose(np.ptp(target.ends, axis=0), [2.0, 1.5])


def test_paths_are_relative_to_the_file_and_addresses_are_not() -> None:
    Path("below").mkdir()
    for name in ("camera", "target"):
        Path(f"{name}.yaml").rename(f"below/{name}.yaml")
    Path("below/follow.yaml").write_text(yaml.safe_dump(FOLLOW | {"video": "rtsp://camera/1"}))
    assert load_follow("below/follow.yaml").video == "rtsp://camera/1"
    Path("below/follow.yaml").write_text(yaml.safe_dump(FOLLOW))
    assert load_follow("below/follow.yaml").video == "below/frames"
    Path("below/follow.yaml").write_text(yaml.safe_dump(FOLLOW | {"video": "/dev/video0"}))
    assert load_follow("below/follow.yaml").video == "/dev/video0"


def test_corners_may_be_numbers() -> None:
    put("target", {"name": 7, "nominal_range": 8, "corners": {1: [0, 0], 2: [1, 0], 3: [1, 1]},
                   "segments": [[1, 2], [2, 3], [3, 1]][:2] + [[3, 2]]})  # fmt: skip
    with pytest.raises(UnusableInput, match="show no size"):
        load_target("target.yaml")
    put("target", {"name": 7, "nominal_range": 8, "corners": {1: [0, 0], 2: [1, 0], 3: [1, 1], 4: [0, 1]},
                   "segments": [[1, 2], [2, 3], [3, 4]]})  # fmt: skip
    assert load_target("target.yaml").name == "7"


@pytest.mark.parametrize(
    ("file", "key", "value", "words"),
    [
        ("target", "segments", [["a", "b"], ["e", "f"]], ["target.yaml: segments", "no vertical line"]),
        ("target", "segments", [["b", "c"], ["f", "g"]], ["target.yaml: segments", "no horizontal line"]),
        ("target", "segments", [], ["target.yaml: segments", "found none"]),
        ("target", "segments", [["a", "b"], ["b", "c"]], ["target.yaml: segments", "show no size"]),
        ("target", "segments.3", ["d", "z"], ["segments[3]", "no corner is called 'z'", "a, b, c"]),
        ("target", "segments.3", ["a", "c"], ["segments[3]", "a to c is oblique", "2 m across and 1.5 m down"]),
        ("target", "segments.3", ["a", "a"], ["segments[3]", "same place"]),
        ("target", "segments.3", ["a"], ["segments[3]", "expected 2 values"]),
        ("target", "corners.a", [-1.0], ["corners.a", "two finite numbers"]),
        ("target", "corners.a", [-1.0, float("nan")], ["corners.a", "nan"]),
        ("target", "corners", [[0, 0]], ["corners", "expected names"]),
        ("target", "nominal_range", 0, ["nominal_range", "above 0"]),
        ("target", "nominal_range", -3.0, ["nominal_range", "above 0"]),
        ("target", "nominal_range", "far", ["nominal_range", "expected a number"]),
        ("target", "nomnal_range", 3, ["'nomnal_range'", "did you mean 'nominal_range'?"]),
        ("target", "name", None, ["target.yaml: name", "missing"]),
        ("follow", "start.scale", 0, ["follow.yaml: start.scale", "above 0"]),
        ("follow", "start.scale", -1.0, ["start.scale", "above 0"]),
        ("follow", "start.scale", 1e-3, ["start.scale", "0.06 × 0.045 px", "at least 8 px"]),
        ("follow", "start.scale", 40.0, ["start.scale", "far more than the image"]),
        ("follow", "start.scale", float("nan"), ["start.scale", "finite"]),
        ("follow", "start.center", [2.0, 3.0], ["start.center", "leaves 2", "image of 256 × 242", "at least 50 %"]),
        ("follow", "start.center", [256.0, 100.0], ["start.center", "[256, 100]", "256 × 242"]),
        ("follow", "start.center", [100.0, -3.0], ["start.center", "[100, -3]", "outside"]),
        ("follow", "start.center", [100.0], ["start.center", "two finite numbers"]),
        ("follow", "start.frame", -1, ["start.frame", "at least 0"]),
        ("follow", "start.frame", 0.5, ["start.frame", "whole number"]),
        ("follow", "start", None, ["start", "missing"]),
        ("follow", "rate", 0, ["rate", "at least 0.1"]),
        ("follow", "wheelbase", 0, ["wheelbase", "at least 0.1"]),
        ("follow", "lookahead", -1, ["lookahead", "at least 0"]),
        ("follow", "camera", "absent.yaml", ["absent.yaml", "no such file"]),
        ("follow", "vidoe", "x", ["'vidoe'", "did you mean 'video'?"]),
        ("camera", "K.0.0", -300.0, ["camera.yaml: K", "positive focal lengths"]),
        ("camera", "image_size", [256], ["camera.yaml: image_size", "expected 2 values"]),
    ],
)
def test_it_is_refused_naming_the_key(file: str, key: str, value: Any, words: list[str]) -> None:
    documents = {"camera": tiny_chase.CAMERA, "target": tiny_chase.TARGET, "follow": FOLLOW}
    put(file, changed(documents[file], key, value))
    message = refusal()
    for word in words:
        assert word in message, message


def test_a_target_in_millimetres() -> None:
    corners = {name: [1000 * x, 1000 * y] for name, (x, y) in tiny_chase.TARGET["corners"].items()}
    put("target", tiny_chase.TARGET | {"corners": corners})
    assert "2000 m large; expected metres" in refusal()


def test_rounding_in_a_file_is_not_oblique() -> None:
    put("target", changed(tiny_chase.TARGET, "corners.b", [1.0, -0.752]))
    assert len(load_target("target.yaml").segments) == 9


def test_a_camera_is_what_stands_under_left_in_a_rig() -> None:
    put("camera", tiny_chase.CAMERA | {"distortion": [-0.1, 0.02, 0.0, 0.0]})
    assert load_camera("camera.yaml").has_distortion


@pytest.mark.skipif(not SHARED.exists(), reason="the shared recordings are not here")
def test_the_shared_recording_is_read() -> None:
    clip = load_follow(SHARED / "rendered" / "follow" / "follow.yaml")
    assert (len(clip.target.segments), clip.camera.image_size) == (10, (256, 242))
