"""Lanes between the lines of a road, with their widths, and their centre lines as paths of a clip.yaml."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig, perturbed_rigs
from paceline.errors import UnusableInput
from paceline.geometry import triangulate
from paceline.lanes.line_adjustment import RoadModel
from paceline.lanes.line_detection import CURVE_TERMS, UNIT_M, lateral_offset
from paceline.speed.configuration import DEFAULTS
from paceline.speed.geometry.path_reconstruction import reconstruct
from paceline.speed.geometry.paths import Path, jacobian
from paceline.verdicts import NO_REASON, Message, message

WIDTH_SAMPLES = 15  # positions along a lane at which its width is measured
MIN_LENGTH_M = 8.0  # least length over which both lines of a lane run beside each other
MAX_LATERAL_STD_M = 0.25  # standard deviation across the road beyond which a lane is not drawn
DRAWN_POINTS = 24  # points of a drawn path in each view
MAX_STRAIGHT_RMS_PX = 0.6  # of a drawing about a straight line: beyond in either view, a path is a curve
MIN_DRAWN_PX = 40.0  # least length of a drawn path in each view


@dataclass(frozen=True, eq=False)
class RoadLine:
    """A line of the road as it was found. ``points`` (N, 3) in space; ``lateral_std`` (N,) m across the road."""

    id: str
    kind: str
    points: Array
    lateral_std: Array


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane between the lines named ``between``. ``width`` and its standard deviation ``width_std`` in metres, the
    calibration's part included; ``shape``, ``left`` and ``right`` (N, 2), pixels as recorded, are its centre line drawn
    in each view, ``path`` their reconstruction, None with a ``reason`` where the two views do not determine it."""

    between: tuple[str, str]
    width: float
    width_std: float
    shape: str
    left: Array
    right: Array
    path: Path | None
    reason: Message = NO_REASON


def road_lines(road: RoadModel) -> list[RoadLine]:
    """The lines of a road, from left to right, numbered from 1."""
    lines = []
    for k, (curve, line) in enumerate(zip(road.curves, road.lines, strict=True)):
        s = np.linspace(*line.span, 60)
        points = road.surface.points(road.alignment.to_ground(s, lateral_offset(curve, s)))
        lines.append(RoadLine(str(k + 1), line.kind, points, _lateral_std(road, k, s)))
    return lines


def _lateral_std(road: RoadModel, k: int, s: Array) -> Array:
    """Standard deviations (N,) m across the road of line k at ``s`` (N,)."""
    own_terms = slice(6 + CURVE_TERMS * k, 6 + CURVE_TERMS * (k + 1))
    powers = (s[:, None] / UNIT_M) ** np.arange(CURVE_TERMS)
    return np.asarray(np.sqrt(np.maximum(((powers @ road.covariance[own_terms, own_terms]) * powers).sum(1), 0.0)))


def propose_lanes(
    rig: StereoRig, road: RoadModel, widths: tuple[float, float] = DEFAULTS.lanes.width
) -> tuple[list[Lane], list[Message]]:
    """The lanes between neighbouring lines, from left to right, and for every other pair the reason why it is no lane.
    ``widths`` are the least and the greatest width, m."""
    lanes, remarks = [], []
    for k in range(len(road.lines) - 1):
        a, b = road.lines[k], road.lines[k + 1]
        start, end = max(a.span[0], b.span[0]), min(a.span[1], b.span[1])
        names = str(k + 1), str(k + 2)
        if end - start < MIN_LENGTH_M:
            remarks.append(
                message(
                    "lines_not_beside_each_other",
                    first=names[0],
                    second=names[1],
                    shared_m=max(end - start, 0.0),
                    min_shared_m=MIN_LENGTH_M,
                )
            )
            continue
        width, std = _width(rig, road, k, np.linspace(start, end, WIDTH_SAMPLES))
        if not widths[0] <= width <= widths[1]:
            remarks.append(
                message(
                    "lane_width_implausible",
                    first=names[0],
                    second=names[1],
                    width_m=width,
                    min_width_m=widths[0],
                    max_width_m=widths[1],
                )
            )
            continue
        first, last = _known_stretch(road, k, min(a.span[0], b.span[0]), max(a.span[1], b.span[1]))
        if last - first < MIN_LENGTH_M:
            remarks.append(
                message(
                    "lines_uncertain",
                    first=names[0],
                    second=names[1],
                    max_std_m=MAX_LATERAL_STD_M,
                    known_m=last - first,
                    min_known_m=MIN_LENGTH_M,
                )
            )
            continue
        lanes.append(_lane(rig, road, k, names, (width, std), (first, last)))
    return lanes, remarks


