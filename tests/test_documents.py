from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from damaged_inputs import changed
from hypothesis import given, settings
from hypothesis import strategies as st

from paceline.cameras import Quantity
from paceline.documents.loading import load_camera, load_clip, load_rig
from paceline.documents.plausibility import check_quadrilateral
from paceline.documents.yaml_loading import load_yaml
from paceline.errors import UnusableInput

K = [[1000.0, 0.0, 319.5], [0.0, 1000.0, 239.5], [0.0, 0.0, 1.0]]
RIG = {
    "left": {"image_size": [640, 480], "K": K},
    "right": {"image_size": [640, 480], "K": [row[:] for row in K]},
    "rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
    "translation": [-0.5, 0.0, 0.0],
}
LEFT = [[300.0, 200.0], [340.0, 200.0], [340.0, 225.0], [300.0, 225.0]]
RIGHT = [[280.0, 200.0], [320.0, 200.0], [320.0, 225.0], [280.0, 225.0]]
CLIP = {
    "left": "left",
    "right": "right",
    "rate": 5,
    "rig": "rig.yaml",
    "paths": {
        "lane0": {"shape": "line", "left": [[100, 300], [200, 250]], "right": [[80, 300], [190, 250], [195, 247]]}
    },
    "vehicles": [{"id": "v0", "path": "lane0", "frame": 0, "left": LEFT, "right": RIGHT}],
}


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def write(clip=CLIP, rig=RIG):
    Path("rig.yaml").write_text(yaml.safe_dump(rig))
    Path("clip.yaml").write_text(yaml.safe_dump(clip))
    return "clip.yaml"


def refusal(load, path):
    with pytest.raises(UnusableInput) as caught:
        load(path)
    message = str(caught.value)
    assert "\n" not in message
    return message


# --- what is right -------------------------------------------------------------------------------------------------


def test_a_clip_is_read_whole():
    clip = load_clip(write())
    assert (clip.left, clip.right, clip.rate, clip.times) == (Path("left"), Path("right"), 5.0, None)
    assert (clip.tolerance, clip.bit_depth, clip.path) == (None, None, Path("clip.yaml"))
    path = clip.paths["lane0"]
    assert (path.name, path.shape, path.lateral_offset, path.points) == ("lane0", "line", 0.0, None)
    assert path.left.shape == (2, 2) and path.right.shape == (3, 2)
    (vehicle,) = clip.vehicles
    assert (vehicle.id, vehicle.path, vehicle.frame, vehicle.plane, vehicle.speed) == ("v0", "lane0", 0, "front", None)
    np.testing.assert_array_equal(vehicle.right, RIGHT)
    np.testing.assert_array_equal(clip.rig.t, [-0.5, 0, 0])
    assert clip.rig.uncertainty.is_assumed and clip.rig.left.readout is None
    assert (clip.offset, clip.drawn_on) == (None, None)


def test_optional_keys():
    clip = changed(changed(CLIP, "time_tolerance", 0.004), "bit_depth", 12)
    clip["vehicles"] = [
        {"id": 7, "frame": 3, "left": LEFT, "right": RIGHT, "speed": 24.6},
        {"id": "side", "frame": 3, "left": LEFT, "right": RIGHT, "plane": "side"},
    ]
    clip["paths"] = {1: {"shape": "curve", "points": [[0, 1, 10], [0, 1, 20]], "lateral_offset": -1.85}}
    read = load_clip(write(clip))
    assert (read.tolerance, read.bit_depth) == (0.004, 12)
    assert [(v.id, v.path, v.plane, v.speed) for v in read.vehicles] == [
        ("7", None, "free", 24.6), ("side", None, "side", None)
    ]  # fmt: skip
    assert read.paths["1"].points.shape == (2, 3) and read.paths["1"].lateral_offset == -1.85


@pytest.mark.parametrize("vehicles", ["", "vehicles:\n", "vehicles: []\n"])
def test_without_vehicles_the_list_is_empty(vehicles):
    write()
    Path("clip.yaml").write_text(f"left: left\nright: right\nrate: 5\nrig: rig.yaml\n{vehicles}")
    clip = load_clip("clip.yaml")
    assert clip.vehicles == [] and clip.paths == {}


