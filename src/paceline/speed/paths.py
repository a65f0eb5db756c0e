"""Paths along a road, reconstructed from their drawings in the two views ([Zhu] section IV).

A :class:`Path` is a space curve C(s) over arc length with the covariance of its reconstruction, held as displacement
*modes*: the true curve is C(s) + Σⱼ qⱼ·modeⱼ(s) with independent q ~ N(0, 1). A path is a prior, never an exact rail:
taking the drawn line as exact biases the speed by 2–7 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline, UnivariateSpline
from scipy.optimize import least_squares

from paceline.cameras import Camera, StereoRig
from paceline.errors import UnusableInput
from paceline.geometry import triangulate

Array = NDArray[np.float64]

DRAWING_SIGMA = 0.5  # px, the noise of a drawn point where too few points are drawn to estimate it
MAX_DIRECTION_STD = np.radians(6.0)  # a path less certain than this constrains nothing
SURVEY_SIGMA = 0.02  # m, of a surveyed point
SAMPLES = 128


@dataclass(frozen=True, eq=False)
class Path:
    """A space curve with its uncertainty.

    ``s`` (M,) arc length in metres, ``points`` (M, 3) in the world frame, ``modes`` (J, M, 3) displacements of one
    standard deviation each.
    """

    name: str
    shape: str  # line | curve
    s: Array
    points: Array
    modes: Array

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.s, self.points, axis=0)

    def at(self, s: Array) -> Array:
        """C(s), shape (…, 3); beyond its ends the path runs on straight."""
        inside = np.clip(s, self.s[0], self.s[-1])
        beyond = np.asarray(s) - inside
        return np.asarray(self._spline(inside) + beyond[..., None] * self._spline(inside, 1))

    @cached_property
    def _roll(self) -> Array:
        return rotation_minimising_roll(level_frames(np.asarray(self._spline(self.s, 1))))

    def frames(self, s: Array) -> Array:
        """Frames (…, 3, 3) with columns T, P, B ([Zhu] section IV-B) at arc lengths ``s`` (…).

        Frenet's normal is undefined where the curvature vanishes and flips at an inflection. These frames are the
        rotation-minimising ones instead: on a plane curve, tilted or not, they differ from Frenet's by a constant roll,
        so that the rotation (26) is the same. At the path's beginning P is horizontal, to the right of travel along
        increasing s; B = T × P points down, as the camera's y.
        """
        inside = np.clip(s, self.s[0], self.s[-1])
        level = level_frames(np.asarray(self._spline(inside, 1)))
        return rolled(level, np.interp(inside, self.s, self._roll))

    def nearest(self, point: Array) -> float:
        """Arc length at which the plane through ``point`` (3,) normal to the path meets it."""
        s = float(self.s[np.argmin(np.linalg.norm(self.points - point, axis=1))])
        for _ in range(20):
            t = self.frames(np.array(s))[:, 0]
            step = float(t @ (point - self.at(np.array(s))))
            s += step
            if abs(step) < 1e-9:
                break
        return s

    def heading_modes(self, s: Array) -> tuple[Array, Array]:
        """Changes of yaw and pitch (J, N) in radians, at arc lengths ``s`` (N,), that one unit of each mode causes.

        Only what moves the curve sideways turns it: sliding along itself changes nothing.
        """
        F = self.frames(self.s)
        sideways = np.einsum("jmc,mcd->jmd", self.modes, F[:, :, 1:])
        slopes = CubicSpline(self.s, sideways, axis=1)(np.clip(s, self.s[0], self.s[-1]), 1)
        return slopes[..., 0], slopes[..., 1]

    def shifted(self, lateral_offset: float) -> Path:
        """The path moved sideways by ``lateral_offset`` metres along P ([Zhu] section IV-B)."""
        points = self.points + lateral_offset * self.frames(self.s)[:, :, 1]
        return _resampled(self.name, self.shape, points, self.modes)

    def reversed(self) -> Path:
        """The same curve travelled the other way."""
        s = self.s[-1] - self.s[::-1]
        return Path(self.name, self.shape, s, self.points[::-1].copy(), self.modes[:, ::-1].copy())


def level_frames(directions: Array) -> Array:
    """Frames (…, 3, 3), columns T, P, B: T along ``directions`` (…, 3), P horizontal to its right, B = T × P down.

    "Horizontal" is the camera's x–z plane; a path that runs along the camera's y axis takes x for its P.
    """
    T = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    P = np.cross(np.array([0.0, 1.0, 0.0]), T)
    length = np.linalg.norm(P, axis=-1, keepdims=True)
    P = np.where(length > 1e-6, P / np.maximum(length, 1e-12), np.array([1.0, 0.0, 0.0]))
    return np.stack([T, P, np.cross(T, P)], axis=-1)


def rotation_minimising_roll(level: Array) -> Array:
    """Angles (N,) about T by which level frames (N, 3, 3) along a curve must roll not to turn about T at all."""
    P, B = level[:, :, 1], level[:, :, 2]
    turns = 0.5 * (np.diff(P, axis=0) * (B[:-1] + B[1:])).sum(-1)
    return np.concatenate([[0.0], -np.cumsum(turns)])


def rolled(frames: Array, roll: Array) -> Array:
    """``frames`` (…, 3, 3), columns T, P, B, turned about T by ``roll`` (…)."""
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    T, P, B = frames[..., 0], frames[..., 1], frames[..., 2]
    return np.stack([T, c * P + s * B, c * B - s * P], axis=-1)


def reconstruct(
    name: str, shape: str, rig: StereoRig, left: Array, right: Array
) -> Path:
    """The path whose drawings are the ideal pixels ``left`` (N, 2) and ``right`` (M, 2), which need not correspond.

    Raises UnusableInput where the drawing does not determine a space curve.
    """
    make = reconstruct_line if shape == "line" else reconstruct_curve
    return make(name, rig, left, right)


def from_points(name: str, shape: str, points: Array) -> Path:
    """A path surveyed in the world frame: ``points`` (K, 3) in metres, taken as known to 2 cm each."""
    u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if shape == "line" or len(points) < 4:
        return _line_path(name, *_fit_space_line(points, SURVEY_SIGMA))
    curve = CubicSpline(u, points, axis=0)(np.linspace(0, u[-1], SAMPLES))
    slope = np.linspace(-1, 1, SAMPLES)[:, None] * SURVEY_SIGMA
    F = level_frames(np.gradient(curve, axis=0))
    modes = np.stack([slope * F[:, :, 1], slope * F[:, :, 2]])
    return _resampled(name, "curve", curve, modes)


def straight(name: str, places: Array) -> Path:
    """The straight way through a vehicle's ``places`` (N, 3), in the sense of travel; it claims no uncertainty."""
    ends, cov, foot, k = _fit_space_line(places, 0.0)
    path = _line_path(name, ends, cov, foot, k)
    return path if k @ (places[-1] - places[0]) > 0 else path.reversed()


