"""Paths from their drawings in the two views, whose points do not correspond ([Zhu] section IV)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline, UnivariateSpline
from scipy.optimize import OptimizeResult, least_squares

from paceline.arrays import Array
from paceline.cameras import Camera, StereoRig
from paceline.documents.loading import PathDocument
from paceline.speed.configuration import DEFAULTS
from paceline.speed.geometry.paths import (
    ANOTHER_LINE,
    MAX_DIRECTION_STD_RAD,
    PATH_SAMPLES,
    Path,
    UndeterminedPath,
    from_points,
    jacobian,
    reconstruct_line,
    resampled,
)

CURVATURE_WALK_STRENGTHS = (2e-4, 1e-3, 5e-3)  # m^-1.5: an arc of constant radius, a gentle transition, a tight one
VERTICAL_CURVATURE_WALK = 1e-4  # m^-1.5, the same for the vertical curvature
VERTICAL_CURVATURE_STD = 1e-3  # 1/m, of the road's mean vertical curvature: crests of 1000 m
GRADIENT_STD = (0.05, 0.2)  # of the surface's fall to the right of the camera, by roll and bank, and ahead, by its tilt
FOOT_POINT_ITERATIONS = 6  # of Newton's method for the point of a curve that is nearest to a drawn one
PLANE_HEIGHTS_M = np.geomspace(0.7, 12.0, 15)  # m below the camera, of the first planes that are tried
PLANE_FALLS = np.linspace(-0.4, 0.4, 21)  # of these planes ahead of the camera, which may look up or down
PLANE_HYPOTHESES = 5  # of them, from which the fit of the road begins
FIRST_CURVE_STD_PER_M = 5e-3  # 1/m, of the inverse depth of a point of the first curve
MAX_PLANE_MISFIT_SIGMA = 20.0  # of the right drawing's points from the left curve carried over by the plane, median
MAX_ROAD_M = 150.0  # m from the camera up to which a road is reconstructed


def reconstruct(
    name: str, shape: str, rig: StereoRig, left: Array, right: Array, sigma: float = DEFAULTS.line_sigma
) -> Path:
    """The path whose drawings are the ideal pixels ``left`` (N, 2) and ``right`` (M, 2), ``sigma`` px the noise of a
    drawn point where too few are drawn to estimate it.

    ``shape`` is "line" or "curve". Raises UndeterminedPath where the drawing does not determine it in space.
    """
    make = reconstruct_line if shape == "line" else reconstruct_curve
    return make(name, rig, left, right, sigma)


def path_from_document(
    document: PathDocument, rig: StereoRig, shape: str | None = None, sigma: float = DEFAULTS.line_sigma
) -> Path:
    """The path of a clip.yaml, surveyed or drawn, not yet moved to its lane's centre; ``shape`` overrides its own.
    ``sigma`` as for `reconstruct`.

    Raises UndeterminedPath where the drawing does not determine it in space.
    """
    shape = shape or document.shape
    if document.points is not None:
        return from_points(document.name, shape, document.points)
    assert document.left is not None and document.right is not None, "a path is drawn in both views or surveyed"
    return reconstruct(document.name, shape, rig, document.left, document.right, sigma)


def reconstruct_curve(name: str, rig: StereoRig, left: Array, right: Array, sigma: float = DEFAULTS.line_sigma) -> Path:
    """A space curve from two image curves whose points do not correspond.

    A plane carries the left curve onto the right one by the homography that it induces; its intersection with the rays
    of the left curve is a first curve. The planes that do so best are hypotheses: from the first curve of each a road
    is fitted to the drawn points of both views at once, by their distances to its projections, robustly, and the one
    that fits best is kept. A road is a :class:`_RoadCurve`, whose curvature is a random walk of the strength that the
    drawing itself makes most probable.
    Stretches nearly parallel to the epipolar lines do not constrain the depth: there it comes from the surface, which
    the other stretches determine, and the covariance is larger.
    """
    starts = _first_curves(rig, _polyline(left, PATH_SAMPLES, sigma), right, sigma)
    if not starts:
        raise UndeterminedPath(
            name,
            "no road surface before the cameras carries one drawn curve onto the other",
            "expected the same stretch of one road line in both views",
        )
    drawing = _Drawing(rig, left, right, sigma)
    fits = []
    for start in starts:
        road, x = _RoadCurve.through(start)
        fits.append((road, drawing.fit(road, x, CURVATURE_WALK_STRENGTHS[0])))
    road, fit = min(fits, key=lambda hypothesis: float(hypothesis[1].cost))
    x, best = fit.x, (-np.inf, fit.x, np.eye(len(fit.x)))
    for strength in CURVATURE_WALK_STRENGTHS:
        fit = drawing.fit(road, x, strength)
        information = fit.jac.T @ fit.jac
        evidence = -fit.cost + np.linalg.slogdet(road.prior(strength))[1] - 0.5 * np.linalg.slogdet(information)[1]
        x = fit.x
        if evidence > best[0]:
            best = (evidence, x, information)
    _, x, information = best
    # a drawing less precise than assumed widens the covariance
    scatter = max(1.0, float(np.median(np.abs(drawing.distances(road, x)))) / 0.6745)
    values, vectors = np.linalg.eigh(np.linalg.inv(information) * scatter**2)
    points = road.points(x)
    displacements = road.slopes(x).reshape(-1, len(x))
    stds = np.sqrt(np.maximum(values, 0.0))
    modes = np.array([(displacements @ v).reshape(-1, 3) * std for std, v in zip(stds, vectors.T, strict=True)])
    ahead = points[:, 2] > 1.0
    drawn_stretch = resampled(name, "curve", points[ahead & road.drawn], modes[:, ahead & road.drawn])
    if np.median(np.sqrt((drawn_stretch.heading_modes(drawn_stretch.s)[0] ** 2).sum(0))) > MAX_DIRECTION_STD_RAD:
        raise UndeterminedPath(
            name,
            "the drawn curves run nearly parallel to the epipolar lines, so the two views do not determine them in "
            "space",
            ANOTHER_LINE,
        )
    return resampled(name, "curve", points[ahead], modes[:, ahead])


@dataclass(frozen=True, eq=False)
class _Drawing:
    """A road line's points ``left`` (N, 2) and ``right`` (M, 2), px, which scatter by ``sigma`` px."""

    rig: StereoRig
    left: Array
    right: Array
    sigma: float

    def _in_views(self, road: _RoadCurve, x: Array) -> list[tuple[Camera, Array, Array]]:
        curve = np.maximum(road.points(x), [-np.inf, -np.inf, 0.5])
        return list(zip(self.rig.cameras, (self.left, self.right), (curve, self.rig.to_right(curve)), strict=True))

    def distances(self, road: _RoadCurve, x: Array) -> Array:
        """Distances (N + M,) of the points from the projections of ``road`` by ``x``, in standard deviations."""
        views = self._in_views(road, x)
        return np.concatenate([_distances_to_curve(p, c.project(q))[0] for c, p, q in views]) / self.sigma

    def _distance_slopes(self, road: _RoadCurve, x: Array) -> Array:
        slopes = road.slopes(x)
        rows = []
        for R, (camera, points, curve) in zip((np.eye(3), self.rig.R), self._in_views(road, x), strict=True):
            _, u, normals = _distances_to_curve(points, camera.project(curve))
            flow = _image_motion(camera, curve, np.einsum("ab,mbn->man", R, slopes))
            rows.append(-np.einsum("pa,pan->pn", normals, CubicSpline(np.arange(len(flow)), flow)(u)))
        return np.concatenate(rows) / self.sigma

    def fit(self, road: _RoadCurve, x: Array, strength: float) -> OptimizeResult:
        """The robust fit of ``road`` from ``x``, its curvature a random walk of this ``strength``."""
        prior = road.prior(strength)

        def residuals(x: Array) -> Array:
            return np.concatenate([self.distances(road, x), prior @ x])

        def slopes(x: Array) -> Array:
            return np.concatenate([self._distance_slopes(road, x), prior])

        loss = _soft_l1_of_drawings(len(self.left) + len(self.right))
        return least_squares(residuals, x, slopes, loss=loss, x_scale=road.scale, ftol=1e-5, max_nfev=80)