def test_paths_inside_a_file_are_relative_to_it(tmp_path):
    Path("a/b").mkdir(parents=True)
    Path("a/clip.yaml").write_text(yaml.safe_dump(changed(changed(CLIP, "rig", "b/rig.yaml"), "left", "b/l_*.png")))
    Path("a/b/rig.yaml").write_text(yaml.safe_dump(RIG))
    clip = load_clip("a/clip.yaml")
    assert clip.left == Path("a/b/l_*.png") and clip.path == Path("a/clip.yaml")
    Path("a/b/rig.yaml").unlink()
    assert refusal(load_clip, "a/clip.yaml") == "a/b/rig.yaml: no such file"
    absolute = changed(CLIP, "left", str(tmp_path / "elsewhere"))
    assert load_clip(write(absolute)).left == tmp_path / "elsewhere"


def test_clicked_points_are_undistorted():
    distortion = [-0.2, 0.05, 0.0005, -0.0005, 0.0]
    clip = load_clip(write(rig=changed(RIG, "left.distortion", distortion)))
    rays = clip.rig.left.rays(clip.vehicles[0].left)
    back = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), np.array(K), np.array(distortion))[0]
    np.testing.assert_allclose(back.reshape(-1, 2), LEFT, atol=0.05)
    assert np.abs(clip.paths["lane0"].left - [[100, 300], [200, 250]]).max() > 0.5
    np.testing.assert_array_equal(clip.vehicles[0].right, RIGHT)


def test_a_rounded_rotation_is_made_exact():
    R = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0]
    rig = load_rig_with("rotation", np.round(R, 4).tolist())
    np.testing.assert_allclose(rig.R @ rig.R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rig.R, R, atol=1e-4)


def load_rig_with(key, value):
    Path("rig.yaml").write_text(yaml.safe_dump(changed(RIG, key, value)))
    return load_rig("rig.yaml")


def test_the_stated_uncertainty_is_read_and_numbers_may_have_plain_exponents():
    text = "{focal_length_px: 1.5, rotation_rad: [1e-4, 2E-4, 3.0e-04]}"
    Path("rig.yaml").write_text(yaml.safe_dump(RIG) + f"uncertainty: {text}\n")
    u = load_rig("rig.yaml").uncertainty
    assert (u.focal_length_px, u.principal_point_px, u.translation_m) == (1.5, 0.0, (0.0, 0.0, 0.0))
    assert u.rotation_rad == (1e-4, 2e-4, 3e-4)


def test_an_exact_rig_has_no_uncertainty():
    assert load_rig_with("uncertainty", "exact").uncertainty is None


@pytest.mark.parametrize(
    ("keys", "readout"),
    [
        ({}, None),
        ({"shutter": "rolling"}, None),
        ({"shutter": "global"}, Quantity(0.0)),
        ({"shutter": "global", "readout": 0}, Quantity(0.0)),
        ({"shutter": "rolling", "readout": 0.018}, Quantity(0.018)),
        ({"readout": -0.018}, Quantity(-0.018)),
        ({"readout": {"value": 0.018, "std": 0.002}}, Quantity(0.018, 0.002)),
    ],
)
def test_a_shutter_is_read(keys, readout):
    camera = {**RIG["right"], **keys}
    assert load_rig_with("right", camera).right.readout == readout
    Path("camera.yaml").write_text(yaml.safe_dump(camera))
    assert load_camera("camera.yaml").readout == readout


@pytest.mark.parametrize(
    ("keys", "offset"),
    [
        ({}, None),
        ({"synchronised": False}, None),
        ({"synchronised": True}, Quantity(0.0)),
        ({"synchronised": True, "offset": 0}, Quantity(0.0)),
        ({"offset": -0.008}, Quantity(-0.008)),
        ({"synchronised": False, "offset": {"value": 0.008, "std": 5e-4}}, Quantity(0.008, 5e-4)),
        ({"rate": None, "times": "times.csv"}, Quantity(0.0)),
        ({"rate": None, "times": "times.csv", "synchronised": False}, Quantity(0.0)),
        ({"rate": None, "times": "times.csv", "offset": 0.008}, Quantity(0.008)),
    ],
)
def test_the_time_between_the_views_is_read(keys, offset):
    clip = {key: value for key, value in {**CLIP, **keys}.items() if value is not None}
    assert load_clip(write(clip)).offset == offset


