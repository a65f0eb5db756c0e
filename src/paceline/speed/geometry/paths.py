"""Paths along a road, reconstructed from their drawings in the two views ([Zhu] section IV).

A :class:`Path` is a space curve C(s) over arc length with the covariance of its reconstruction, held as displacement
*modes*: the true curve is C(s) + Σⱼ qⱼ·modeⱼ(s) with independent q ~ N(0, 1). A path is a prior, not a hard
constraint: taking the drawn line as exact biases the speed by 2–7 %.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline

from paceline.arrays import Array
from paceline.cameras import Camera, StereoRig
from paceline.errors import UnusableInput
from paceline.speed.configuration import DEFAULTS

ANOTHER_LINE = "draw another line, or leave the vehicle without a path"
MAX_DIRECTION_STD_RAD = np.radians(6.0)  # standard deviation of the direction above which a drawing is refused
MIN_PLANE_SEPARATION_SIGMA = 5.0  # angle between the two views' planes through the line, in standard deviations
SURVEY_SIGMA_M = 0.02  # standard deviation of a surveyed point, m
PATH_SAMPLES = 128


class UndeterminedPath(UnusableInput):
    """A drawing that does not determine its path in space: for which ``cause``, and what is ``expected`` instead."""

    def __init__(self, name: str, cause: str, expected: str) -> None:
        self.name, self.cause = name, cause
        super().__init__(f"path {name}: {cause}; {expected}")


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
        if self.shape == "line":
            return np.asarray(self.points[0] + (np.asarray(s)[..., None] - self.s[0]) * self._line_frame[:, 0])
        inside = np.clip(s, self.s[0], self.s[-1])
        excess = np.asarray(s) - inside
        return np.asarray(self._spline(inside) + excess[..., None] * self._spline(inside, 1))

    @cached_property
    def _line_frame(self) -> Array:
        return level_frames(self.points[-1] - self.points[0])

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
        if self.shape == "line":
            return np.broadcast_to(self._line_frame, (*np.shape(s), 3, 3))
        inside = np.clip(s, self.s[0], self.s[-1])
        level = level_frames(np.asarray(self._spline(inside, 1)))
        return rolled(level, np.interp(inside, self.s, self._roll))

    def pieces(self) -> tuple[Array, Array, Array]:
        """The path as cubics: breaks (K,) of the arc length, coefficients (K − 1, 3, 4) of each coordinate after each
        break, the highest power first, and the roll (K,) of the frames at the breaks."""
        if self.shape == "line":
            slope = np.stack([np.zeros(3), np.zeros(3), self._line_frame[:, 0], self.points[0]], axis=-1)
            return self.s[[0, -1]], slope[None], np.zeros(2)
        return self.s, np.ascontiguousarray(self._spline.c.transpose(1, 2, 0)), self._roll

    def nearest(self, point: Array) -> float:
        """Arc length at which the plane through ``point`` (3,) normal to the path meets it."""
        if self.shape == "line":
            return float(self.s[0] + (point - self.points[0]) @ self._line_frame[:, 0])
        s = float(self.s[np.argmin(np.linalg.norm(self.points - point, axis=1))])
        for _ in range(20):
            t = self.frames(np.array(s))[:, 0]
            step = float(t @ (point - self.at(np.array(s))))
            s += step
            if abs(step) < 1e-9:
                break
        return s

    def direction_near(self, point: Array) -> Array:
        """The unit tangent (3,), along increasing s, next to ``point`` (3,)."""
        return self.frames(np.array(self.nearest(point)))[:, 0]

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
        return resampled(self.name, self.shape, points, self.modes)

    def scaled(self, factor: float) -> Path:
        """The path as cameras ``factor`` times as far apart would have reconstructed it."""
        return Path(self.name, self.shape, factor * self.s, factor * self.points, factor * self.modes)

    def reversed(self) -> Path:
        """The same curve travelled the other way."""
        s = self.s[-1] - self.s[::-1]
        return Path(self.name, self.shape, s, self.points[::-1].copy(), self.modes[:, ::-1].copy())


def both_ways(path: Path, lateral_offset: float) -> list[Path]:
    """The drawn ``path`` in both directions, along which a vehicle may drive, each ``lateral_offset`` m to its own
    right."""
    return [p.shifted(lateral_offset) for p in (path, path.reversed())]


def distance_beside(paths: Sequence[Path], place: Array) -> tuple[float, bool]:
    """The distance (m) at which the nearest of the ``paths`` passes a ``place`` (3,), and whether it is known there: a
    curve is not beyond its ends, where it runs on straight, and the road need not."""
    distances, known = [], []
    for path in paths:
        s = path.nearest(place)
        distances.append(float(np.linalg.norm(path.at(np.array(s)) - place)))
        known.append(path.shape == "line" or bool(path.s[0] <= s <= path.s[-1]))
    nearest = int(np.argmin(distances))
    return distances[nearest], known[nearest]


def path_ahead(paths: Sequence[Path], place: Array, direction: Array) -> Path:
    """That of the ``paths`` which, next to a ``place`` (3,), goes most nearly in the ``direction`` (3,)."""
    return max(paths, key=lambda path: float(direction @ path.direction_near(place)))


def level_frames(directions: Array) -> Array:
    """Frames (…, 3, 3), columns T, P, B: T along ``directions`` (…, 3), P horizontal to its right, B = T × P down.

    "Horizontal" is the camera's x–z plane; a path that runs along the camera's y axis takes x for its P.
    """
    T = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    x, y, z = T[..., 0], T[..., 1], T[..., 2]
    length = np.hypot(x, z)
    steep = length < 1e-6
    px = np.where(steep, 1.0, z / np.maximum(length, 1e-12))
    pz = np.where(steep, 0.0, -x / np.maximum(length, 1e-12))
    P = np.stack([px, np.zeros_like(px), pz], axis=-1)
    B = np.stack([y * pz, z * px - x * pz, -y * px], axis=-1)
    return np.stack([T, P, B], axis=-1)


def rotation_minimising_roll(level: Array) -> Array:
    """Angles (…, N) about T by which level frames (…, N, 3, 3) along curves must roll not to turn about T at all."""
    P, B = level[..., 1], level[..., 2]
    turns = 0.5 * (np.diff(P, axis=-2) * (B[..., :-1, :] + B[..., 1:, :])).sum(-1)
    return np.concatenate([np.zeros((*turns.shape[:-1], 1)), -np.cumsum(turns, axis=-1)], axis=-1)


def rolled(frames: Array, roll: Array) -> Array:
    """``frames`` (…, 3, 3), columns T, P, B, turned about T by ``roll`` (…)."""
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    T, P, B = frames[..., 0], frames[..., 1], frames[..., 2]
    return np.stack([T, c * P + s * B, c * B - s * P], axis=-1)


def from_points(name: str, shape: str, points: Array) -> Path:
    """A path surveyed in the world frame: ``points`` (K, 3) in metres, taken as known to 2 cm each."""
    u = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if shape == "line" or len(points) < 4:
        return _line_path(name, *_fit_space_line(points, SURVEY_SIGMA_M))
    curve = CubicSpline(u, points, axis=0)(np.linspace(0, u[-1], PATH_SAMPLES))
    slope = np.linspace(-1, 1, PATH_SAMPLES)[:, None] * SURVEY_SIGMA_M
    F = level_frames(np.gradient(curve, axis=0))
    modes = np.stack([slope * F[:, :, 1], slope * F[:, :, 2]])
    return resampled(name, "curve", curve, modes)


# --- straight paths ------------------------------------------------------------------------------------------------


def reconstruct_line(name: str, rig: StereoRig, left: Array, right: Array, sigma: float = DEFAULTS.line_sigma) -> Path:
    """A straight path by intersecting the planes that its image lines span with the cameras ([Zhu] (19)–(21)).

    ``sigma`` px is the noise of a drawn point where too few are drawn to estimate it.
    """
    lines = [_fit_image_line(p, sigma) for p in (left, right)]
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

    covariance = np.zeros((4, 4))
    for i, (_, cov, _) in enumerate(lines):
        covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = cov
    c = crossing(x0)
    slope = c @ jacobian(crossing, x0, 1e-6)
    parallel = UndeterminedPath(
        name,
        "the drawn line is nearly parallel to the epipolar lines, so the two views do not determine it in space",
        ANOTHER_LINE,
    )
    if c @ c <= MIN_PLANE_SEPARATION_SIGMA * np.sqrt(slope @ covariance @ slope):  # the std of |c|, times |c|
        raise parallel
    J = jacobian(space_line, x0, 1e-6)
    line = space_line(x0)
    k, foot = line[:3], line[3:]
    cov = J @ covariance @ J.T
    if np.sqrt(np.linalg.eigvalsh(cov[:3, :3])[-1]) > MAX_DIRECTION_STD_RAD:
        raise parallel
    depths = np.array([_depth_on_line(rig.left, k, foot, p) for p in left])
    if not (depths > 0).any():
        raise UndeterminedPath(name, "reconstructs behind the cameras", "expected the same road line in both views")
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


def _fit_image_line(points: Array, sigma: float) -> tuple[Array, Array, Array]:
    """(angle of the normal, offset from the centroid), their covariance (2, 2), and the centroid, by orthogonal fit."""
    centre = points.mean(0)
    _, singular, axes = np.linalg.svd(points - centre)
    normal, along = axes[1], singular[0] ** 2
    residual = (points - centre) @ normal
    n = len(points)
    # the drawing's own scatter, shrunk towards the usual noise as if by four further residuals
    variance = (residual @ residual + 4 * sigma**2) / (n - 2 + 4)
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
    s = np.linspace(ends[0] @ k, ends[1] @ k, PATH_SAMPLES)
    points = foot + s[:, None] * k
    values, vectors = np.linalg.eigh(cov)
    keep = values > 1e-12 * max(values[-1], 1e-30)
    modes = [np.sqrt(a) * (s[:, None] * v[:3] + v[3:]) for a, v in zip(values[keep], vectors.T[keep], strict=True)]
    return Path(name, "line", s - s[0], points, np.array(modes).reshape(-1, PATH_SAMPLES, 3))


def resampled(name: str, shape: str, points: Array, modes: Array) -> Path:
    """The path through ``points`` (N, 3), in order, at equal arc lengths; ``modes`` (J, N, 3) come along."""
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    s = np.linspace(0, chord[-1], PATH_SAMPLES)
    resampled_modes = CubicSpline(chord, modes, axis=1)(s) if len(modes) else np.zeros((0, PATH_SAMPLES, 3))
    return Path(name, shape, s, np.asarray(CubicSpline(chord, points, axis=0)(s)), np.asarray(resampled_modes))


def jacobian(f: Callable[[Array], Array], x: Array, step: float) -> Array:
    """Central differences of ``f`` at ``x``, shape (len(f), len(x))."""
    columns = []
    for i in range(len(x)):
        e = np.zeros(len(x))
        e[i] = step
        columns.append((f(x + e) - f(x - e)) / (2 * step))
    return np.stack(columns, axis=1)
