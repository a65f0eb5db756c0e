"""Lanes between the lines of a road, with their widths, and their centre lines as paths of a clip.yaml."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.cameras import StereoRig, perturbed_rigs
from paceline.errors import UnusableInput
from paceline.geometry import triangulate
from paceline.lanes.line_adjustment import Road
from paceline.lanes.line_detection import TERMS, UNIT, along
from paceline.speed.geometry.path_reconstruction import reconstruct
from paceline.speed.geometry.paths import Path, jacobian
from paceline.verdicts import NO_REASON, Message, message

NARROWEST, WIDEST = 2.2, 5.5  # m between the lines of a lane
SAMPLES = 15  # places along a lane at which its width is measured
SHORTEST = 8.0  # m that both lines of a lane must run beside each other
UNCERTAIN = 0.25  # m, the standard deviation across beyond which a lane is not drawn
DRAWN = 24  # points of a drawn path in each view
STRAIGHT = 0.6  # px, rms: a path is a curve where its drawing departs more from a line in either view
SMALLEST = 40.0  # px that a drawn path must be long in each view


@dataclass(frozen=True, eq=False)
class Line:
    """A line of the road as it was found. ``points`` (N, 3) in space; ``sigma`` (N,) m across the road."""

    id: str
    kind: str
    points: Array
    sigma: Array


@dataclass(frozen=True, eq=False)
class Lane:
    """A lane between the lines named ``between``. ``width`` and its standard deviation ``width_std`` in metres, the
    calibration's part included; ``shape``, ``left`` and ``right`` (N, 2), pixels as recorded, are its centre line drawn
    in each view, ``path`` what they reconstruct to, None with a ``reason`` where the two views do not determine it."""

    between: tuple[str, str]
    width: float
    width_std: float
    shape: str
    left: Array
    right: Array
    path: Path | None
    reason: Message = NO_REASON


def lines_of(road: Road) -> list[Line]:
    """The lines of a road, from left to right, numbered from 1."""
    found = []
    for k, (curve, trace) in enumerate(zip(road.curves, road.lines, strict=True)):
        s = np.linspace(*trace.span, 60)
        points = road.surface.points(road.course.to_ground(s, along(curve, s)))
        found.append(Line(str(k + 1), trace.kind, points, _sigma(road, k, s)))
    return found


def _sigma(road: Road, k: int, s: Array) -> Array:
    """Standard deviations (N,) m across the road of line k at ``s`` (N,)."""
    mine = slice(6 + TERMS * k, 6 + TERMS * (k + 1))
    powers = (s[:, None] / UNIT) ** np.arange(TERMS)
    return np.asarray(np.sqrt(np.maximum(((powers @ road.covariance[mine, mine]) * powers).sum(1), 0.0)))


def propose(rig: StereoRig, road: Road) -> tuple[list[Lane], list[Message]]:
    """The lanes between neighbouring lines, from left to right, and a remark on every pair that makes none."""
    lanes, remarks = [], []
    for k in range(len(road.lines) - 1):
        a, b = road.lines[k], road.lines[k + 1]
        start, end = max(a.span[0], b.span[0]), min(a.span[1], b.span[1])
        names = str(k + 1), str(k + 2)
        if end - start < SHORTEST:
            remarks.append(
                message(
                    "lines_not_beside_each_other",
                    first=names[0],
                    second=names[1],
                    shared_m=max(end - start, 0.0),
                    min_shared_m=SHORTEST,
                )
            )
            continue
        width, std = _width(rig, road, k, np.linspace(start, end, SAMPLES))
        if not NARROWEST <= width <= WIDEST:
            remarks.append(
                message(
                    "lane_width_implausible",
                    first=names[0],
                    second=names[1],
                    width_m=width,
                    min_width_m=NARROWEST,
                    max_width_m=WIDEST,
                )
            )
            continue
        first, last = _certain(road, k, min(a.span[0], b.span[0]), max(a.span[1], b.span[1]))
        if last - first < SHORTEST:
            remarks.append(
                message(
                    "lines_uncertain",
                    first=names[0],
                    second=names[1],
                    max_std_m=UNCERTAIN,
                    known_m=last - first,
                    min_known_m=SHORTEST,
                )
            )
            continue
        lanes.append(_lane(rig, road, k, names, (width, std), (first, last)))
    return lanes, remarks


def _certain(road: Road, k: int, first: float, last: float) -> tuple[float, float]:
    """The longest stretch between ``first`` and ``last`` (m along) on which lines k and k + 1 are known well enough."""
    s = np.linspace(first, last, 200)
    known = np.maximum(_sigma(road, k, s), _sigma(road, k + 1, s)) < UNCERTAIN
    stretches = [part[part >= 0] for part in np.split(np.where(known, np.arange(200), -1), np.flatnonzero(~known))]
    longest = max(stretches, key=len)
    return (float(s[longest[0]]), float(s[longest[-1]])) if len(longest) else (first, first)


def _width(rig: StereoRig, road: Road, k: int, s: Array) -> tuple[float, float]:
    """Mean width (m) between lines k and k + 1 over ``s`` (N,), weighted by how well it is known where, and its
    standard deviation, the stated calibration's part included."""
    mine = np.r_[0:6, 6 + TERMS * k : 6 + TERMS * (k + 2)]

    def sides(x: Array) -> tuple[Array, Array]:
        surface = road.surface.with_heights(x[:6])
        curves = x[6:].reshape(2, TERMS)
        dense = np.linspace(s[0] - 5.0, s[-1] + 5.0, 400)
        return (
            surface.points(road.course.to_ground(s, along(curves[0], s))),
            surface.points(road.course.to_ground(dense, along(curves[1], dense))),
        )

    x = np.concatenate([road.surface.heights, road.curves[k], road.curves[k + 1]])
    J = jacobian(lambda x: _distances(*sides(x)), x, 1e-4)
    covariance = J @ road.covariance[np.ix_(mine, mine)] @ J.T
    weight = 1 / np.diag(covariance)
    weight /= weight.sum()
    first, second = sides(x)
    width = float(weight @ _distances(first, second))
    variance = float(weight @ covariance @ weight)
    if rig.uncertainty:
        for moved in perturbed_rigs(rig, rig.uncertainty):
            shifted = [triangulate(moved, *rig.project(points)) for points in (first, second)]
            variance += (float(weight @ _distances(shifted[0], shifted[1])) - width) ** 2
    return width, float(np.sqrt(variance))