def test_the_frame_on_which_paths_are_drawn_is_read():
    assert load_clip(write(changed(CLIP, "drawn_on", 7))).drawn_on == 7


def test_a_vertical_rig_is_allowed():
    assert load_rig_with("translation", [0.1, -0.5, 0.0]).baseline == pytest.approx(np.hypot(0.1, 0.5))


# --- what is wrong with a rig --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("left.K.0.0", -1000.0, "rig.yaml: left.K: expected positive focal lengths, found -1000 and 1000"),
        ("right.K.1.1", 0.0, "rig.yaml: right.K: expected positive focal lengths, found 1000 and 0"),
        ("left.K.0.1", 3.0, "rig.yaml: left.K: expected the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
        ("left.K.2.2", 2.0, "rig.yaml: left.K: expected the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
        ("left.K.0.2", 9000.0, "rig.yaml: left.K: the principal point (9000, 239.5) lies far outside the image; "
                               "expected it near (320, 240)"),
        ("left.K", [[1, 0, 0], [0, 1, 0]], "rig.yaml: left.K: expected three rows of three numbers, found 2"),
        ("left.K.0.0", float("nan"), "rig.yaml: left.K: expected three rows of three numbers, "
                                     "found [nan, 0.0, 319.5] in place 0"),
        ("left.image_size", [640], "rig.yaml: left.image_size: expected 2 values, found [640]"),
        ("left.image_size.0", 640.5, "rig.yaml: left.image_size[0]: expected a whole number, found 640.5"),
        ("left.image_size.0", -640, "rig.yaml: left.image_size[0]: expected at least 16, found -640"),
        ("left.distortion", [0.1, 0.2], "rig.yaml: left: distortion: expected 4, 5, 8, 12 or 14 coefficients, found 2"),
        ("left.distortion", [0.1, 0.2, 0, float("inf")], "rig.yaml: left.distortion[3]: expected a finite number, "
                                                         "found inf"),
        ("left.distorsion", [], "rig.yaml: left: unknown key 'distorsion'; did you mean 'distortion'?"),
        ("rotation.0.0", 1.1, "rig.yaml: rotation: is not a rotation: RᵀR differs from the identity by 0.21; "
                              "expected orthonormal rows"),
        ("rotation.0.0", -1.0, "rig.yaml: rotation: is a reflection, its determinant is -1; expected a rotation"),
        ("translation", [0, 0, 0], "rig.yaml: translation: both cameras stand in the same place; "
                                   "expected a distance in metres"),
        ("translation", [-0.005, 0, 0], "rig.yaml: translation: the cameras stand 0.005 m apart; expected metres, at "
                                        "least 0.01"),
        ("translation", [-500, 0, 0], "rig.yaml: translation: the cameras stand 500 m apart; expected metres "
                                      "(are these millimetres?)"),
        ("translation", [0.5, 0, 0], "rig.yaml: translation: the right camera lies to the left of the left one; "
                                     "left and right are swapped"),
        ("translation", [0.5, 0], "rig.yaml: translation: expected three finite numbers, found [0.5, 0]"),
        ("translation", None, "rig.yaml: translation: missing"),
        ("uncertainty", {"rotation_rad": [-1, 0, 0]}, "rig.yaml: uncertainty.rotation_rad[0]: expected at least 0"),
        ("uncertainty", "none", "rig.yaml: uncertainty: expected exact, or the keys focal_length_px, "
                                "principal_point_px, rotation_rad, translation_m, covariance, found 'none'"),
        ("uncertainty", True, "rig.yaml: uncertainty: expected the keys focal_length_px, "),
        ("left.shutter", "electronic", "rig.yaml: left.shutter: expected 'global' or 'rolling', found 'electronic'"),
        ("left.readout", 18, "rig.yaml: left.readout: expected at most 0.1 s from the first row to the last, found 18"),
        ("left.readout", {"value": -0.2, "std": 0.0}, "rig.yaml: left.readout: expected at most 0.1 s from the first "
                                                      "row to the last, found -0.2"),
        ("right.readout", "18 ms", "rig.yaml: right.readout: expected a number or {value: …, std: …}, found '18 ms'"),
        ("right.readout", float("nan"), "rig.yaml: right.readout: expected a number or {value: …, std: …}, found nan"),
        ("right.readout", {"value": 0.018}, "rig.yaml: right.readout.std: missing"),
        ("right.readout", {"value": 0.018, "std": -1}, "rig.yaml: right.readout.std: expected at least 0, found -1"),
        ("right.readout", {"value": 0.018, "sdt": 1}, "rig.yaml: right.readout: unknown key 'sdt'; did you mean 'std'"),
        ("right", {**RIG["right"], "shutter": "global", "readout": 0.018},
         "rig.yaml: right.readout: shutter: global means exactly 0; expected one of them, found 0.018 as well"),
        ("right", {**RIG["right"], "shutter": "global", "readout": {"value": 0, "std": 0.001}},
         "rig.yaml: right.readout: shutter: global means exactly 0; expected one of them, found 0 ± 0.001 as well"),
    ],
)  # fmt: skip
def test_a_rig_that_cannot_be(key, value, message):
    Path("rig.yaml").write_text(yaml.safe_dump(changed(RIG, key, value)))
    assert refusal(load_rig, "rig.yaml").startswith(message)