class _RoadCurve:
    """A curve on a nearly plane surface: ``x`` = its offset to the right and down (2) from a ``middle`` point (3), yaw
    there, the surface's gradient to the right and ahead of the camera (2), then the curvatures in plan and of the
    surface at K knots.

    The curvatures are linear between the knots; yaw turns about the camera's y axis, gradients are downward. The offset
    is across the direction of ``middle_yaw``: along itself a curve may be shifted without being changed.
    """

    def __init__(self, length: float, middle: Array, middle_yaw: float) -> None:
        self.middle = middle
        self.across = np.array([[np.cos(middle_yaw), 0.0, -np.sin(middle_yaw)], [0.0, 1.0, 0.0]])
        margin = max(8.0, 0.25 * length)  # the vehicle is often in view before the line begins
        half = 0.5 * length + margin
        self.s = np.linspace(-half, half, 2 * PATH_SAMPLES + 1)
        self.drawn = np.abs(self.s) <= 0.5 * length
        self.knots = np.linspace(-half, half, int(np.clip(2 * half / 10.0, 4, 10)))
        hats = np.stack([np.interp(self.s, self.knots, e) for e in np.eye(len(self.knots))], axis=1)
        self.turn = _integral(hats, self.s)  # (samples, K): heading change since the middle per unit of curvature
        self.scale = np.concatenate([np.ones(2), np.full(3, 0.02), np.full(2 * len(self.knots), 1e-3)])

    @classmethod
    def through(cls, points: Array) -> tuple[_RoadCurve, Array]:
        """A road of the length of ``points`` (N, 3), in order, and a first ``x`` near them."""
        u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        at = np.linspace(0, u[-1], PATH_SAMPLES + 1)
        points = np.stack([np.interp(at, u, c) for c in points.T], axis=1)
        yaw = np.unwrap(np.arctan2(*np.gradient(points, axis=0)[:, [0, 2]].T))
        middle = len(points) // 2
        road = cls(float(u[-1]), points[middle], float(yaw[middle]))
        curvature = np.full(len(road.knots), (yaw[-1] - yaw[0]) / u[-1])
        x = np.concatenate([[0.0, 0.0, yaw[middle], 0.0, 0.0], curvature, np.zeros(len(road.knots))])
        prior, std = road.prior(CURVATURE_WALK_STRENGTHS[0]), FIRST_CURVE_STD_PER_M * points[:, 2:] ** 2

        def residuals(x: Array) -> Array:
            curve = road.points(x)
            fitted = np.stack([np.interp(at - u[-1] / 2, road.s, c) for c in curve.T], axis=1)
            return np.concatenate([((points - fitted) / std).ravel(), prior @ x])

        return road, least_squares(residuals, x, x_scale=road.scale, max_nfev=30).x

    def points(self, x: Array) -> Array:
        K = len(self.knots)
        yaw = x[2] + self.turn @ x[5 : 5 + K]
        T = np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=1)
        T[:, 1] = x[3] * T[:, 0] + x[4] * T[:, 2] + self.turn @ x[5 + K :]
        middle = self.middle + x[:2] @ self.across
        return np.asarray(middle + _integral(T / np.linalg.norm(T, axis=1, keepdims=True), self.s))

    def slopes(self, x: Array) -> Array:
        """Derivatives (samples, 3, n) of the points by ``x``."""
        return jacobian(lambda y: self.points(y).ravel(), x, 1e-5).reshape(-1, 3, len(x))

    def prior(self, strength: float) -> Array:
        """Square root (n, n) of the prior's information: walks of both curvatures, wide on everything else."""
        K = len(self.knots)
        n = 5 + 2 * K
        root = np.zeros((n, n))
        root[:5, :5] = np.diag([1e-3, 1e-3, 0.1, *np.reciprocal(GRADIENT_STD)])
        step = np.sqrt(self.knots[1] - self.knots[0])
        walks = ((5, strength, 0.05), (5 + K, VERTICAL_CURVATURE_WALK, VERTICAL_CURVATURE_STD))
        for first, walk, widest in walks:
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