# --- straight paths ------------------------------------------------------------------------------------------------


def reconstruct_line(name: str, rig: StereoRig, left: Array, right: Array) -> Path:
    """A straight path by intersecting the planes that its image lines span with the cameras ([Zhu] (19)–(21))."""
    lines = [_fit_image_line(p) for p in (left, right)]
    x0 = np.concatenate([x for x, *_ in lines])
    M = [rig.left.K @ np.eye(3, 4), rig.right.K @ np.column_stack([rig.R, rig.t])]

    def planes(x: Array) -> list[Array]:
        return [m.T @ _homogeneous_line(x[2 * i], x[2 * i + 1], lines[i][2]) for i, m in enumerate(M)]

    def space_line(x: Array) -> Array:
        return np.concatenate(plucker_line(*planes(x)))

    def crossing(x: Array) -> Array:
        """The cross product of the planes' unit normals: its length is the sine of the angle between them."""
        a, b = (Q[:3] / np.linalg.norm(Q[:3]) for Q in planes(x))
        return np.cross(a, b)

    jacobian = _jacobian(space_line, x0, 1e-6)
    covariance = np.zeros((4, 4))
    for i, (_, cov, _) in enumerate(lines):
        covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = cov
    line = space_line(x0)
    k, foot = line[:3], line[3:]
    cov = jacobian @ covariance @ jacobian.T
    c = crossing(x0)
    slope = c @ _jacobian(crossing, x0, 1e-6)
    separation = c @ c / np.sqrt(slope @ covariance @ slope)  # of the planes, in standard deviations
    if not np.isfinite(cov).all() or separation < 5.0 or np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]) > MAX_DIRECTION_STD:
        raise UnusableInput(
            f"path {name}: the drawn line is nearly parallel to the epipolar lines, so the two views do not determine "
            "it in space; draw another line, or leave the vehicle without a path"
        )
    depths = np.array([_depth_on_line(rig.left, k, foot, p) for p in left])
    if not (depths > 0).any():
        raise UnusableInput(
            f"path {name}: reconstructs behind the cameras; expected the same road line in both views"
        )
    ends = np.array([foot + k * s for s in _stretch_in_front(rig.left, k, foot, left)])
    return _line_path(name, ends, cov, foot, k)


