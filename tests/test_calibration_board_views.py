"""From corners to a rig: lens models, views that are wrong, intervals that hold, boards that are found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from paceline.calibration import board_calibration, outlier_views
from paceline.calibration.board_calibration import Calibration, calibrate, empty_cells
from paceline.calibration.board_views import BoardView, BoardViews
from paceline.calibration.boards import Board, Corners, board_detector, matching_order, parse_board
from paceline.calibration.parameters import N_LENS, Poses, parameter_step
from paceline.errors import UnusableInput
from paceline.simulation import boards
from paceline.simulation.boards import CalibrationSetup

BOARD = parse_board("charuco:7x6:0.08:0.06:DICT_5X5_100")
SIGMA = 0.15


def corners(seed: int, views: int = 14, distortion: int = 2) -> tuple[CalibrationSetup, list[tuple[Corners, Corners]]]:
    rng = np.random.default_rng(seed)
    setup = boards.random_setup(rng, BOARD, views, distortion=distortion)
    exact = boards.project_board(setup.poses, setup.rig, BOARD, setup.size)
    return setup, boards.corners_by_view(boards.add_noise(rng, exact, SIGMA), BOARD)


def views_of(setup: CalibrationSetup, pairs: list[tuple[Corners, Corners]]) -> BoardViews:
    views = [BoardView(f"{i:02d}.png", *pair) for i, pair in enumerate(pairs)]
    return BoardViews(BOARD, views, [], (setup.size, setup.size), [])


def calibrated(seed: int, **options: int) -> tuple[CalibrationSetup, Calibration]:
    setup, pairs = corners(seed, **options)
    return setup, calibrate(views_of(setup, pairs))


# --- intervals -----------------------------------------------------------------------------------------------------


def test_the_true_parameters_are_within_their_intervals() -> None:
    """Six rigs, all parameters: 95 % each, not independent within a rig; benchmarks/calibration.py has more."""
    inside, of_rig = [], []
    for seed in range(6):
        setup, found = calibrated(seed, distortion=(0, 1, 2, 4)[seed % 4])
        stated = found.std > 0
        share = np.abs(parameter_step(found.fit.rig, setup.rig)[stated]) / (found.coverage_factor * found.std[stated])
        inside += (share <= 1).tolist()
        of_rig.append((share <= 1).mean())
    assert np.mean(inside) > 0.88
    assert min(of_rig) > 0.5


@pytest.mark.parametrize("k1", [0.0, -0.25])
def test_the_lens_model_is_chosen_by_evidence(k1: float) -> None:
    setup, _ = corners(41)
    setup.rig.lenses[:, 4:] = 0.0
    setup.rig.lenses[:, 4] = k1
    exact = boards.project_board(setup.poses, setup.rig, BOARD, setup.size)
    pairs = boards.corners_by_view(boards.add_noise(np.random.default_rng(1), exact, SIGMA), BOARD)
    found = calibrate(views_of(setup, pairs))
    assert found.distortion == min(found.cross_validation_px, key=lambda name: found.cross_validation_px[name])
    assert (found.cross_validation_px["none"] > 1.2 * found.cross_validation_px["k1"]) == (k1 != 0)
    assert found.cross_validation_px["k1"] == pytest.approx(SIGMA, rel=0.12)


# --- wrong views ---------------------------------------------------------------------------------------------------


def moved(pair: tuple[Corners, Corners]) -> tuple[Corners, Corners]:
    return pair[0], Corners(pair[1].ids, pair[1].pixels + [4.0, -3.0])


def blurred(pair: tuple[Corners, Corners]) -> tuple[Corners, Corners]:
    noise = np.random.default_rng(5).normal(0, 8 * SIGMA, pair[0].pixels.shape)
    return Corners(pair[0].ids, pair[0].pixels + noise), pair[1]


def mistaken(pair: tuple[Corners, Corners]) -> tuple[Corners, Corners]:
    return pair[0], Corners(pair[1].ids, np.random.default_rng(6).permutation(pair[1].pixels))


@pytest.fixture(scope="module")
def clean() -> Calibration:
    return calibrated(51)[1]


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (moved, "do not show the board in one place"),
        (blurred, "in the left image"),
        (mistaken, "in the right image"),
    ],
)
def test_a_wrong_view_is_found_and_named(clean: Calibration, spoil: object, said: str) -> None:
    setup, pairs = corners(51)
    pairs[4] = spoil(pairs[4])  # type: ignore[operator]
    found = calibrate(views_of(setup, pairs))
    assert list(found.rejected) == [4]
    assert said in found.rejected[4]
    assert 4 not in found.used
    gap = np.abs(parameter_step(found.fit.rig, clean.fit.rig)) / np.maximum(clean.std, 1e-300)
    assert gap[clean.std > 0].max() < 2


def test_good_views_are_all_used() -> None:
    _, found = calibrated(52, views=20)
    assert not found.rejected
    assert found.used == list(range(20))


def test_a_third_of_outlier_views_has_no_effect() -> None:
    setup, pairs = corners(53, views=15)
    for v, spoil in zip((0, 3, 6, 9, 12), (moved, blurred, mistaken, moved, mistaken), strict=True):
        pairs[v] = spoil(pairs[v])
    assert sorted(calibrate(views_of(setup, pairs)).rejected) == [0, 3, 6, 9, 12]


def test_pairs_that_do_not_belong_together_are_refused() -> None:
    setup, pairs = corners(54)
    shifted = [(pairs[i][0], pairs[(i + 1) % len(pairs)][1]) for i in range(len(pairs))]
    with pytest.raises(UnusableInput, match="most pairs fit no common rig .* taken at the same time"):
        calibrate(views_of(setup, shifted))


def test_swapped_cameras_are_refused() -> None:
    setup, pairs = corners(56)
    with pytest.raises(UnusableInput, match="left and right are swapped"):
        calibrate(views_of(setup, [(right, left) for left, right in pairs]))


def test_a_view_of_one_camera_alone_helps_its_lens() -> None:
    setup, pairs = corners(55)
    nothing = Corners(np.empty(0, np.int64), np.empty((0, 2)))
    pairs[2], pairs[7] = (pairs[2][0], nothing), (nothing, pairs[7][1])
    found = calibrate(views_of(setup, pairs))
    assert not found.rejected
    assert np.isnan(found.view_rms_px[[2, 7], [1, 0]]).all()
    share = np.abs(parameter_step(found.fit.rig, setup.rig)) / np.maximum(found.std, 1e-300)
    assert share[found.std > 0].max() < 5


def test_outliers_are_relative_to_the_spread_of_the_others() -> None:
    even = np.array([0.1, 0.11, 0.09, 0.1, 0.12, 0.1])
    assert outlier_views.outliers(np.append(even, 0.2)).tolist() == [False] * 6 + [True]
    varied = np.array([0.1, 0.3, 0.05, 0.2, 0.08, 0.15])
    assert not outlier_views.outliers(np.append(varied, 0.5)).any()
    assert outlier_views.outliers(np.append(even, np.nan))[-1]


# --- what is missing -----------------------------------------------------------------------------------------------


def test_too_few_views_are_refused() -> None:
    setup, pairs = corners(61)
    with pytest.raises(UnusableInput, match="4 of 4 pairs show the board to both cameras; expected at least 5"):
        calibrate(views_of(setup, pairs[:4]))


def test_a_board_that_is_never_tilted_is_refused_or_reported() -> None:
    rng = np.random.default_rng(62)
    setup = boards.random_setup(rng, BOARD, 12)
    flat = Poses(np.tile(np.eye(3), (12, 1, 1)), setup.poses.t)
    exact = boards.project_board(flat, setup.rig, BOARD, setup.size)
    pairs = boards.corners_by_view(boards.add_noise(rng, exact, SIGMA), BOARD)
    with pytest.raises(UnusableInput, match="add views in which the board is tilted"):
        calibrate(views_of(setup, pairs))


def test_advice_names_what_is_missing() -> None:
    _, found = calibrated(63, views=8)
    assert any(text.startswith("only 8 views are used") for text in found.advice)
    assert empty_cells(np.array([[10.0, 10.0], [1270.0, 950.0]]), (1280, 960)).count("top left") == 0
    assert "bottom left" in empty_cells(np.array([[10.0, 10.0]]), (1280, 960))
    everywhere = np.stack(np.meshgrid(np.arange(0, 1280, 50), np.arange(0, 960, 50)), -1).reshape(-1, 2)
    assert empty_cells(everywhere.astype(float), (1280, 960)) == []


# --- boards --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "columns", "rows", "corners"),
    [
        ("charuco:11x8:0.06:0.045:DICT_5X5_100", 11, 8, 70),
        ("charuco:7x5:0.1:0.07:4X4_50", 7, 5, 24),
        ("chessboard:9x6:0.05", 9, 6, 54),
    ],
)
def test_a_board_is_parsed_from_its_description(text: str, columns: int, rows: int, corners: int) -> None:
    board = parse_board(text)
    assert (board.columns, board.rows, len(board.points)) == (columns, rows, corners)
    assert board.points[1, 0] == pytest.approx(board.square)
    assert parse_board("charuco:11x8:0.06:0.045:DICT_5X5_100:legacy").legacy


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected charuco:"),
        ("charuco:11x8", "expected charuco:"),
        ("chessboard:9x6:0.05:0.03", "expected charuco:"),
        ("checkerboard:9x6:0.05", "expected charuco:"),
        ("chessboard:9by6:0.05", "'9by6' is no COLUMNSxROWS"),
        ("chessboard:2x6:0.05", "expected at least 3x3"),
        ("chessboard:900x6:0.05", "more than 100"),
        ("chessboard:9x6:fifty", "square 'fifty' is no number"),
        ("chessboard:9x6:50", "expected metres"),
        ("chessboard:9x6:nan", "expected metres"),
        ("charuco:11x8:0.06:0.07:DICT_5X5_100", "is not smaller than the square"),
        ("charuco:11x8:0.06:0.045:DICT_9X9_100", "unknown dictionary"),
        ("charuco:30x20:0.06:0.045:DICT_4X4_50", "hold 300 markers; DICT_4X4_50 has 50"),
    ],
)
def test_a_name_that_means_no_board_is_refused(text: str, said: str) -> None:
    with pytest.raises(UnusableInput) as refused:
        parse_board(text)
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "text", ["charuco:9x7:0.06:0.045:DICT_5X5_100", "charuco:6x5:0.09:0.06:DICT_APRILTAG_36h11", "chessboard:8x6:0.06"]
)
def test_corners_are_found_where_they_are(text: str) -> None:
    board = parse_board(text)
    rng = np.random.default_rng(71)
    setup = boards.random_setup(rng, board, 1, (1024, 768), distortion=5)
    exact = boards.project_board(setup.poses, setup.rig, board, setup.size)
    find = board_detector(board)
    for side, picture in enumerate(boards.render(setup, 0, rng)):
        found = find(picture.astype(np.float32))
        mine = exact.select(exact.side == side)
        assert len(found) >= min(0.5 * len(board.points), board.min_corners)
        if board.marker is None and np.linalg.norm(found.pixels[0] - mine.pixels[0]) > 20:
            found = Corners(found.ids, found.pixels[::-1].copy())  # the same board, turned by half a turn
        ids = np.abs(mine.points[:, None] - board.points).sum(-1).argmin(1)
        _, i, j = np.intersect1d(found.ids, ids, return_indices=True)
        off = found.pixels[i] - mine.pixels[j]
        assert np.abs(off.mean(0)).max() < 0.03
        assert np.sqrt((off**2).mean()) < 0.12


def test_a_picture_without_a_board_holds_no_corners() -> None:
    noise = np.random.default_rng(0).uniform(0, 255, (240, 320)).astype(np.float32)
    for text in ("charuco:9x7:0.06:0.045:DICT_5X5_100", "chessboard:8x6:0.06"):
        assert len(board_detector(parse_board(text))(noise)) == 0


def test_a_chessboard_is_counted_from_the_same_end_in_both_views() -> None:
    board = Board(4, 3, 0.05)
    ids, pixels = np.arange(12), 100 * board.points[:, :2] + 50
    left, right = Corners(ids, pixels), Corners(ids, pixels[::-1].copy())
    np.testing.assert_array_equal(matching_order(left, right).pixels, pixels)
    assert matching_order(left, left) is left


def test_the_mixture_is_the_chosen_models_own_where_the_others_are_out_of_the_question() -> None:
    setup, pairs = corners(81)
    seen = boards.project_board(setup.poses, setup.rig, BOARD, setup.size)
    seen = boards.add_noise(np.random.default_rng(2), seen, SIGMA)
    models = board_calibration.fit_lens_models(setup.rig, setup.poses, seen)
    alone = {
        name: m if name == "k1, k2" else replace(m, squared_errors=m.squared_errors + 100) for name, m in models.items()
    }
    np.testing.assert_allclose(
        board_calibration.model_averaged_covariance(alone, "k1, k2"), models["k1, k2"].fit.covariance
    )
    mixed = board_calibration.model_averaged_covariance(models, "k1, k2")
    assert mixed[N_LENS + 8, N_LENS + 8] > 0  # k3, which the chosen model holds at zero, is in doubt all the same
    assert np.linalg.eigvalsh(mixed).min() > -1e-12
    assert len(pairs) == 14