# --- what is wrong with a clip -------------------------------------------------------------------------------------

ORDER = "top-left, top-right, bottom-right, bottom-left as seen in the image"


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("rate", 0, "rate: expected at least 0.1, found 0"),
        ("rate", -5, "rate: expected at least 0.1, found -5"),
        ("rate", 1e6, "rate: expected at most 10000"),
        ("rate", float("nan"), "rate: expected a number or {value: …, override: …}, found nan"),
        ("rate", True, "rate: expected a number or {value: …, override: …}, found True"),
        ("rate", "5", "rate: expected a number or {value: …, override: …}, found '5'"),
        ("rate", {"value": 240, "overide": True}, "rate: unknown key 'overide'; did you mean 'override'?"),
        ("rate", {"value": 240, "override": 1}, "rate.override: expected true or false, found 1"),
        ("rate", {"override": True}, "rate.value: missing"),
        ("rate", {"value": 0.01, "override": True}, "rate: expected at least 0.1, found 0.01"),
        ("rate", {"value": "240", "override": True}, "rate.value: expected a number, found '240'"),
        ("times", "times.csv", "rate and times: expected one of them, found both"),
        ("ratte", 5, "unknown key 'ratte'; did you mean 'rate'?"),
        ("zzz", 5, "unknown key 'zzz'; expected one of left, right, rate, times, time_tolerance, bit_depth, "
                   "synchronised, offset, drawn_on, limit, rig, site, paths, vehicles"),
        ("limit", 30, "limit: expected a speed with its unit, such as 30 mph, found 30"),
        ("limit", "30", "limit: expected a speed with its unit, such as 30 mph, found '30'"),
        ("limit", "30 knots", "limit: unknown unit 'knots'; expected mph, km/h, m/s"),
        ("paths.lane0.limit", "0 mph", "paths.lane0.limit: expected a speed above 0 and up to 150 m/s, found '0 mph'"),
        ("rig", None, "rig: missing"),
        ("bit_depth", 20, "bit_depth: expected at most 16, found 20"),
        ("time_tolerance", 0, "time_tolerance: expected a number above 0"),
        ("synchronised", "yes", "synchronised: expected true or false, found 'yes'"),
        ("offset", "8 ms", "offset: expected a number or {value: …, std: …}, found '8 ms'"),
        ("offset", {"value": 0.008}, "offset.std: missing"),
        ("drawn_on", -1, "drawn_on: expected at least 0, found -1"),
        ("drawn_on", 1.5, "drawn_on: expected a whole number, found 1.5"),
        ("left", 3, "left: expected text, found 3"),
        ("paths", [1], "paths: expected names, each with its keys, found [1]"),
        ("paths.lane0.shape", "circle", "paths.lane0.shape: expected 'line' or 'curve', found 'circle'"),
        ("paths.lane0.right", None, "paths.lane0: drawn in the left view only; expected the same road line in both "
                                    "views, or points"),
        ("paths.lane0.points", [[0, 0, 1], [0, 0, 2]], "paths.lane0: expected either points or left and right, "
                                                       "found both"),
        ("paths.lane0.left", [[1, 2]], "paths.lane0.left: expected at least two [x, y] points for a line, found 1"),
        ("paths.lane0.shape", "curve", "paths.lane0.left: expected at least four [x, y] points for a curve, found 2"),
        ("paths.lane0.left", [[1, 2], [1, 2]], "paths.lane0.left: all points lie in the same place"),
        ("paths.lane0.left", [[1, 2], [3]], "paths.lane0.left: expected [x, y] points, found [3] in place 1"),
        ("paths.lane0", {"shape": "line"}, "paths.lane0: not drawn; expected the same road line in both views, or"),
        ("paths.lane0", {"shape": "line", "points": [[0, 1, 2]]}, "paths.lane0.points: expected at least two "
                                                                  "[x, y, z] points, found 1"),
        ("vehicles", {"id": "v"}, "vehicles: expected a list"),
        ("vehicles.0.path", "lane1", "vehicles[0].path: no path is called 'lane1'; did you mean 'lane0'?"),
        ("vehicles.0.id", "v\n0", "vehicles[0].id: expected at most 100 printable characters"),
        ("vehicles.0.id", "v" * 101, "vehicles[0].id: expected at most 100 printable characters"),
        ("vehicles.0.frame", -1, "vehicles[0].frame: expected at least 0, found -1"),
        ("vehicles.0.frame", None, "vehicles[0].frame: missing"),
        ("vehicles.0.speed", -3, "vehicles[0].speed: expected a number above 0, found -3"),
        ("vehicles.0.plane", "top", "vehicles[0].plane: expected 'front', 'side' or 'free', found 'top'"),
        ("vehicles.0", "v0", "vehicles[0]: expected the keys id, path, frame, left, right, plane, speed, found 'v0'"),
        ("vehicles.0.left", LEFT[:3], "vehicles[0].left: expected four [x, y] points, found 3"),
        ("vehicles.0.left.2", [1.0, float("nan")], "vehicles[0].left: expected four [x, y] points, "
                                                   "found [1.0, nan] in place 2"),
        ("vehicles.0.left.2", [10**400, 1], "vehicles[0].left: expected four [x, y] points, found [1000"),
        ("vehicles.0.right.1", [640.0, 200.0], "vehicles[0].right: the corner [640, 200] lies outside the image of "
                                               "640 × 480 pixels"),
        ("vehicles.0.left", [LEFT[i] for i in (0, 1, 3, 2)], "vehicles[0].left: the sides cross each other; "
                                                             f"expected the corners in the order {ORDER}"),
        ("vehicles.0.left", LEFT[::-1], "vehicles[0].left: the corners go counter-clockwise; "
                                        f"expected the order {ORDER}"),
        ("vehicles.0.left", LEFT[1:] + LEFT[:1], "vehicles[0].left: the first corner is not the top-left one; "
                                                 f"expected the order {ORDER}"),
        ("vehicles.0.left.2", [310.0, 205.0], "vehicles[0].left: is not convex; "
                                              f"expected four corners in the order {ORDER}"),
        ("vehicles.0.left", [[300, 200], [310, 200], [310, 206], [300, 206]],
         "vehicles[0].left: is too small to track (area 60 px², shortest side 6.0 px); expected at least 64 px²"),
        ("vehicles.0.left", [[300, 200]] * 4, "vehicles[0].left: is too small to track (area 0 px²"),
    ],
)  # fmt: skip
def test_a_clip_that_cannot_be(key, value, message):
    assert refusal(load_clip, write(changed(CLIP, key, value))).startswith(f"clip.yaml: {message}")