def plucker_line(Ql: Array, Qr: Array) -> tuple[Array, Array]:
    """Direction ``k`` and the point nearest to the origin of the line in which two planes (4,) meet ([Zhu] (20), (21)).

    The sign of ``k`` is chosen so that its z component is positive.
    """
    L = np.outer(Ql, Qr) - np.outer(Qr, Ql)
    k = np.array([-L[1, 2], L[0, 2], -L[0, 1]])
    k = k / np.linalg.norm(k) * (-1.0 if k[2] < 0 else 1.0)
    rows = np.stack([Ql[:3], Qr[:3], k])
    return k, np.linalg.solve(rows, np.array([-Ql[3], -Qr[3], 0.0]))


def _homogeneous_line(angle: float, offset: float, centre: Array) -> Array:
    normal = np.array([np.cos(angle), np.sin(angle)])
    return np.array([normal[0], normal[1], -(normal @ centre + offset)])


def _fit_image_line(points: Array) -> tuple[Array, Array, Array]:
    """(angle of the normal, offset from the centroid), their covariance (2, 2), and the centroid, by orthogonal fit."""
    centre = points.mean(0)
    _, singular, axes = np.linalg.svd(points - centre)
    normal, along = axes[1], singular[0] ** 2
    residual = (points - centre) @ normal
    n = len(points)
    # the drawing's own scatter, drawn towards the usual noise as if four further residuals had shown it
    variance = (residual @ residual + 4 * DRAWING_SIGMA**2) / (n - 2 + 4)
    return (
        np.array([np.arctan2(normal[1], normal[0]), 0.0]),
        np.diag([variance / along, variance / n]),
        centre,
    )


def _depth_on_line(camera: Camera, k: Array, foot: Array, pixel: Array) -> float:
    ray = camera.rays(pixel)
    s, z = np.linalg.lstsq(np.column_stack([-k, ray]), foot, rcond=None)[0]
    return float(z)


def _stretch_in_front(camera: Camera, k: Array, foot: Array, pixels: Array) -> tuple[float, float]:
    """Arc lengths of the drawn stretch's ends; what lies nearer than a metre to the camera is cut off."""
    rays = camera.rays(pixels)
    s = [np.linalg.lstsq(np.column_stack([-k, r]), foot, rcond=None)[0][0] for r in rays]
    z = foot[2] + k[2] * np.array(s)
    s_front = np.array(s)[z > 1.0]
    return float(s_front.min()), float(s_front.max())


def _fit_space_line(points: Array, sigma: float) -> tuple[Array, Array, Array, Array]:
    centre = points.mean(0)
    _, singular, axes = np.linalg.svd(points - centre)
    k = axes[0] * (-1.0 if axes[0][2] < 0 else 1.0)
    foot = centre - k * (k @ centre)
    across = np.eye(3) - np.outer(k, k)
    cov = np.zeros((6, 6))
    cov[:3, :3] = sigma**2 / singular[0] ** 2 * across
    s = (points - foot) @ k
    return np.stack([foot + k * s.min(), foot + k * s.max()]), cov, foot, k


def _line_path(name: str, ends: Array, cov: Array, foot: Array, k: Array) -> Path:
    """The path between two ``ends`` (2, 3) whose direction and foot have the joint covariance ``cov`` (6, 6)."""
    s = np.linspace(ends[0] @ k, ends[1] @ k, SAMPLES)
    points = foot + s[:, None] * k
    values, vectors = np.linalg.eigh(cov)
    keep = values > 1e-12 * max(values[-1], 1e-30)
    modes = [np.sqrt(a) * (s[:, None] * v[:3] + v[3:]) for a, v in zip(values[keep], vectors.T[keep], strict=True)]
    return Path(name, "line", s - s[0], points, np.array(modes).reshape(-1, SAMPLES, 3))


# --- curved paths --------------------------------------------------------------------------------------------------


