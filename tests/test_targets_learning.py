"""Learning a target: lines where they truly are, a file that reads back, and boxes that are refused."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_chase
import yaml
from run_command import assert_one_line_error, paceline

from paceline.cameras import Camera
from paceline.documents.loading import load_target
from paceline.errors import UnusableInput
from paceline.reports.target import draw_target, start_entry, target_yaml
from paceline.targets.image_lines import Line, find_lines
from paceline.targets.learning import corner_names, join_lines, learn_target
from paceline.targets.stated_width import StatedWidth

CAMERA = Camera((256, 242), np.array(tiny_chase.CAMERA["K"]))
KITTI = Path(__file__).parents[2] / "shared" / "data" / "kitti_lead"

TRUE_X = [-1.0, -0.72, 0.72, 1.0]  # m, of the vertical lines
TRUE_Y = [-0.75, -0.5, 0.0, 0.45, 0.75]


def van(frame: int, margin: float = 1.5) -> tuple[np.ndarray, tuple[float, float, float, float], np.ndarray]:
    """The picture of one frame, a box drawn by hand around the van, and the true position."""
    x, y, z = position = tiny_chase.truth(frame)
    cx, cy, f = tiny_chase.CX, tiny_chase.CY, tiny_chase.F
    hand = np.random.default_rng(frame).uniform(-margin, margin, 4)
    box = np.array([cx + f * (x - 1) / z, cy + f * (y - 0.75) / z, cx + f * (x + 1) / z, cy + f * (y + 0.75) / z])
    return tiny_chase.picture(frame).astype(np.float32), tuple(box + hand), position


@pytest.mark.parametrize("frame", [0, 11, 25, 40])
def test_lines_are_found_where_they_are(frame: int) -> None:
    image, box, (_, _, z) = van(frame)
    learned = learn_target(image, box, StatedWidth(2.0), CAMERA, "van")
    target = learned.target
    a, b = target.corners[target.segments[:, 0]], target.corners[target.segments[:, 1]]
    horizontal, vertical = a[:, 1] == b[:, 1], a[:, 0] == b[:, 0]
    np.testing.assert_array_equal(horizontal, ~vertical)
    assert 6 <= len(target.segments) <= 14
    # 0.15 px, five standard deviations of a line of ten edge points, each known to about 0.1 px
    tolerance = 0.15 * z / tiny_chase.F
    below = tiny_chase.CY + tiny_chase.F * tiny_chase.truth(frame)[1] / z - learned.center[1]  # the box's centre
    rows = a[horizontal, 1] - below * learned.target.nominal_range / tiny_chase.F
    for found, true in ((a[vertical, 0], TRUE_X), (rows, TRUE_Y)):
        off = np.abs(found[:, None] - np.array(true))
        assert off.min(axis=1).max() < tolerance, "every line lies on a true one"
        assert off.min(axis=0).max() < tolerance, "and every true one is found"
    assert target.nominal_range == pytest.approx(z, rel=tolerance / 2.0)
    ends, times = np.unique(target.segments, return_counts=True)
    assert (times >= 2).sum() >= 6, "corners are shared"


def test_the_start_is_where_the_model_lies() -> None:
    image, box, (x, _, z) = van(7)
    learned = learn_target(image, box, StatedWidth(2.0), CAMERA, "van")
    assert learned.center[0] == pytest.approx(tiny_chase.CX + tiny_chase.F * x / z, abs=0.15)
    drawn = learned.center + learned.target.corners * tiny_chase.F / learned.target.nominal_range
    np.testing.assert_allclose(drawn, learned.corners, atol=0.02)  # to the hundredth that the centre is rounded to
    assert yaml.safe_load(start_entry(learned))["start"] == {
        "frame": 0, "center": learned.center.tolist(), "scale": 1.0,
    }  # fmt: skip


def test_a_lens_does_not_bend_the_model() -> None:
    image, box, (_, _, z) = van(7)
    bent = Camera(CAMERA.image_size, CAMERA.K, np.array([-0.25, 0.05, 0.0, 0.0]))
    u, v = np.meshgrid(np.arange(256.0), np.arange(242.0))
    ideal = bent.undistort_points(np.stack([u, v], -1).reshape(-1, 2)).astype(np.float32).reshape(242, 256, 2)
    recorded = cv2.remap(image, ideal, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    target = learn_target(recorded, box, StatedWidth(2.0), bent, "van").target
    ends = target.corners[target.segments]
    upright = np.ptp(ends[:, :, 0], axis=1) < np.ptp(ends[:, :, 1], axis=1)
    assert np.abs(np.ptp(ends, axis=1).min(axis=1)).max() < 1e-9
    found = [min(np.array(TRUE_X) - x, key=abs) for x in ends[upright, 0, 0]]
    assert np.abs(found).max() < 0.25 * z / tiny_chase.F
    assert target.nominal_range == pytest.approx(z, rel=0.01)


def test_the_file_reads_back(tmp_path: Path) -> None:
    image, box, _ = van(3)
    learned = learn_target(image, box, StatedWidth(2.0), CAMERA, "Anna's van: #1")
    (tmp_path / "target.yaml").write_text(target_yaml(learned))
    target = load_target(tmp_path / "target.yaml")
    assert target.name == "Anna's van: #1"
    assert target.nominal_range == learned.target.nominal_range
    assert target.tolerance == learned.target.tolerance > 0
    np.testing.assert_array_equal(target.corners, learned.target.corners)
    np.testing.assert_array_equal(target.segments, learned.target.segments)


def test_a_wheel_beside_a_faint_side_is_not_taken_for_it() -> None:
    """The right side of the body cannot be told from what is behind it; 1.5 px beside it stands a short dark wheel."""
    image = np.full((242, 256), 110.0, np.float32)
    image[100:141, 100:157] = 60.0
    image[108:120, 110:147] = 140.0
    image[125:127, 100:157] = 20.0
    image[100:141, 157:] = 60.0  # the rest of the right half has the body's grey
    image[133:141, 153:159] = 10.0
    image = cv2.GaussianBlur(image, (0, 0), 0.6)
    learned = learn_target(image, (99.5, 99.5, 156.5, 140.5), StatedWidth(2.0), CAMERA, "van")
    f, sides = tiny_chase.F, 57.0
    assert learned.center[0] == pytest.approx(128.0, abs=0.2)
    assert learned.target.nominal_range == pytest.approx(f * 2.0 / sides, rel=0.007)
    # one side is an edge, the other is where the hand put it
    assert np.hypot(0.24, 0.9) < learned.relative_std * sides < np.hypot(0.4, 1.3)


def test_the_uncertainty_of_the_width_is_that_of_the_model() -> None:
    """Over hands that err by a pixel: the nominal range's error in units of what the tolerance makes of it."""
    z = []
    for frame in range(40):
        image, _, (x, y, far) = van(frame)
        rng = np.random.default_rng([frame, 1])
        size = np.array([[-1.0, -0.75], [1.0, 0.75]]) * tiny_chase.F / far
        box = (np.array([tiny_chase.CX, tiny_chase.CY]) + np.array([x, y]) * tiny_chase.F / far + size).ravel()
        target = learn_target(image, tuple(box + rng.normal(0, 1, 4)), StatedWidth(2.0), CAMERA, "van").target
        z.append((target.nominal_range / far - 1) / (target.tolerance / 2.0))
    assert np.sqrt(np.mean(np.square(z))) < 1.2


