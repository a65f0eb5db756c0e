"""``paceline calibrate``: calibrates a stereo rig from images of a board and writes rig.yaml."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import print_columns
from paceline.commands.progress_output import progress_bar
from paceline.exit_status import EXIT_DONE
from paceline.verdicts import message

if TYPE_CHECKING:
    from paceline.calibration.board_calibration import Calibration

MAX_GOOD_SPEED_SHARE, MAX_USABLE_SPEED_SHARE = (
    0.005,
    0.02,
)  # half a 95 % interval of a speed at VERDICT_DISTANCE_M metres, as a share of it


def calibrate(
    left: Annotated[
        Path,
        typer.Argument(metavar="LEFT", help="The left camera's images of the board: a folder, a pattern, a video."),
    ],
    right: Annotated[Path, typer.Argument(metavar="RIGHT", help="The right camera's images, taken at the same times.")],
    board: Annotated[
        str,
        typer.Option(
            metavar="BOARD",
            help="charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY, squares counted, or chessboard:COLUMNSxROWS:SQUARE, "
            "inner corners counted; sizes in metres.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("-o", "--out", help="The rig.yaml to write; a picture and numbers appear beside it.")
    ],
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Calibrate a stereo rig from images of a board in front of both cameras."""
    from paceline.calibration.board_calibration import calibrate as calibrate_views
    from paceline.calibration.board_views import collect_views
    from paceline.calibration.boards import parse_board
    from paceline.reports.calibration import check_rig_file_name, write_calibration

    described = parse_board(board)
    check_rig_file_name(out)
    with progress_bar("finding the board", sys.stderr.isatty() and not quiet) as advance:
        views = collect_views(left, right, described, advance)
    calibration = calibrate_views(views)
    written = write_calibration(calibration, out)
    if not quiet:
        _print(calibration)
        print(f"\n{out}; look at {written[1]}")
    return EXIT_DONE


def _print(c: Calibration) -> None:
    from paceline.number_format import align_decimals, format_half_width

    names, *columns = zip(*_lenses(c), *_pose(c), strict=True)
    print_columns([("", "left", "right"), *zip(names, *map(align_decimals, columns), strict=True)])
    print(f"\nviews       {len(c.used)} of {len(c.views.views) + len(c.views.empty)} used", end="")
    print(f", {c.outlier_corners} stray corners left out" if c.outlier_corners else "")
    models = ", ".join(f"{name} {error:.3f}" for name, error in c.cross_validation_px.items())
    print(f"lens model  {c.distortion}; error on views held out, px: {models}")
    effects = "   ".join(
        f"{e.distance:.0f} m ± {format_half_width(100 * c.coverage_factor * e.along)} %" for e in c.effects
    )
    print(f"speeds      {effects}   (95 %, from the calibration alone)")
    print(f"verdict     {verdict(c)}")
    for v, reason in c.rejected.items():
        print(f"note: {c.views.views[v].name} is left out: {reason}", file=sys.stderr)
    if c.views.empty:
        more = f" and {len(c.views.empty) - 8} more" if len(c.views.empty) > 8 else ""
        views = f"{', '.join(c.views.empty[:8])}{more}"
        print(f"note: {message('board_not_seen', views=views)}", file=sys.stderr)
    for notice in [*c.views.notices, *c.advice]:
        print(f"note: {notice}", file=sys.stderr)


def _lenses(c: Calibration) -> list[tuple[str, str, str]]:
    """A row for each parameter of the lenses, with half its 95 % interval."""
    from paceline.calibration.parameters import LENS_PARAMETERS, N_LENS
    from paceline.number_format import format_uncertain

    titles = dict(
        zip(LENS_PARAMETERS, ("focal length x, px", "focal length y, px", "centre x, px", "centre y, px"), strict=False)
    )
    rows = []
    for k, name in enumerate(LENS_PARAMETERS):
        if k < 4 or k in c.fit.free:
            left, right = (
                format_uncertain(c.fit.rig.lenses[side, k], c.coverage_factor * c.std[side * N_LENS + k])
                for side in (0, 1)
            )
            rows.append((titles.get(name, name), left, right))
    return rows


def _pose(c: Calibration) -> list[tuple[str, str, str]]:
    import cv2
    import numpy as np

    from paceline.calibration.parameters import POSE_SLICE
    from paceline.number_format import format_uncertain

    std = c.coverage_factor * c.std[POSE_SLICE]
    angles = np.degrees(np.ravel(cv2.Rodrigues(c.rig.R)[0]))
    along = c.rig.t / c.rig.baseline
    of_baseline = c.coverage_factor * float(np.sqrt(along @ c.covariance[POSE_SLICE, POSE_SLICE][3:, 3:] @ along))
    rows = [("distance apart, m", "", format_uncertain(c.rig.baseline, of_baseline))]
    for k, axis in enumerate("xyz"):
        rows.append((f"turned about {axis}, degrees", "", format_uncertain(angles[k], float(np.degrees(std[k])))))
    return rows


def verdict(c: Calibration) -> str:
    """One line that rates the calibration by the uncertainty of speeds that it causes."""
    from paceline.calibration.speed_sensitivity import VERDICT_DISTANCE_M
    from paceline.number_format import format_half_width

    share = c.coverage_factor * next(e.along for e in c.effects if e.distance == VERDICT_DISTANCE_M)
    statement = (
        f"the calibration leaves speeds at {VERDICT_DISTANCE_M:.0f} m unsure by {format_half_width(100 * share)} %"
    )
    if share <= MAX_GOOD_SPEED_SHARE:
        return f"good: {statement}"
    if share <= MAX_USABLE_SPEED_SHARE:
        return f"usable: {statement}; more views, larger in the picture and more tilted, make it better"
    advice = "add views, larger in the picture and more tilted"
    return f"too unsure for speeds at {VERDICT_DISTANCE_M:.0f} m: {statement}; {advice}"