def _distances(points: Array, line: Array) -> Array:
    """Distances (N,) of ``points`` (N, 3) from the polyline (M, 3)."""
    start, step = line[:-1], np.diff(line, axis=0)
    offset = points[:, None] - start
    share = np.clip((offset * step).sum(-1) / (step * step).sum(-1), 0, 1)
    return np.asarray(np.linalg.norm(offset - share[..., None] * step, axis=-1).min(1))


def _lane(
    rig: StereoRig, road: Road, k: int, names: tuple[str, str], width: tuple[float, float], span: tuple[float, float]
) -> Lane:
    middle = (road.curves[k] + road.curves[k + 1]) / 2

    def centre(s: Array) -> Array:
        return road.surface.points(road.course.to_ground(s, along(middle, s)))

    drawn = [_drawn(rig, side, centre, span) for side in (0, 1)]
    shape = "line" if max(map(_bend, drawn)) < STRAIGHT else "curve"
    recorded = [camera.distort_points(pixels) for camera, pixels in zip(rig.cameras, drawn, strict=True)]
    path, reason = None, NO_REASON
    name = f"between lines {names[0]} and {names[1]}"
    length = float(min(np.linalg.norm(np.ptp(pixels, axis=0)) for pixels in drawn))
    if length < SMALLEST:
        reason = message("lane_outside_views", path=name, length_px=length, min_length_px=SMALLEST)
    else:
        try:
            path = reconstruct(name, shape, rig, drawn[0], drawn[1])
        except UnusableInput as error:
            reason = message("lane_not_reconstructible", problem=error)
    return Lane(names, *width, shape, recorded[0], recorded[1], path, reason)


def _drawn(rig: StereoRig, side: int, centre: Callable[[Array], Array], span: tuple[float, float]) -> Array:
    """Ideal pixels (N, 2) of a line in space inside a view, from far to near, evenly in the root of the length, as a
    perspective crowds what is far."""
    pixels = rig.project(centre(np.linspace(span[1], span[0], 600)))[side]
    inside = ((pixels > 1) & (pixels < np.array(rig.cameras[side].image_size) - 2)).all(1)
    pixels = pixels[inside]
    if len(pixels) < 2:
        return np.zeros((1, 2))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(pixels, axis=0), axis=1))])
    at = length[-1] * np.linspace(0, 1, DRAWN) ** 1.5
    return np.column_stack([np.interp(at, length, c) for c in pixels.T])


def _bend(pixels: Array) -> float:
    """Root mean square departure of pixels (N, 2) from a straight line, px."""
    return float(np.linalg.svd(pixels - pixels.mean(0), compute_uv=False)[1] / np.sqrt(len(pixels)))
