"""Paths from their drawings in the two views, whose points do not correspond ([Zhu] section IV)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline, UnivariateSpline
from scipy.optimize import least_squares

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.documents.loading import PathDocument
from paceline.errors import UnusableInput
from paceline.geometry import triangulate
from paceline.speed.configuration import DEFAULTS
from paceline.speed.geometry.paths import (
    MAX_DIRECTION_STD_RAD,
    PATH_SAMPLES,
    Path,
    from_points,
    jacobian,
    reconstruct_line,
    resampled,
)

CURVATURE_WALK_STRENGTHS = (2e-4, 1e-3, 5e-3)  # m^-1.5: an arc of constant radius, a gentle transition, a tight one
VERTICAL_CURVATURE_WALK = 2e-4  # m^-1.5, the same for the vertical curvature


def reconstruct(
    name: str, shape: str, rig: StereoRig, left: Array, right: Array, sigma: float = DEFAULTS.line_sigma
) -> Path:
    """The path whose drawings are the ideal pixels ``left`` (N, 2) and ``right`` (M, 2), ``sigma`` px the noise of a
    drawn point where too few are drawn to estimate it.

    ``shape`` is "line" or "curve". Raises UnusableInput where the drawing does not determine it in space.
    """
    make = reconstruct_line if shape == "line" else reconstruct_curve
    return make(name, rig, left, right, sigma)


def path_from_document(
    document: PathDocument, rig: StereoRig, shape: str | None = None, sigma: float = DEFAULTS.line_sigma
) -> Path:
    """The path of a clip.yaml, surveyed or drawn, not yet moved to its lane's centre; ``shape`` overrides its own.
    ``sigma`` as for `reconstruct`.

    Raises UnusableInput where the drawing does not determine it in space.
    """
    shape = shape or document.shape
    if document.points is not None:
        return from_points(document.name, shape, document.points)
    assert document.left is not None and document.right is not None, "a path is drawn in both views or surveyed"
    return reconstruct(document.name, shape, rig, document.left, document.right, sigma)


def reconstruct_curve(name: str, rig: StereoRig, left: Array, right: Array, sigma: float = DEFAULTS.line_sigma) -> Path:
    """A space curve from two image curves whose points do not correspond.

    Each point of the left curve meets the right curve where its epipolar line crosses it; that gives a first curve.
    Then a road is fitted to the drawn points of both views at once, by their distances to its projections, robustly:
    a :class:`_RoadCurve`, whose curvature is a random walk of the strength that the drawing itself makes most probable.
    Stretches nearly parallel to the epipolar lines do not constrain the depth: there it comes from the neighbouring
    stretches, and the covariance is larger.
    """
    start = _match_along_epipolar_lines(rig, left, right, sigma)
    if len(start) < 6:
        raise UnusableInput(
            f"path {name}: the two drawn curves do not meet along the epipolar lines, or run parallel to them; "
            "draw the same stretch of one road line in both views"
        )
    if not (start[:, 2] > 0).all():
        raise UnusableInput(f"path {name}: reconstructs behind the cameras; expected the same line in both views")
    road, x = _RoadCurve.through(start)
    drawn = len(left) + len(right)

    def distances(x: Array) -> Array:
        curve = np.maximum(road.points(x), [-np.inf, -np.inf, 0.5])
        views = zip(rig.cameras, (left, right), (curve, rig.to_right(curve)), strict=True)
        return np.concatenate([_distances_to_polyline(p, c.project(q)) for c, p, q in views]) / sigma

    best = (-np.inf, x, np.eye(len(x)))
    for strength in CURVATURE_WALK_STRENGTHS:
        prior = road.prior(strength)

        def residuals(x: Array, prior: Array = prior) -> Array:
            return np.concatenate([distances(x), prior @ x])

        fit = least_squares(residuals, x, loss=_soft_l1_of_drawings(drawn), x_scale=road.scale, max_nfev=80)
        information = fit.jac.T @ fit.jac
        evidence = -fit.cost + np.linalg.slogdet(prior)[1] - 0.5 * np.linalg.slogdet(information)[1]
        x = fit.x
        if evidence > best[0]:
            best = (evidence, x, information)
    _, x, information = best
    # a drawing less precise than assumed widens the covariance
    scatter = max(1.0, float(np.median(np.abs(distances(x)))) / 0.6745)
    values, vectors = np.linalg.eigh(np.linalg.inv(information) * scatter**2)
    points = road.points(x)
    slopes = jacobian(lambda y: road.points(y).ravel(), x, 1e-5)
    stds = np.sqrt(np.maximum(values, 0.0))
    modes = np.array([(slopes @ v).reshape(-1, 3) * std for std, v in zip(stds, vectors.T, strict=True)])
    ahead = points[:, 2] > 1.0
    path = resampled(name, "curve", points[ahead], modes[:, ahead])
    if np.median(np.sqrt((path.heading_modes(path.s)[0] ** 2).sum(0))) > MAX_DIRECTION_STD_RAD:
        raise UnusableInput(
            f"path {name}: the drawn curves run nearly parallel to the epipolar lines, so the two views do not "
            "determine them in space; draw another line, or leave the vehicle without a path"
        )
    return path


class _RoadCurve:
    """A curve by its heading: ``x`` = middle point (3), yaw and pitch there, then both curvatures at K knots.

    The curvatures are linear between the knots; yaw turns about the camera's y axis, pitch is down.
    """

    def __init__(self, length: float) -> None:
        margin = max(8.0, 0.25 * length)  # the vehicle is often in view before the line begins
        half = 0.5 * length + margin
        self.s = np.linspace(-half, half, 2 * PATH_SAMPLES + 1)
        self.knots = np.linspace(-half, half, int(np.clip(2 * half / 10.0, 4, 10)))
        hats = np.stack([np.interp(self.s, self.knots, e) for e in np.eye(len(self.knots))], axis=1)
        self.turn = _integral(hats, self.s)  # (samples, K): heading change since the middle per unit of curvature
        self.scale = np.concatenate([np.ones(3), np.full(2, 0.02), np.full(2 * len(self.knots), 1e-3)])

    @classmethod
    def through(cls, points: Array) -> tuple[_RoadCurve, Array]:
        """A road of the length of ``points`` (N, 3), and a robust first ``x`` near them."""
        middle = np.median(points, axis=0)
        u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        coarse = np.array([np.median(c, axis=0) for c in np.array_split(points, min(len(points), 9))])
        length = min(u[-1], 3 * float(np.linalg.norm(np.diff(coarse, axis=0), axis=1).sum()))
        road = cls(length)
        along = coarse[-1] - coarse[0]
        x = np.concatenate([middle, [np.arctan2(along[0], along[2]), 0.0], np.zeros(2 * len(road.knots))])
        prior = road.prior(CURVATURE_WALK_STRENGTHS[-1])

        def residuals(x: Array) -> Array:
            curve = road.points(x)
            i = np.argmin(((points[:, None] - curve) ** 2).sum(-1), axis=1)
            return np.concatenate([((points - curve[i]) / 0.5).ravel(), prior @ x])

        fit = least_squares(residuals, x, loss="soft_l1", x_scale=road.scale, max_nfev=30)
        return road, fit.x

    def points(self, x: Array) -> Array:
        K = len(self.knots)
        yaw = x[3] + self.turn @ x[5 : 5 + K]
        pitch = x[4] + self.turn @ x[5 + K :]
        T = np.stack([np.sin(yaw) * np.cos(pitch), np.sin(pitch), np.cos(yaw) * np.cos(pitch)], axis=1)
        return np.asarray(x[:3] + _integral(T, self.s))

    def prior(self, strength: float) -> Array:
        """Square root (n, n) of the prior's information: walks of both curvatures, wide on everything else."""
        K = len(self.knots)
        n = 5 + 2 * K
        root = np.zeros((n, n))
        root[:5, :5] = np.diag([1e-3, 1e-3, 1e-3, 0.1, 3.0])
        step = np.sqrt(self.knots[1] - self.knots[0])
        for first, walk, widest in ((5, strength, 0.05), (5 + K, VERTICAL_CURVATURE_WALK, 2e-3)):
            block = np.diff(np.eye(K), axis=0, prepend=0.0) / (walk * step)
            block[0] = 1.0 / (widest * K)  # the mean curvature
            root[first : first + K, first : first + K] = block
        return root