def reconstruct_curve(name: str, rig: StereoRig, left: Array, right: Array) -> Path:
    """A space curve from two image curves whose points do not correspond.

    Each point of the left curve meets the right curve where its epipolar line crosses it; that gives a first curve.
    Then a road is fitted to the drawn points of both views at once, by their distances to its projections, robustly:
    a :class:`_Road`, whose curvature is a random walk of the strength that the drawing itself makes most probable.
    Stretches nearly parallel to the epipolar lines say nothing about depth: there the road is carried by its
    neighbours, and its covariance says so.
    """
    start = _meet_along_epipolar_lines(rig, left, right)
    if len(start) < 6:
        raise UnusableInput(
            f"path {name}: the two drawn curves do not meet along the epipolar lines, or run parallel to them; "
            "draw the same stretch of one road line in both views"
        )
    if not (start[:, 2] > 0).all():
        raise UnusableInput(f"path {name}: reconstructs behind the cameras; expected the same line in both views")
    road, x = _Road.through(start)
    drawn = len(left) + len(right)

    def misses(x: Array) -> Array:
        curve = np.maximum(road.points(x), [-np.inf, -np.inf, 0.5])
        views = zip(rig.cameras, (left, right), (curve, rig.to_right(curve)), strict=True)
        return np.concatenate([_distances_to_polyline(p, c.project(q)) for c, p, q in views]) / DRAWING_SIGMA

    best = (-np.inf, x, np.eye(len(x)))
    for strength in CURVATURE_WALKS:
        prior = road.prior(strength)

        def residuals(x: Array, prior: Array = prior) -> Array:
            return np.concatenate([misses(x), prior @ x])

        fit = least_squares(residuals, x, loss=_soft_l1_of_drawings(drawn), x_scale=road.scale, max_nfev=80)
        information = fit.jac.T @ fit.jac
        evidence = -fit.cost + np.linalg.slogdet(prior)[1] - 0.5 * np.linalg.slogdet(information)[1]
        x = fit.x
        if evidence > best[0]:
            best = (evidence, x, information)
    _, x, information = best
    # a worse hand than expected widens the covariance
    scatter = max(1.0, float(np.median(np.abs(misses(x)))) / 0.6745)
    values, vectors = np.linalg.eigh(np.linalg.inv(information) * scatter**2)
    points = road.points(x)
    slopes = _jacobian(lambda y: road.points(y).ravel(), x, 1e-5)
    modes = np.array([(slopes @ v).reshape(-1, 3) * np.sqrt(a) for a, v in zip(values, vectors.T, strict=True)])
    ahead = points[:, 2] > 1.0
    path = _resampled(name, "curve", points[ahead], modes[:, ahead])
    if np.median(np.sqrt((path.heading_modes(path.s)[0] ** 2).sum(0))) > MAX_DIRECTION_STD:
        raise UnusableInput(
            f"path {name}: the drawn curves run nearly parallel to the epipolar lines, so the two views do not "
            "determine them in space; draw another line, or leave the vehicle without a path"
        )
    return path


CURVATURE_WALKS = (2e-4, 1e-3, 5e-3)  # m^-1.5: an arc of constant radius, a gentle transition, a tight one
CREST_WALK = 2e-4  # m^-1.5, the same for the vertical curvature


class _Road:
    """A curve by its heading: ``x`` = middle point (3), yaw and pitch there, then both curvatures at K knots.

    The curvatures are linear between the knots; yaw turns about the camera's y axis, pitch is down.
    """

    def __init__(self, length: float) -> None:
        margin = max(8.0, 0.25 * length)  # the vehicle is often seen before the line begins
        half = 0.5 * length + margin
        self.s = np.linspace(-half, half, 2 * SAMPLES + 1)
        self.knots = np.linspace(-half, half, int(np.clip(2 * half / 10.0, 4, 10)))
        hats = np.stack([np.interp(self.s, self.knots, e) for e in np.eye(len(self.knots))], axis=1)
        self.turn = _integral(hats, self.s)  # (samples, K): heading change since the middle per unit of curvature
        self.scale = np.concatenate([np.ones(3), np.full(2, 0.02), np.full(2 * len(self.knots), 1e-3)])

    @classmethod
    def through(cls, points: Array) -> tuple[_Road, Array]:
        """A road of the length of ``points`` (N, 3), and a robust first ``x`` near them."""
        middle = np.median(points, axis=0)
        u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        coarse = np.array([np.median(c, axis=0) for c in np.array_split(points, min(len(points), 9))])
        length = min(u[-1], 3 * float(np.linalg.norm(np.diff(coarse, axis=0), axis=1).sum()))
        road = cls(length)
        along = coarse[-1] - coarse[0]
        x = np.concatenate([middle, [np.arctan2(along[0], along[2]), 0.0], np.zeros(2 * len(road.knots))])
        prior = road.prior(CURVATURE_WALKS[-1])

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
        for first, walk, widest in ((5, strength, 0.05), (5 + K, CREST_WALK, 2e-3)):
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
    """Signed distances (N,) of ``points`` (N, 2) to the polyline (M, 2); 0 for points beyond its ends."""
    nearest = np.argmin(((points[:, None] - line) ** 2).sum(-1), axis=1)
    i = np.clip(nearest, 1, len(line) - 2)
    along = line[i + 1] - line[i - 1]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    offset = points - line[i]
    across = offset[:, 0] * along[:, 1] - offset[:, 1] * along[:, 0]
    return across