def _known_stretch(road: RoadModel, k: int, first: float, last: float) -> tuple[float, float]:
    """The longest stretch between ``first`` and ``last`` (m along) on which lines k and k + 1 are known to
    `MAX_LATERAL_STD_M`."""
    s = np.linspace(first, last, 200)
    known = np.maximum(_lateral_std(road, k, s), _lateral_std(road, k + 1, s)) < MAX_LATERAL_STD_M
    stretches = [part[part >= 0] for part in np.split(np.where(known, np.arange(200), -1), np.flatnonzero(~known))]
    longest = max(stretches, key=len)
    return (float(s[longest[0]]), float(s[longest[-1]])) if len(longest) else (first, first)


def _width(rig: StereoRig, road: RoadModel, k: int, s: Array) -> tuple[float, float]:
    """Mean width (m) between lines k and k + 1 over ``s`` (N,), weighted by how well it is known where, and its
    standard deviation, the calibration's part included."""
    own_terms = np.r_[0:6, 6 + CURVE_TERMS * k : 6 + CURVE_TERMS * (k + 2)]

    def sides(x: Array) -> tuple[Array, Array]:
        surface = road.surface.with_heights(x[:6])
        curves = x[6:].reshape(2, CURVE_TERMS)
        dense = np.linspace(s[0] - 5.0, s[-1] + 5.0, 400)
        return (
            surface.points(road.alignment.to_ground(s, lateral_offset(curves[0], s))),
            surface.points(road.alignment.to_ground(dense, lateral_offset(curves[1], dense))),
        )

    x = np.concatenate([road.surface.heights, road.curves[k], road.curves[k + 1]])
    J = jacobian(lambda x: _distances(*sides(x)), x, 1e-4)
    covariance = J @ road.covariance[np.ix_(own_terms, own_terms)] @ J.T
    weight = 1 / np.diag(covariance)
    weight /= weight.sum()
    first, second = sides(x)
    width = float(weight @ _distances(first, second))
    variance = float(weight @ covariance @ weight)
    if rig.uncertainty:
        for perturbed in perturbed_rigs(rig, rig.uncertainty):
            shifted = [triangulate(perturbed, *rig.project(points)) for points in (first, second)]
            variance += (float(weight @ _distances(shifted[0], shifted[1])) - width) ** 2
    return width, float(np.sqrt(variance))


def _distances(points: Array, line: Array) -> Array:
    """Distances (N,) of ``points`` (N, 3) from the polyline (M, 3)."""
    start, step = line[:-1], np.diff(line, axis=0)
    offset = points[:, None] - start
    share = np.clip((offset * step).sum(-1) / (step * step).sum(-1), 0, 1)
    return np.asarray(np.linalg.norm(offset - share[..., None] * step, axis=-1).min(1))


def _lane(
    rig: StereoRig,
    road: RoadModel,
    k: int,
    names: tuple[str, str],
    width: tuple[float, float],
    span: tuple[float, float],
) -> Lane:
    middle = (road.curves[k] + road.curves[k + 1]) / 2

    def centre(s: Array) -> Array:
        return road.surface.points(road.alignment.to_ground(s, lateral_offset(middle, s)))

    drawn = [_draw(rig, side, centre, span) for side in (0, 1)]
    shape = "line" if max(map(_straightness_rms, drawn)) < MAX_STRAIGHT_RMS_PX else "curve"
    recorded = [camera.distort_points(pixels) for camera, pixels in zip(rig.cameras, drawn, strict=True)]
    path, reason = None, NO_REASON
    name = f"between lines {names[0]} and {names[1]}"
    length = float(min(np.linalg.norm(np.ptp(pixels, axis=0)) for pixels in drawn))
    if length < MIN_DRAWN_PX:
        reason = message("lane_outside_views", path=name, length_px=length, min_length_px=MIN_DRAWN_PX)
    else:
        try:
            path = reconstruct(name, shape, rig, drawn[0], drawn[1])
        except UnusableInput as error:
            reason = message("lane_not_reconstructible", problem=error)
    return Lane(names, *width, shape, recorded[0], recorded[1], path, reason)


def _draw(rig: StereoRig, side: int, centre: Callable[[Array], Array], span: tuple[float, float]) -> Array:
    """Ideal pixels (N, 2) of a line in space inside a view, from far to near, evenly in the root of the length, as a
    perspective crowds what is far."""
    pixels = rig.project(centre(np.linspace(span[1], span[0], 600)))[side]
    inside = ((pixels > 1) & (pixels < np.array(rig.cameras[side].image_size) - 2)).all(1)
    pixels = pixels[inside]
    if len(pixels) < 2:
        return np.zeros((1, 2))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    lengths = length[-1] * np.linspace(0, 1, DRAWN_POINTS) ** 1.5
    return np.column_stack([np.interp(lengths, length, c) for c in pixels.T])


def _straightness_rms(pixels: Array) -> float:
    """Root mean square departure of pixels (N, 2) from a straight line, px."""
    return float(np.linalg.svd(pixels - pixels.mean(0), compute_uv=False)[1] / np.sqrt(len(pixels)))
