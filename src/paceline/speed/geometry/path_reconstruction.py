"""Paths from their drawings in the two views, whose points do not correspond ([Zhu] section IV)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline, UnivariateSpline
from scipy.optimize import least_squares

from paceline.arrays import Array
from paceline.cameras import Camera, StereoRig
from paceline.documents.loading import PathDocument
from paceline.geometry import triangulate
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
PLANE_ITERATIONS = 5  # of the robust fit of the first plane
FOOT_POINT_ITERATIONS = 6  # of Newton's method for the point of a curve that is nearest to a drawn one
CROSSING_HUBER_SIGMA = 1.5  # standard deviations from which a residual counts linearly
USUAL_CAMERA_HEIGHT_M = 2.0  # m above the road, to begin with
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

    Each point of the left curve meets the right curve where its epipolar line crosses it. The plane through these
    points, each weighted by how well its depth is determined, meets the rays of the left curve in a first curve.
    Then a road is fitted to the drawn points of both views at once, by their distances to its projections, robustly:
    a :class:`_RoadCurve`, whose curvature is a random walk of the strength that the drawing itself makes most probable.
    Stretches nearly parallel to the epipolar lines do not constrain the depth: there it comes from the surface, which
    the other stretches determine, and the covariance is larger.
    """
    plane = _plane_of_crossings(rig, *_match_along_epipolar_lines(rig, left, right, sigma), sigma)
    if plane is None:
        raise UndeterminedPath(
            name,
            "the two drawn curves do not meet along the epipolar lines, or run parallel to them",
            "draw the same stretch of one road line in both views",
        )
    start = _intersect(rig.left.rays(_polyline(left, PATH_SAMPLES, sigma)), plane)
    if len(start) < 6:
        raise UndeterminedPath(name, "reconstructs behind the cameras", "expected the same line in both views")
    road, x = _RoadCurve.through(start)
    drawn = len(left) + len(right)
    rotations = (np.eye(3), rig.R)

    def in_views(x: Array) -> list[tuple[Camera, Array, Array]]:
        curve = np.maximum(road.points(x), [-np.inf, -np.inf, 0.5])
        return list(zip(rig.cameras, (left, right), (curve, rig.to_right(curve)), strict=True))

    def distances(x: Array) -> Array:
        return np.concatenate([_distances_to_curve(p, c.project(q))[0] for c, p, q in in_views(x)]) / sigma

    def distance_slopes(x: Array) -> Array:
        slopes = jacobian(lambda y: road.points(y).ravel(), x, 1e-5).reshape(-1, 3, len(x))
        rows = []
        for R, (camera, points, curve) in zip(rotations, in_views(x), strict=True):
            _, u, normals = _distances_to_curve(points, camera.project(curve))
            flow = _image_motion(camera, curve, np.einsum("ab,mbn->man", R, slopes))
            rows.append(-np.einsum("pa,pan->pn", normals, CubicSpline(np.arange(len(flow)), flow)(u)))
        return np.concatenate(rows) / sigma

    best = (-np.inf, x, np.eye(len(x)))
    for strength in CURVATURE_WALK_STRENGTHS:
        prior = road.prior(strength)

        def residuals(x: Array, prior: Array = prior) -> Array:
            return np.concatenate([distances(x), prior @ x])

        def slopes(x: Array, prior: Array = prior) -> Array:
            return np.concatenate([distance_slopes(x), prior])

        loss = _soft_l1_of_drawings(drawn)
        fit = least_squares(residuals, x, slopes, loss=loss, x_scale=road.scale, ftol=1e-5, max_nfev=80)
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
    displacements = jacobian(lambda y: road.points(y).ravel(), x, 1e-5)
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