def _meet_along_epipolar_lines(rig: StereoRig, left: Array, right: Array) -> Array:
    """World points (N, 3), in order along the left curve, where the epipolar lines of its points cross the right one."""
    a, b = (_polyline(p, 120) for p in (left, right))
    lines = np.column_stack([a, np.ones(len(a))]) @ rig.fundamental.T
    side = np.column_stack([b, np.ones(len(b))]) @ lines.T  # (right samples, left samples)
    candidates: list[list[tuple[float, float]]] = []
    tangent = np.diff(b, axis=0)
    for j in range(len(a)):
        crossings = np.flatnonzero(side[:-1, j] * side[1:, j] <= 0)
        found = []
        for i in crossings:
            f = side[i, j] / (side[i, j] - side[i + 1, j] + 1e-300)
            slope = abs(tangent[i] @ lines[j, :2]) / (np.linalg.norm(tangent[i]) * np.linalg.norm(lines[j, :2]) + 1e-12)
            found.append((i + f, slope))
        candidates.append(found)
    chosen = _smoothest_chain(candidates)
    points = []
    for j, r in chosen:
        i = min(int(r), len(b) - 2)
        pixel = b[i] + (r - i) * tangent[i]
        points.append(triangulate(rig, a[j], pixel))
    return np.array(points).reshape(-1, 3)


def _smoothest_chain(candidates: list[list[tuple[float, float]]]) -> list[tuple[int, float]]:
    """One crossing per left sample, such that the chain moves least along the right curve (dynamic programming).

    Crossings nearly parallel to their epipolar line are left out. Returns (left sample, right parameter) pairs.
    """
    kept = [(j, [r for r, slope in c if slope > 0.08]) for j, c in enumerate(candidates)]
    kept = [(j, rs) for j, rs in kept if rs]
    if not kept:
        return []
    cost = np.zeros(len(kept[0][1]))
    back: list[NDArray[np.int64]] = []
    for (_, previous), (_, current) in zip(kept, kept[1:], strict=False):
        total = cost[:, None] + np.abs(np.subtract.outer(previous, current))
        back.append(np.argmin(total, axis=0))
        cost = total.min(0)
    k = int(np.argmin(cost))
    chain = [(kept[-1][0], kept[-1][1][k])]
    for step in range(len(back) - 1, -1, -1):
        k = int(back[step][k])
        chain.append((kept[step][0], kept[step][1][k]))
    return chain[::-1]


def _polyline(points: Array, n: int) -> Array:
    """``n`` samples (n, 2), equally spaced in chord length, of a smoothing spline through drawn ``points`` (N, 2)."""
    u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(u) > 1e-6])
    u, points = u[keep], points[keep]
    at = np.linspace(0, u[-1], n)
    if len(u) < 6:
        return np.asarray(CubicSpline(u, points, axis=0)(at))
    order = np.arange(len(u), dtype=float)  # drawn points crowd with distance: smooth over their order
    noise = len(u) * (1.5 * DRAWING_SIGMA) ** 2
    smooth = [UnivariateSpline(order, c, k=3, s=noise)(order) for c in points.T]
    return np.stack([np.interp(at, u, c) for c in smooth], axis=1)


def _resampled(name: str, shape: str, points: Array, modes: Array) -> Path:
    """The path through ``points`` (N, 3), in order, at equal arc lengths; ``modes`` (J, N, 3) come along."""
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    s = np.linspace(0, chord[-1], SAMPLES)
    moved = CubicSpline(chord, modes, axis=1)(s) if len(modes) else np.zeros((0, SAMPLES, 3))
    return Path(name, shape, s, np.asarray(CubicSpline(chord, points, axis=0)(s)), np.asarray(moved))


def _jacobian(f: Callable[[Array], Array], x: Array, step: float) -> Array:
    """Central differences of ``f`` at ``x``, shape (len(f), len(x))."""
    columns = []
    for i in range(len(x)):
        e = np.zeros(len(x))
        e[i] = step
        columns.append((f(x + e) - f(x - e)) / (2 * step))
    return np.stack(columns, axis=1)
