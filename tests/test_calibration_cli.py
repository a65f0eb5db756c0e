"""``paceline calibrate`` on rendered pictures: what it writes, what it says, what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from printed_intervals import rows_with_intervals
from run_command import assert_one_line_error, paceline

from paceline.calibration.boards import parse_board
from paceline.calibration.parameters import Poses
from paceline.documents.loading import load_rig
from paceline.reports import calibration as calibration_report
from paceline.simulation import boards
from paceline.simulation.boards import CalibrationSetup

BOARD = "charuco:7x5:0.09:0.065:DICT_4X4_50"
VIEWS, SIZE = 9, (800, 600)
MOVED, UNSEEN = 3, 6


@pytest.fixture(scope="session")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CalibrationSetup]:
    """Two folders of pictures; in one pair the board has moved between the exposures, one shows no board."""
    folder = tmp_path_factory.mktemp("board")
    rng = np.random.default_rng(3)
    setup = boards.random_setup(rng, parse_board(BOARD), VIEWS, SIZE)
    later = CalibrationSetup(setup.rig, SIZE, setup.board, Poses(setup.poses.R, setup.poses.t + [0.006, 0.004, 0]))
    for side in ("left", "right"):
        (folder / side).mkdir()
    for v in range(VIEWS):
        left, right = boards.render(setup, v, rng)
        if v == MOVED:
            right = boards.render(later, v, rng)[1]
        if v == UNSEEN:
            left[:], right[:] = 90, 90
        cv2.imwrite(str(folder / "left" / f"{v:03d}.png"), left)
        cv2.imwrite(str(folder / "right" / f"{v:03d}.png"), right)
    return folder, setup


@pytest.fixture
def pictures(filmed: tuple[Path, CalibrationSetup], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folders, to spoil, and to work in."""
    for side in ("left", "right"):
        shutil.copytree(filmed[0] / side, tmp_path / side)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(*arguments: str) -> str:
    """The one line on standard error of a command that ends with status 2 and leaves nothing behind."""
    before = sorted(Path().rglob("*"))
    done = paceline("calibrate", *arguments)
    assert_one_line_error(done)
    assert sorted(Path().rglob("*")) == before
    return done.stderr


def test_pictures_become_a_rig(
    filmed: tuple[Path, CalibrationSetup], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, setup = filmed
    draw, figures = calibration_report._draw, []
    monkeypatch.setattr(
        calibration_report, "_draw", lambda figure, calibration: (figures.append(figure), draw(figure, calibration))
    )
    out = tmp_path / "new" / "rig.yaml"
    done = paceline("calibrate", folder / "left", folder / "right", "--board", BOARD, "-o", out)
    assert done.returncode == 0, done.stderr
    assert sorted(p.name for p in out.parent.iterdir()) == ["rig.json", "rig.png", "rig.yaml"]
    assert f"{VIEWS - 2} of {VIEWS} used" in done.stdout
    assert "003.png is left out: the two images do not show the board in one place" in done.stderr
    assert "no board is seen in 006.png" in done.stderr
    for part in ("focal length x, px", "distance apart, m", "lens model", "20 m ±", "50 m ±", "80 m ±", "verdict"):
        assert part in done.stdout
    assert len(rows_with_intervals(done.stdout)) == 10
    (figure,) = figures
    explained = {text.get_text() for legend in figure.legends for text in legend.get_texts()}
    assert explained == {
        "corner of the board, used", "corner of the board, in a view left out", "error in the left image",
        "error in the right image", "median error", "view left out",
    }  # fmt: skip
    below = figure.legends[0].get_window_extent()
    assert all(axes.get_legend() is None and axes.get_tightbbox().y0 >= below.y1 for axes in figure.axes)

    rig, numbers = load_rig(out), json.loads((out.parent / "rig.json").read_text())
    std = dict(zip(numbers["parameters"], numbers["std"], strict=True))
    for side, camera in (("left", rig.left), ("right", rig.right)):
        true = setup.rig.lenses[0 if side == "left" else 1]
        for name, found, expected in (("fx", camera.K[0, 0], true[0]), ("cx", camera.K[0, 2], true[2])):
            assert abs(found - expected) < 5 * std[f"{side} {name}"], (side, name)
    assert rig.baseline == pytest.approx(float(np.linalg.norm(setup.rig.t)), rel=2e-3)
    assert rig.uncertainty is not None
    assert rig.uncertainty.covariance is not None
    assert max(rig.uncertainty.rotation_rad) < 1e-2
    C = np.array(numbers["covariance"])
    assert C.shape == (24, 24)
    np.testing.assert_allclose(np.sqrt(np.diag(C)), numbers["std"], rtol=1e-9)
    # rotation and translation are stated in rig.yaml as they were estimated
    np.testing.assert_allclose(rig.uncertainty.covariance[8:, 8:], C[18:, 18:], rtol=1e-6, atol=1e-15)
    assert [v["view"] for v in numbers["views"] if not v["used"]] == ["003.png"]
    assert {"none", "k1", "k1, k2"} <= numbers["held_out_px"].keys()
    picture = cv2.imread(str(out.parent / "rig.png"))
    assert picture is not None
    assert picture.shape[0] > 600


def test_videos_do_as_well(
    filmed: tuple[Path, CalibrationSetup], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = filmed
    for side in ("left", "right"):
        with av.open(tmp_path / f"{side}.mkv", "w") as container:
            stream = container.add_stream("ffv1", rate=5)
            stream.width, stream.height, stream.pix_fmt = *SIZE, "gray"
            for file in sorted((folder / side).iterdir()):
                frame = av.VideoFrame.from_ndarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), "gray")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    from paceline.calibration.board_views import collect_views

    views = collect_views(tmp_path / "left.mkv", tmp_path / "right.mkv", parse_board(BOARD))
    from_files = collect_views(folder / "left", folder / "right", parse_board(BOARD))
    assert [v.name for v in views.views][:2] == ["frame 0", "frame 1"]
    assert views.empty == [f"frame {UNSEEN}"]
    for a, b in zip(views.views, from_files.views, strict=True):
        np.testing.assert_array_equal(a.left.pixels, b.left.pixels)


