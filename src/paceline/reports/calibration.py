"""Writes a calibration: rig.yaml, a plot of board coverage and reprojection errors, and all numbers as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from paceline.calibration.board_calibration import Calibration
from paceline.calibration.parameters import RIG_PARAMETER_NAMES
from paceline.cameras import VIEW_NAMES
from paceline.documents.rig_yaml import rig_yaml
from paceline.errors import UnusableInput
from paceline.reports.common.output_folder import write_all_or_none
from paceline.reports.common.plots import FILTER_COLOR, INK_COLOR, INTERVAL_COLOR, MUTED_COLOR, REFINED_COLOR, make_plot
from paceline.version import __version__

FIGURE_SIZE_IN = (9.4, 6.4)
MAX_LABELLED_VIEWS = 30  # views with a label under their bars


def write_calibration(calibration: Calibration, file: Path) -> list[Path]:
    """Writes rig.yaml to ``file`` and, beside it, the plot and the numbers; returns all three paths.

    Raises UnusableInput, and writes none of them, where one cannot be written.
    """
    plot = make_plot(
        "calibration",
        "Coverage by the board and reprojection errors",
        FIGURE_SIZE_IN,
        lambda figure: _draw(figure, calibration),
    )
    contents = {
        file: rig_yaml(calibration.rig, rig_comments(calibration)).encode(),
        file.with_suffix(".png"): plot.png,
        file.with_suffix(".json"): (json.dumps(calibration_data(calibration), indent=1) + "\n").encode(),
    }
    write_all_or_none(contents)
    return list(contents)


def check_rig_file_name(file: Path) -> None:
    """Raises UnusableInput where ``file`` is not a valid name for a new YAML file."""
    if file.suffix not in (".yaml", ".yml"):
        raise UnusableInput(f"--out {file}: expected the name of a YAML file to write, for instance rig.yaml")
    try:
        folder = file.is_dir()
    except OSError as error:  # a name that is too long
        raise UnusableInput(f"--out {file}: cannot be written ({error.strerror})") from error
    if folder:
        raise UnusableInput(f"--out {file}: is a folder; expected the name of a file to write")


def rig_comments(calibration: Calibration) -> list[str]:
    """The comments at the top of a calibrated rig.yaml."""
    c = calibration
    return [
        f"calibrated by paceline {__version__} from {len(c.used)} of {len(c.views.views)} views of a board",
        f"lens model {c.distortion}; residual of held-out views {c.cross_validation_px[c.distortion]:.3f} px (rms)",
    ]


def calibration_data(calibration: Calibration) -> dict[str, Any]:
    """All numbers of a calibration for JSON, in SI units and pixels."""
    c = calibration
    values = np.concatenate([c.fit.rig.lenses.ravel(), np.zeros(3), c.rig.t])
    errors = c.view_rms_px
    views = []
    for v, view in enumerate(c.views.views):
        entry: dict[str, Any] = {"view": view.name, "used": v in c.used}
        entry |= {f"{side}_corners": len(corners) for side, corners in zip(VIEW_NAMES, view.sides, strict=True)}
        if v in c.used:
            row = errors[c.used.index(v)]
            entry |= {f"{s}_rms_px": None if np.isnan(e) else float(e) for s, e in zip(VIEW_NAMES, row, strict=True)}
        else:
            entry["reason"] = c.rejected[v]
        views.append(entry)
    return {
        "board": vars(c.views.board),
        "parameters": list(RIG_PARAMETER_NAMES),
        "values": values.tolist(),
        "std": c.std.tolist(),
        "covariance": c.covariance.tolist(),
        "lens_model": c.distortion,
        "held_out_px": c.cross_validation_px,
        "corner_std_px": c.fit.sigma,
        "corner_std_by_views_px": float(np.sqrt(c.fit.cluster_variance)),
        "speed_std_share": [{"distance_m": e.distance, "along": e.along, "across": e.across} for e in c.effects],
        "views": views,
        "without_a_board": c.views.empty,
        "strays": c.outlier_corners,
        "advice": c.advice,
        "paceline": __version__,
    }


def _draw(figure: Figure, calibration: Calibration) -> None:
    grid = figure.add_gridspec(2, 2, height_ratios=(1.55, 1))
    for side, name in enumerate(VIEW_NAMES):
        _draw_coverage(figure.add_subplot(grid[0, side]), calibration, side, name)
    _draw_errors(figure.add_subplot(grid[1, :]), calibration)
    corners, errors = (figure.axes[i].get_legend_handles_labels() for i in (0, -1))
    handles, labels = corners[0] + errors[0], corners[1] + errors[1]
    figure.legend(handles, labels, loc="outside lower left", ncols=3, markerscale=4)


def _draw_coverage(axes: Axes, calibration: Calibration, side: int, name: str) -> None:
    c = calibration
    width, height = c.views.sizes[side]
    in_view = c.seen.side == side
    pixels = c.seen.pixels[in_view]
    axes.scatter(pixels[:, 0], pixels[:, 1], s=3, color=FILTER_COLOR, lw=0, label="corner of the board, used")
    left_out = [c.views.views[v].sides[side].pixels for v in c.rejected]
    if left_out:
        x, y = np.concatenate(left_out).T
        axes.scatter(x, y, s=3, color=REFINED_COLOR, lw=0, alpha=0.6, label="corner of the board, in a view left out")
    axes.set_title(f"{name} image, {len(pixels)} corners")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(True)
    axes.set_xticks([])
    axes.set_yticks([])


def _draw_errors(axes: Axes, calibration: Calibration) -> None:
    c = calibration
    errors = np.full((len(c.views.views), 2), np.nan)
    errors[c.used] = c.view_rms_px
    median = float(np.nanmedian(errors))
    top = max(1.25 * float(np.nanmax(errors)), 2 * median)
    place = np.arange(len(errors))
    for side, (name, color) in enumerate(zip(VIEW_NAMES, (FILTER_COLOR, MUTED_COLOR), strict=True)):
        axes.bar(place + (side - 0.5) * 0.38, errors[:, side], 0.36, color=color, label=f"error in the {name} image")
    axes.axhline(median, color=INK_COLOR, lw=0.8, ls=(0, (4, 3)), label="median error")
    for v in c.rejected:
        label = "view left out" if v == min(c.rejected) else None
        axes.axvspan(v - 0.45, v + 0.45, color=INTERVAL_COLOR, alpha=0.25, lw=0, label=label)
    axes.set_ylim(0, top)
    axes.set_title("error of each view, px (RMS of a coordinate)")
    axes.grid(axis="x", visible=False)
    axes.margins(x=0.01)
    names = [view.name for view in c.views.views]
    if len(names) <= MAX_LABELLED_VIEWS:
        axes.set_xticks(place, [n.rsplit(".", 1)[0][-12:] for n in names], rotation=60, ha="right", fontsize=7)
    else:
        axes.set_xlabel("view")