def _integral(values: Array, s: Array) -> Array:
    """Cumulative trapezoid of ``values`` (N, …) over ``s`` (N,), zero at the middle sample."""
    total = cumulative_trapezoid(values, s, axis=0, initial=0.0)
    return np.asarray(total - total[len(s) // 2])


def _soft_l1_of_drawings(drawn: int) -> Callable[[Array], Array]:
    """Soft L1 on the first ``drawn`` residuals, plain squares on the rest, as scipy's ``loss`` (3, n)."""

    def loss(z: Array) -> Array:
        rho = np.stack([z, np.ones_like(z), np.zeros_like(z)])
        root = np.sqrt(1 + z[:drawn] / 4)
        rho[:, :drawn] = 8 * (root - 1), 1 / root, -0.125 / root**3
        return rho

    return loss


def _distances_to_polyline(points: Array, line: Array) -> Array:
    """Signed distances (N,) of ``points`` (N, 2) to the polyline (M, 2), which goes on straight beyond its ends."""
    nearest = np.argmin(((points[:, None] - line) ** 2).sum(-1), axis=1)
    i = np.clip(nearest, 1, len(line) - 2)
    along = line[i + 1] - line[i - 1]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    offset = points - line[i]
    return np.asarray(offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0])


def _match_along_epipolar_lines(rig: StereoRig, left: Array, right: Array, sigma: float) -> Array:
    """World points (N, 3), in order along the left curve: where its points' epipolar lines cross the right one."""
    a, b = (_polyline(p, 120, sigma) for p in (left, right))
    lines = np.column_stack([a, np.ones(len(a))]) @ rig.fundamental.T
    side = np.column_stack([b, np.ones(len(b))]) @ lines.T  # (right samples, left samples)
    candidates: list[list[tuple[float, float]]] = []
    tangent = np.diff(b, axis=0)
    for j in range(len(a)):
        matches = []
        for i in np.flatnonzero(side[:-1, j] * side[1:, j] <= 0).tolist():
            f = side[i, j] / (side[i, j] - side[i + 1, j] + 1e-300)
            slope = abs(tangent[i] @ lines[j, :2]) / (np.linalg.norm(tangent[i]) * np.linalg.norm(lines[j, :2]) + 1e-12)
            matches.append((i + f, slope))
        candidates.append(matches)
    chosen = _smoothest_chain(candidates)
    points = []
    for j, r in chosen:
        segment = min(int(r), len(b) - 2)
        pixel = b[segment] + (r - segment) * tangent[segment]
        points.append(triangulate(rig, a[j], pixel))
    return np.array(points).reshape(-1, 3)


def _smoothest_chain(candidates: list[list[tuple[float, float]]]) -> list[tuple[int, float]]:
    """One crossing per left sample, such that the chain moves least along the right curve (dynamic programming).

    Crossings nearly parallel to their epipolar line are left out. Returns (left sample, right parameter) pairs.
    """
    crossings = [(j, [r for r, slope in c if slope > 0.08]) for j, c in enumerate(candidates)]
    crossings = [(j, rs) for j, rs in crossings if rs]
    if not crossings:
        return []
    cost = np.zeros(len(crossings[0][1]))
    back: list[NDArray[np.int64]] = []
    for (_, previous), (_, current) in zip(crossings, crossings[1:], strict=False):
        total = cost[:, None] + np.abs(np.subtract.outer(previous, current))
        back.append(np.argmin(total, axis=0))
        cost = total.min(0)
    k = int(np.argmin(cost))
    chain = [(crossings[-1][0], crossings[-1][1][k])]
    for step in range(len(back) - 1, -1, -1):
        k = int(back[step][k])
        chain.append((crossings[step][0], crossings[step][1][k]))
    return chain[::-1]


def _polyline(points: Array, n: int, sigma: float) -> Array:
    """``n`` samples (n, 2), equally spaced in chord length, of a smoothing spline through drawn ``points`` (N, 2)."""
    u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(u) > 1e-6])
    u, points = u[keep], points[keep]
    lengths = np.linspace(0, u[-1], n)
    if len(u) < 6:
        return np.asarray(CubicSpline(u, points, axis=0)(lengths))
    order = np.arange(len(u), dtype=float)  # drawn points crowd with distance: smooth over their order
    noise = len(u) * (1.5 * sigma) ** 2
    smooth = [UnivariateSpline(order, c, k=3, s=noise)(order) for c in points.T]
    return np.stack([np.interp(lengths, u, c) for c in smooth], axis=1)