@pytest.mark.parametrize(
    ("right", "message"),
    [
        ([[x + 100, y] for x, y in RIGHT],
         "vehicles[0]: the top-left corner triangulates behind the cameras; expected the same corner in both views "
         "(are left and right swapped?)"),
        ([[x, y + 40] for x, y in RIGHT],
         "vehicles[0]: the views disagree: the right outline lies 40 px off the epipolar line of the left one"),
    ],
)  # fmt: skip
def test_outlines_at_the_same_instant_are_of_the_same_part(right, message):
    clip = changed(CLIP, "vehicles.0.right", right)
    load_clip(write(clip))  # whose views may be exposed at other instants
    assert refusal(load_clip, write(clip | {"synchronised": True})).startswith(f"clip.yaml: {message}")


@pytest.mark.parametrize(("offset", "found"), [(0.008, "0.008"), ({"value": 0, "std": 0.001}, "0 ± 0.001")])
def test_synchronised_views_have_no_offset(offset, found):
    clip = {**CLIP, "synchronised": True, "offset": offset}
    expected = "clip.yaml: offset: synchronised: true means exactly 0; expected one of them, found"
    assert refusal(load_clip, write(clip)) == f"{expected} {found} as well"


def test_outlines_may_cover_somewhat_different_parts():
    load_clip(write(changed(CLIP, "vehicles.0.right", [[x, y + 10] for x, y in RIGHT])))