def _image_motion(camera: Camera, points: Array, slopes: Array) -> Array:
    """Derivatives (M, 2, n) of the projections of ``points`` (M, 3) whose own derivatives are ``slopes`` (M, 3, n)."""
    depth = points[:, 2, None, None]
    across = (slopes[:, :2] - points[:, :2, None] / depth * slopes[:, 2:]) / depth
    return np.asarray(np.einsum("ab,mbn->man", camera.K[:2, :2], across))


def _distances_to_curve(points: Array, curve: Array) -> tuple[Array, Array, Array]:
    """Signed distances (N,) of ``points`` (N, 2) from the spline through ``curve`` (M, 2), which continues straight
    beyond its ends; the parameters (N,) of their foot points, in samples; and the normals (N, 2) there.

    The distances are smooth in both, also where the curve bends sharply between its samples.
    """
    spline = CubicSpline(np.arange(len(curve)), curve)
    u = np.argmin(((points[:, None] - curve) ** 2).sum(-1), axis=1).astype(float)
    for _ in range(FOOT_POINT_ITERATIONS):
        offset, along = spline(u) - points, spline(u, 1)
        curvature = (along**2).sum(1) + (offset * spline(u, 2)).sum(1)
        step = (offset * along).sum(1) / np.maximum(curvature, 0.2 * (along**2).sum(1))
        u = np.clip(u - np.clip(step, -1.0, 1.0), 0, len(curve) - 1)
    offset, along = points - spline(u), spline(u, 1)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    return np.asarray((offset * normals).sum(1)), u, normals