def test_a_line_runs_as_far_as_its_edge() -> None:
    image = np.full((60, 60), 100, np.float32)
    image[12:40, 20:] = 160  # one step up at x = 19.5, rows 12 to 39
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    (line,) = [line for line in find_lines(image, (5, 5, 55, 55)) if line.place < 40]
    assert line.place == pytest.approx(19.5, abs=0.01)
    assert (line.start, line.stop) == (pytest.approx(11.5, abs=1.5), pytest.approx(39.5, abs=1.5))


def test_ends_that_meet_share_a_corner() -> None:
    across, down = Line(10.0, 20.0, 50.0, 1.0), Line(51.0, 11.0, 40.0, 1.0)
    corners, segments = join_lines([across], [down], np.array([3.0, 3.0]))
    np.testing.assert_array_equal(corners[segments], [[[20, 10], [51, 10]], [[51, 10], [51, 40]]])
    assert len(corners) == 3
    corners, _ = join_lines([across], [Line(56.0, 11.0, 40.0, 1.0)], np.array([3.0, 3.0]))
    assert len(corners) == 4


def test_corners_have_names_enough() -> None:
    names = corner_names(100)
    assert names[:3] == ["a", "b", "c"] and names[25:28] == ["z", "aa", "ab"]
    assert len(set(names)) == 100