def test_two_vehicles_of_one_id():
    clip = changed(CLIP, "vehicles", CLIP["vehicles"] * 2)
    assert refusal(load_clip, write(clip)) == "clip.yaml: vehicles[1].id: 'v0' occurs twice; expected one of its own"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "clip.yaml: expected the keys left, right, rate,"),
        ("- 1\n- 2\n", "clip.yaml: expected the keys left, right, rate,"),
        ("left: [1, 2\nright: x", "clip.yaml: line 2, column 6: did not find expected ',' or ']'"),
        ("left: a\nright: b\nleft: c\n", "clip.yaml: line 3, column 1: the key 'left' occurs twice"),
        ("left: !!python/object:os.system x\n", "clip.yaml: line 1, column 7: could not determine a constructor"),
        ("left: \x00", "clip.yaml: is not valid YAML"),
        ("left: 2001-99-99", "clip.yaml: is not valid YAML"),
    ],
)
def test_yaml_that_cannot_be(text, message):
    Path("clip.yaml").write_text(text)
    assert refusal(load_clip, "clip.yaml").startswith(message)


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("0012", 12),
        ("010", 10),
        ("-07", -7),
        ("+3", 3),
        ("08.50", 8.5),
        (".5", 0.5),
        ("1e-3", 1e-3),
        ("-.inf", -np.inf),
    ],
)
def test_numbers_are_decimal(text, number):
    assert load_yaml(f"rate: {text}") == {"rate": number}


@pytest.mark.parametrize("tag", ["timestamp", "bool", "int", "float", "binary", "set", "map", "seq", "omap", "pairs"])
@pytest.mark.parametrize("text", ["x", "''", "[x]", "{x: y}"])
def test_a_value_that_its_tag_does_not_fit_is_refused(tag: str, text: str) -> None:
    with suppress(yaml.YAMLError, ValueError):  # `read_document` answers these in one line, and no others
        load_yaml(f"rate: !!{tag} {text}")


@pytest.mark.parametrize("text", ["1_0", "1:30", "190:20:30.15", "1_0.5", "0x10", "0b1", "1.2.3"])
def test_what_is_no_decimal_number_is_refused(text):
    file = write({**CLIP, "rate": "RATE"})
    Path(file).write_text(Path(file).read_text().replace("RATE", text))
    expected = "expected a number or {value: …, override: …}"
    assert refusal(load_clip, file) == f"clip.yaml: rate: {expected}, found {text!r}"


def test_files_that_cannot_be_read():
    assert refusal(load_clip, "nowhere/clip.yaml") == "nowhere/clip.yaml: no such file"
    Path("folder").mkdir()
    assert re.match("folder: cannot be read", refusal(load_rig, "folder"))
    Path("rig.yaml").write_bytes(b"\xff\xfe\x00\x01\x80")
    assert refusal(load_rig, "rig.yaml") == "rig.yaml: is not a text file"


@settings(deadline=None)
@given(
    st.floats(-40, 40), st.floats(20, 80), st.floats(20, 60), st.floats(-0.4, 0.4), st.integers(1, 3),
)  # fmt: skip
def test_a_turned_rectangle_is_right_in_one_order_only(degrees, width, height, shear, shift):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    shape = np.array([[-width, -height], [width, -height], [width, height], [-width, height]]) / 2
    corners = shape @ np.array([[1, shear], [0, 1]]).T @ np.array([[c, -s], [s, c]]).T + [320, 240]
    if abs(degrees) < 20:
        assert check_quadrilateral(corners, (640, 480)) is None
        assert check_quadrilateral(np.roll(corners, shift, axis=0), (640, 480)) is not None
    assert check_quadrilateral(corners[::-1], (640, 480)) is not None
    assert "cross" in (check_quadrilateral(corners[[0, 2, 1, 3]], (640, 480)) or "")