def _first_curves(rig: StereoRig, left: Array, right: Array, sigma: float) -> list[Array]:
    """Points (N, 3) of the ``left`` curve's samples (N, 2) on each of the planes that carry that curve onto the drawn
    points ``right`` (M, 2) best; none where no plane does."""
    rays = rig.left.rays(left)

    def on_plane(x: Array) -> Array:
        """Points on the plane of height exp(x₀) below the camera that falls by (x₁, x₂) to the right and ahead."""
        inverse_depth = rays @ np.array([-x[1], 1.0, -x[2]]) / np.exp(x[0])
        return np.asarray(rays / np.maximum(inverse_depth, 1 / MAX_ROAD_M)[:, None])

    def distances(x: Array) -> Array:
        return _distances_to_curve(right, rig.right.project(rig.to_right(on_plane(x))))[0] / sigma

    def residuals(x: Array) -> Array:
        return np.concatenate([distances(x), x[1:] / GRADIENT_STD])

    def cost(x: Array) -> float:
        return float(np.sqrt(1 + residuals(x) ** 2).sum())

    hypotheses = [np.array([np.log(h), 0.0, fall]) for h in PLANE_HEIGHTS_M for fall in PLANE_FALLS]
    hypotheses = sorted(hypotheses, key=cost)[:PLANE_HYPOTHESES]
    best = least_squares(residuals, hypotheses[0], loss="soft_l1", x_scale=np.array([0.1, 0.01, 0.01]), max_nfev=50).x
    if np.median(np.abs(distances(best))) > MAX_PLANE_MISFIT_SIGMA:
        return []
    curves = [on_plane(x) for x in (best, *hypotheses)]
    curves = [points[points[:, 2] < 0.99 * MAX_ROAD_M] for points in curves]
    return [points for points in curves if len(points) > PATH_SAMPLES // 4]


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