def test_the_picture_shows_the_lines() -> None:
    image, box, _ = van(3)
    learned = learn_target(image, box, StatedWidth(2.0), CAMERA, "van")
    picture = draw_target(learned, image).astype(int)
    assert max(picture.shape) >= 900
    warm = (picture[..., 2] - picture[..., 0] > 100).sum()  # the vertical lines
    cold = (picture[..., 0] - picture[..., 2] > 100).sum()
    assert warm > 500 and cold > 1000


@pytest.mark.parametrize(
    ("picture", "box", "width", "words"),
    [
        ("blank", (40, 40, 200, 200), 2.0, ["shows 0 horizontal and 0 vertical lines", "at least 2 of each"]),
        ("noise", (40, 40, 200, 200), 2.0, ["at least 2 of each"]),
        ("stripes", (40, 40, 200, 200), 2.0, ["and 0 vertical lines"]),
        ("van", (40, 40, 50, 200), 2.0, ["--box 40,40,50,200", "at least 16 px"]),
        ("van", (200, 40, 50, 200), 2.0, ["--box", "beyond x0"]),
        ("van", (40, 40, 300, 200), 2.0, ["--box", "outside the image of 256 × 242"]),
        ("van", (40, 40, float("nan"), 200), 2.0, ["--box"]),
        ("small", (4, 4, 40, 40), 2.0, ["has 64 × 48 pixels", "256 × 242"]),
    ],
)
def test_it_is_refused(picture: str, box: tuple[float, float, float, float], width: float, words: list[str]) -> None:
    rng = np.random.default_rng(1)
    images = {
        "blank": np.full((242, 256), 90.0),
        "noise": rng.normal(120, 2.0, (242, 256)),
        "stripes": np.tile(100 + 40 * (np.arange(242)[:, None] // 20 % 2), (1, 256)),
        "van": tiny_chase.picture(0),
        "small": np.zeros((48, 64)),
    }
    with pytest.raises(UnusableInput) as caught:
        learn_target(images[picture].astype(np.float32), box, StatedWidth(width), CAMERA, "x")
    for word in words:
        assert word in str(caught.value)


# --- the command ---------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(tiny_chase.CAMERA))
    cv2.imwrite(str(tmp_path / "van.png"), tiny_chase.picture(0))
    return tmp_path


def learn(folder: Path, *more: str, box: str = "", out: str = "target.yaml", width: str = "2.0±0.02"):
    box = box or ",".join(f"{v:.1f}" for v in van(0)[1])
    options = ["--box", box, "--width", width, "--camera", "camera.yaml", "-o", out, *more]
    return paceline("target", "learn", "van.png", *options, folder=folder)


def test_the_command_writes_a_model_and_its_image(folder: Path) -> None:
    done = learn(folder, "--name", "the van")
    assert done.returncode == 0, done.stderr
    assert {p.name for p in folder.iterdir()} == {"camera.yaml", "van.png", "target.yaml", "target.png"}
    assert load_target(folder / "target.yaml").name == "the van"
    assert "target.png" in done.stdout and "uncertain by ±" in done.stdout and not done.stderr
    assert re.search(
        r"\n\d horizontal and \d vertical lines, \d+ % of them mirrored about the middle, with \d\d grey levels of "
        r"contrast; one image determines its place to ± 0\.\d\d px and its distance to ± [01]\.\d\d? % \(95 %\)\n",
        done.stdout,
    )
    start = yaml.safe_load(done.stdout.splitlines()[-1])["start"]
    assert start["scale"] == 1.0 and len(start["center"]) == 2
    assert cv2.imread(str(folder / "target.png")).shape[0] > 300


def test_the_width_is_part_of_the_tolerance(folder: Path) -> None:
    tolerances = []
    for width in ("2.0±0", "2.0±0.10", "2.0+-0.10", "2.0"):
        done = learn(folder, width=width)
        assert done.returncode == 0, done.stderr
        target = load_target(folder / "target.yaml")
        tolerances.append(target.tolerance)
        assert target.width_assumed == ("as nothing is stated" in done.stderr) == (width == "2.0")
    sides, stated, typed, assumed = tolerances
    assert stated == typed == pytest.approx(np.hypot(sides, 0.1 / 1.96), rel=0.01)
    assert assumed == pytest.approx(np.hypot(sides, 0.06 / 1.96), rel=0.01)


def test_the_file_gives_the_name(folder: Path) -> None:
    assert learn(folder, out="blue_lorry.yaml").returncode == 0
    assert load_target(folder / "blue_lorry.yaml").name == "blue_lorry"


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"box": "1,2,3"}, ["--box 1,2,3", "four numbers"]),
        ({"box": "5,5,60,60"}, ["van.png: the box shows"]),
        ({"out": "van.png/target.yaml"}, ["van.png/target.yaml", "cannot be written"]),
        ({"out": "target.png"}, ["target.png", "YAML"]),
        ({"out": "."}, ["expected"]),
    ],
)
def test_the_command_refuses(more: dict[str, str], words: list[str], folder: Path) -> None:
    before = sorted(folder.iterdir())
    assert_one_line_error(learn(folder, **more), *words)
    assert sorted(folder.iterdir()) == before