class _RoadCurve:
    """A curve on a nearly plane surface: ``x`` = middle point (3), yaw there, the surface's gradient to the right and
    ahead of the camera (2), then the curvatures in plan and of the surface at K knots.

    The curvatures are linear between the knots; yaw turns about the camera's y axis, gradients are downward.
    """

    def __init__(self, length: float) -> None:
        margin = max(8.0, 0.25 * length)  # the vehicle is often in view before the line begins
        half = 0.5 * length + margin
        self.s = np.linspace(-half, half, 2 * PATH_SAMPLES + 1)
        self.drawn = np.abs(self.s) <= 0.5 * length
        self.knots = np.linspace(-half, half, int(np.clip(2 * half / 10.0, 4, 10)))
        hats = np.stack([np.interp(self.s, self.knots, e) for e in np.eye(len(self.knots))], axis=1)
        self.turn = _integral(hats, self.s)  # (samples, K): heading change since the middle per unit of curvature
        self.scale = np.concatenate([np.ones(3), np.full(3, 0.02), np.full(2 * len(self.knots), 1e-3)])

    @classmethod
    def through(cls, points: Array) -> tuple[_RoadCurve, Array]:
        """A road of the length of ``points`` (N, 3), in order, and a first ``x`` near them."""
        u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        at = np.linspace(0, u[-1], PATH_SAMPLES + 1)
        points = np.stack([np.interp(at, u, c) for c in points.T], axis=1)
        road = cls(float(u[-1]))
        middle, along = points[len(points) // 2], np.gradient(points, axis=0)[len(points) // 2]
        x = np.concatenate([middle, [np.arctan2(along[0], along[2]), 0.0, 0.0], np.zeros(2 * len(road.knots))])
        prior = road.prior(CURVATURE_WALK_STRENGTHS[-1])

        def residuals(x: Array) -> Array:
            curve = road.points(x)
            fitted = np.stack([np.interp(at - u[-1] / 2, road.s, c) for c in curve.T], axis=1)
            return np.concatenate([((points - fitted) / 0.5).ravel(), prior @ x])

        return road, least_squares(residuals, x, x_scale=road.scale, max_nfev=30).x

    def points(self, x: Array) -> Array:
        K = len(self.knots)
        yaw = x[3] + self.turn @ x[6 : 6 + K]
        T = np.stack([np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=1)
        T[:, 1] = x[4] * T[:, 0] + x[5] * T[:, 2] + self.turn @ x[6 + K :]
        return np.asarray(x[:3] + _integral(T / np.linalg.norm(T, axis=1, keepdims=True), self.s))

    def prior(self, strength: float) -> Array:
        """Square root (n, n) of the prior's information: walks of both curvatures, wide on everything else."""
        K = len(self.knots)
        n = 6 + 2 * K
        root = np.zeros((n, n))
        root[:6, :6] = np.diag([1e-3, 1e-3, 1e-3, 0.1, *np.reciprocal(GRADIENT_STD)])
        step = np.sqrt(self.knots[1] - self.knots[0])
        walks = ((6, strength, 0.05), (6 + K, VERTICAL_CURVATURE_WALK, VERTICAL_CURVATURE_STD))
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


def _match_along_epipolar_lines(rig: StereoRig, left: Array, right: Array, sigma: float) -> tuple[Array, Array]:
    """World points (N, 3), in order along the left curve: where its points' epipolar lines cross the right one; and
    the sines (N,) of the angles at which they cross."""
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
    points, sines = [], []
    for j, r in _smoothest_chain(candidates):
        segment = min(int(r), len(b) - 2)
        pixel = b[segment] + (r - segment) * tangent[segment]
        points.append(triangulate(rig, a[j], pixel))
        sines.append(next(sine for place, sine in candidates[j] if place == r))
    return np.array(points).reshape(-1, 3), np.array(sines)


def _plane_of_crossings(rig: StereoRig, points: Array, sines: Array, sigma: float) -> Array | None:
    """The plane (3,), n with n · X = 1, through matched ``points``; None where these are fewer than 6.

    Along a ray r with z = 1 the inverse depth is n · r: linear in n. An error of the drawing changes it by the
    reciprocal of the sine at which the epipolar line crosses the curve.
    """
    if len(points) < 6:
        return None
    rows, inverse_depths = points / points[:, 2:], 1 / points[:, 2]
    precision = sines / (2 * sigma / (rig.left.K[0, 0] * rig.baseline))
    weights, n = precision, np.array([0.0, 1 / USUAL_CAMERA_HEIGHT_M, 0.0])
    for _ in range(PLANE_ITERATIONS):
        gradient_prior = np.diag(1 / (n[1] * np.array([GRADIENT_STD[0], np.inf, GRADIENT_STD[1]])))[::2]
        A = np.vstack([weights[:, None] * rows, gradient_prior])
        n = np.linalg.lstsq(A, np.append(weights * inverse_depths, [0.0, 0.0]), rcond=None)[0]
        residuals = precision * np.abs(rows @ n - inverse_depths)
        weights = precision * np.sqrt(np.minimum(1.0, CROSSING_HUBER_SIGMA / np.maximum(residuals, 1e-9)))
    return np.asarray(n)


def _intersect(rays: Array, plane: Array) -> Array:
    """Points (M, 3) in which the ``rays`` (N, 3) with z = 1 meet the ``plane``, without those beyond `MAX_ROAD_M`."""
    inverse_depth = rays @ plane
    ahead = inverse_depth > 1 / MAX_ROAD_M
    return np.asarray(rays[ahead] / inverse_depth[ahead, None])


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