@pytest.mark.parametrize(
    ("board", "message"),
    [("chessboard:9by6:0.05", "'9by6' is no COLUMNSxROWS"), ("charuco:11x8:0.06:0.045:DICT_9X9", "unknown dictionary")],
)
def test_a_wrong_board_is_refused(pictures: Path, board: str, message: str) -> None:
    assert message in refused("left", "right", "--board", board, "-o", "rig.yaml")


def test_another_board_than_the_one_filmed_is_refused(pictures: Path) -> None:
    other = "charuco:7x5:0.09:0.065:DICT_7X7_50"
    message = refused("left", "right", "--board", other, "-o", "rig.yaml")
    assert "no picture shows the board" in message


def test_a_missing_folder_a_wrong_name_and_a_bad_picture_are_refused(pictures: Path) -> None:
    def message(*arguments: str) -> str:
        return refused(*arguments)

    assert "left: is given for both cameras" in message("left", "left", "--board", BOARD, "-o", "rig.yaml")
    assert "nowhere: no such file or folder" in message("left", "nowhere", "--board", BOARD, "-o", "rig.yaml")
    assert "expected the name of a YAML file" in message("left", "right", "--board", BOARD, "-o", "rig.txt")
    (pictures / "left" / "004.png").write_bytes(b"\x89PNG\r\n\x1a\nbroken")
    assert "004.png: is truncated or damaged" in message("left", "right", "--board", BOARD, "-o", "rig.yaml")
    cv2.imwrite("left/004.png", np.zeros((100, 100), np.uint8))
    assert "has 100 × 100 pixels, the pictures before it 800 × 600" in message(
        "left", "right", "--board", BOARD, "-o", "rig.yaml"
    )


def test_files_that_do_not_pair_are_refused(pictures: Path) -> None:
    for k, file in enumerate(sorted((pictures / "right").iterdir())):
        file.rename(file.with_name(f"{'abcdefghi'[k]}.png"))
    (pictures / "right" / "i.png").unlink()
    message = refused("left", "right", "--board", BOARD, "-o", "rig.yaml")
    assert "left has 9 images and right 8" in message


def test_too_few_views_are_refused(pictures: Path) -> None:
    for side in ("left", "right"):
        for file in sorted((pictures / side).iterdir())[3:]:
            file.unlink()
    message = refused("left", "right", "--board", BOARD, "-o", "rig.yaml")
    assert "3 of 3 pairs show the board to both cameras; expected at least 5" in message