def test_the_command_needs_the_camera_and_the_picture(folder: Path) -> None:
    options = ["--box", "1,2,3,4", "--width", "2", "-o", "t.yaml"]
    assert_one_line_error(paceline("target", "learn", "van.png", *options, folder=folder), "--camera")
    options += ["--camera", "camera.yaml"]
    (folder / "text.png").write_text("no picture")
    assert_one_line_error(paceline("target", "learn", "absent.png", "--box", "1,2,30,40", *options[2:], folder=folder),
                          "absent.png", "cannot be read")  # fmt: skip
    assert_one_line_error(paceline("target", "learn", "text.png", "--box", "1,2,30,40", *options[2:], folder=folder),
                          "text.png", "not an image")  # fmt: skip


def test_a_box_on_a_wall_is_doubted(folder: Path) -> None:
    """Windows at odd places: lines enough, but none of them mirrored."""
    wall = np.full((242, 256), 140.0, np.float32)
    for x, y, width, height in (
        (52, 40, 22, 34),
        (96, 60, 14, 26),
        (128, 44, 34, 20),
        (58, 96, 40, 24),
        (122, 84, 16, 44),
    ):
        wall[y : y + height, x : x + width] = 60.0
    cv2.imwrite(str(folder / "van.png"), cv2.GaussianBlur(wall, (0, 0), 0.7))
    done = learn(folder, box="46,36,176,136")
    assert done.returncode == 0 and (folder / "target.yaml").exists()
    assert "% of the lines, by length, are mirrored about the middle (at least 60 %" in done.stderr
    assert "is the whole rear in the box" in done.stderr


@pytest.mark.skipif(not KITTI.exists(), reason="the shared recordings are not here")
def test_a_real_wall_is_doubted_and_a_real_vehicle_not() -> None:
    from paceline.documents.loading import load_camera

    image = cv2.imread(str(KITTI / "frames" / "000000.png"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    camera = load_camera(KITTI / "camera.yaml")
    codes = [
        {notice.code for notice in learn_target(image, box, StatedWidth(1.8), camera, "x").notices}
        for box in ((556, 190, 641, 262), (46, 5, 169, 92), (328, 108, 474, 227))
    ]
    assert codes == [set(), {"target_not_symmetric"}, {"target_not_symmetric"}]


@pytest.mark.skipif(not KITTI.exists(), reason="the shared recordings are not here")
def test_a_real_hatchback() -> None:
    """The lines that one sees: both sides, the plate, the bumper, the ground."""
    from paceline.documents.loading import load_camera

    image = cv2.imread(str(KITTI / "frames" / "000000.png"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    learned = learn_target(
        image, (556, 190, 641, 262), StatedWidth(1.7), load_camera(KITTI / "camera.yaml"), "hatchback"
    )
    target = learned.target
    ends = learned.corners[target.segments]
    upright = np.ptp(ends[:, :, 0], axis=1) < np.ptp(ends[:, :, 1], axis=1)
    sides = np.sort(ends[upright, 0, 0])
    assert sides[0] == pytest.approx(555, abs=1.5) and sides[-1] == pytest.approx(639.5, abs=1.5)
    rows = ends[~upright, 0, 1]
    for seen in (224.2, 230.6, 263.0):  # top and bottom of the number plate, the ground, read off a magnified picture
        assert np.abs(rows - seen).min() < 1.0
    assert target.nominal_range == pytest.approx(721.5 * 1.7 / 84.5, rel=0.02)
