"""Motion model of the refinement: a plane's motion along its path as a function of a few parameters.

A :class:`Trajectory` maps the parameters to the homographies from the unit square of the plane's region to both views
at every frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from paceline.arrays import Array
from paceline.cameras import StereoRig
from paceline.speed.configuration import DEFAULTS, DriverSettings
from paceline.speed.geometry.fitted_arc import CURVATURE_STD_PER_M
from paceline.speed.geometry.initial_plane import InitialPlane
from paceline.speed.geometry.paths import Path
from paceline.speed.geometry.quadrilaterals_cpu import unit_square_to
from paceline.speed.refinement.path_deviation import PathDeviation, gaussian_process_modes
from paceline.speed.refinement.trajectory_cpu import own_path_frames

MOTION_PARAMETER_NAMES = (
    "log_depth",  # ln m, of the region's centre at the first frame
    "speed",  # m/s at the first frame
    "acceleration",  # m/s²
    "normal_yaw",  # rad, from the initial plane's normal
    "normal_tilt",
    "curvature",  # 1/m, in addition to the path's, to the right
)  # and then the amplitudes of the deviation from the path and of the varying acceleration
PARAMETER_INDEX = {name: i for i, name in enumerate(MOTION_PARAMETER_NAMES)}
MOTION_TERMS = ("acceleration", "varying_acceleration", "lane_change", "curvature")
EXPOSURE_QUANTITIES = ("offset", "left readout", "right readout")
DIFFERENCE_STEPS = np.array([1e-5, 1e-4, 1e-4, 1e-5, 1e-5, 1e-6])
AMPLITUDE_STEP = 1e-3
UNIT_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
OWN_PATH_KNOTS = 97  # along a vehicle's own path, between which it is interpolated

CONSTANT_SPEED_STD_MPS2 = 0.01  # m/s², of the acceleration at a speed that is kept constant, as by cruise control
LOG_DEPTH_STD = 0.3
SPEED_STD_MPS = 30.0  # standard deviation of the speed's prior, so wide that it has little effect


@dataclass(frozen=True, eq=False)
class Prior:
    """Gaussian prior: ``mean`` (n,) of all parameters, indices of the ``free`` ones, and their ``information``."""

    mean: Array
    free: NDArray[np.int64]
    information: Array


@dataclass(frozen=True, eq=False)
class ExposureTiming:
    """What is uncertain of the exposures of both views: M of `EXPOSURE_QUANTITIES`, with standard deviations (s).

    ``modes`` (M, F, 2) are the exposures' changes (s) by one standard deviation of each, and ``readouts`` (M, 2) those
    of the two readouts. While the rows of the region are read it moves by ``row_motion`` (F, 2, 2), px/s for each row
    of the picture, about its ``rows`` (F, 2), px.
    """

    modes: Array
    readouts: Array
    row_motion: Array
    rows: Array
    stds: dict[str, float] = field(default_factory=dict)

    def shift(self, sigma: Array) -> Array:
        """The exposures' change (F, 2), s, by ``sigma`` (M,) standard deviations."""
        return np.asarray(np.tensordot(sigma, self.modes, 1))

    def shear(self, readouts: Array) -> Array:
        """How the region is sheared and stretched in both views (F, 2, 3, 3), by their ``readouts`` (2,) s."""
        by_row = self.row_motion * readouts[:, None]
        shear = np.tile(np.eye(3), (*self.rows.shape, 1, 1))
        shear[..., :2, 1] += by_row
        shear[..., :2, 2] -= by_row * self.rows[..., None]
        return shear


def exact_timing(frames: int) -> ExposureTiming:
    """The timing of ``frames`` that are all exposed at once."""
    none = np.zeros((0, 2))
    return ExposureTiming(np.zeros((0, frames, 2)), none, np.zeros((frames, 2, 2)), np.zeros((frames, 2)))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A plane region ``quad`` (4, 2) px, outlined in the left view at time 0, that moves along ``path``.

    ``plane`` gives the initial normal; ``times`` (F, 2) are when each view exposes the region, in seconds since the
    outline, and ``frame_times`` (F,) when the speed is asked for: they do not follow the exposures where these are
    estimated. ``timing`` says how uncertain the exposures are, and ``readouts`` (2,) s are those of both views' rows.
    The parameters ``theta`` (n,) are those of MOTION_PARAMETER_NAMES, then the amplitudes of ``deviation`` and those of
    a varying acceleration, a Gaussian process over time. ``driver`` gives the prior of the motion; ``curvature_mean``
    (1/m) is the prior mean of the curvature in addition to the path's: not zero where the path is the filter's.
    """

    rig: StereoRig
    quad: Array
    plane: InitialPlane
    path: Path
    times: Array
    deviation: PathDeviation
    frame_times: Array
    timing: ExposureTiming
    readouts: Array
    driver: DriverSettings = DEFAULTS.driver
    curvature_mean: float = 0.0

    @cached_property
    def steps(self) -> Array:
        """Steps (n,) for finite differences by the parameters."""
        return np.concatenate(
            [DIFFERENCE_STEPS, np.full(self._acceleration_count + len(self.deviation.modes), AMPLITUDE_STEP)]
        )

    def index(self, name: str) -> NDArray[np.int64]:
        """Indices in ``theta`` of one of MOTION_TERMS, or of the whole "deviation"."""
        n = len(self.steps)
        if name == "deviation":
            return np.arange(len(MOTION_PARAMETER_NAMES), n - self._acceleration_count)
        if name == "varying_acceleration":
            return np.arange(n - self._acceleration_count, n)
        if name == "lane_change":
            return np.arange(
                n - self._acceleration_count - self.deviation.lane_change_modes, n - self._acceleration_count
            )
        return np.array([PARAMETER_INDEX[name]])

    @cached_property
    def _acceleration_process(self) -> CubicSpline:
        """Modes of the varying acceleration (m/s²) over time."""
        first, last = float(self.frame_times.min()), float(self.frame_times.max())
        return _acceleration_modes(first, last, self.driver.braking, self.driver.braking_time)

    @property
    def _acceleration_count(self) -> int:
        return int(self._acceleration_process.c.shape[-1])

    def scaled(self, factor: float) -> Trajectory:
        """The same with path and plane ``factor`` times as large, as a baseline as much longer would give."""
        return replace(
            self,
            path=self.path.scaled(factor),
            plane=replace(self.plane, centre=factor * self.plane.centre),
            deviation=replace(self.deviation, u=factor * self.deviation.u),
        )

    def exposed(self, sigma: Array) -> Trajectory:
        """The same with the exposures changed by ``sigma`` (M,) standard deviations of what is uncertain of them."""
        readouts = self.readouts + sigma @ self.timing.readouts
        return replace(self, times=self.times + self.timing.shift(sigma), readouts=readouts)

    @cached_property
    def _ray(self) -> Array:
        return np.asarray(self.rig.left.rays(self.quad.mean(0)))

    @cached_property
    def _outline_homography(self) -> Array:
        return np.asarray(unit_square_to(self.quad[None])[0])

    @cached_property
    def _normal_in_path_frame(self) -> Array:
        start = self.path.nearest(self.plane.centre)
        return np.asarray(self.path.frames(np.array(start)).T @ self.plane.normal)

    def distance(self, theta: Array) -> Array:
        """Distance travelled (F, 2) along the vehicle's own path since time 0, m."""
        return np.asarray(self._distance_jacobian @ theta)

    @cached_property
    def _distance_jacobian(self) -> Array:
        """Derivative (F, 2, n) of the distance, which is linear in the parameters."""
        return self._distance_jacobian_at(self.times)

    def _distance_jacobian_at(self, times: Array) -> Array:
        """Derivative (…, n) of the distance at ``times`` (…) s."""
        speeds = self._acceleration_process.antiderivative()
        distances = speeds.antiderivative()
        jacobian = np.zeros((*times.shape, len(self.steps)))
        jacobian[..., PARAMETER_INDEX["speed"]] = times
        jacobian[..., PARAMETER_INDEX["acceleration"]] = 0.5 * times**2
        varying = distances(times) - distances(0.0) - speeds(0.0) * times[..., None]
        jacobian[..., self.index("varying_acceleration")] = varying
        return jacobian

    @cached_property
    def speed_jacobian(self) -> Array:
        """Derivative (F, n) of the speed at the frames, which is linear in the parameters."""
        t = self.frame_times
        speeds = self._acceleration_process.antiderivative()
        jacobian = np.zeros((len(t), len(self.steps)))
        jacobian[:, PARAMETER_INDEX["speed"]], jacobian[:, PARAMETER_INDEX["acceleration"]] = 1.0, t
        jacobian[:, self.index("varying_acceleration")] = speeds(t) - speeds(0.0)
        return jacobian

    @cached_property
    def mean_speed_gradient(self) -> Array:
        """Derivative (n,) of the mean speed: distance over time between the first and the last frame."""
        t = self.frame_times[[0, -1]]
        first, last = self._distance_jacobian_at(t)
        return np.asarray((last - first) / (t[1] - t[0]))

    def motion(self, theta: Array) -> tuple[Array, Array, Array, Array]:
        """Rigid motions since time 0 and the initial plane n·P = d, by ``theta`` (…, n).

        Rotations (…, F, 2, 3, 3), translations (…, F, 2, 3), n (…, 3) and d (…).
        """
        parameters = theta.reshape(-1, theta.shape[-1])
        shape = theta.shape[:-1]
        start = self._ray * np.exp(parameters[:, :1])
        travelled = np.tensordot(parameters, self._distance_jacobian, (1, 2))
        distances = np.concatenate([np.zeros((len(parameters), 1)), travelled.reshape(len(parameters), -1)], axis=1)
        u = np.linspace(distances.min() - 1.0, distances.max() + 1.0, OWN_PATH_KNOTS)
        yaw, pitch = self.deviation.angles(
            parameters[:, len(MOTION_PARAMETER_NAMES) :][:, : len(self.deviation.modes)], u
        )
        yaw = np.ascontiguousarray(yaw + parameters[:, PARAMETER_INDEX["curvature"], None] * u)
        frames, places = np.empty((*distances.shape, 3, 3)), np.empty((*distances.shape, 3))
        own_path_frames(*self.path.pieces(), start, u, yaw, np.ascontiguousarray(pitch), distances, frames, places)
        start_frame = frames[:, 0]
        R = (frames[:, 1:] @ np.swapaxes(start_frame, -1, -2)[:, None]).reshape(*travelled.shape, 3, 3)
        moved = (places[:, 1:] - places[:, :1]).reshape(*travelled.shape, 3)
        origin = start[:, None, None]
        t = origin + moved - (R @ origin[..., None])[..., 0]
        yaw, tilt = (parameters[:, PARAMETER_INDEX[name]] for name in ("normal_yaw", "normal_tilt"))
        n = (start_frame @ rotate_normal(self._normal_in_path_frame, yaw, tilt)[..., None])[..., 0]
        d = (n * start).sum(-1)
        return R.reshape(*shape, *R.shape[1:]), t.reshape(*shape, *t.shape[1:]), n.reshape(*shape, 3), d.reshape(shape)

    def accelerations(self, theta: Array) -> Array:
        """Accelerations (…, F − 1, 2) m/s² between successive frames by ``theta`` (…, n): along the path, and across it
        by its turning."""
        duration = np.diff(self.times[:, 0])
        speed = theta @ self.speed_jacobian.T
        R = self.motion(theta)[0][..., 0, :, :]
        turn = np.swapaxes(R[..., :-1, :, :], -1, -2) @ R[..., 1:, :, :]
        angle = np.arccos(np.clip((np.trace(turn, axis1=-2, axis2=-1) - 1) / 2, -1.0, 1.0))
        mean_speed = (speed[..., 1:] + speed[..., :-1]) / 2
        return np.stack([np.diff(speed, axis=-1) / np.diff(self.frame_times), mean_speed * angle / duration], axis=-1)

    def distance_across(self, theta: Array) -> Array:
        """How much farther (F,) than the region's middle a point has come, m, that is one width of the region to its
        right, by ``theta`` (n,): on a bend the outer side of a vehicle is faster."""
        R = self.motion(theta)[0]
        ahead = np.diff(self.centres(theta), axis=0)
        ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
        return np.append(0.0, np.cumsum((np.diff(R[:, 0] @ self._width(theta), axis=0) * ahead).sum(1)))

    def middle_of_outlines(self, theta: Array, right: Array) -> float:
        """How far the middle of the face is from the region's centre, in widths of the region to its right, by
        ``theta`` (n,): the mean of the corners of both outlines, that of the right view being ``right`` (4, 2) px.

        The region's centre is where the left view shows the mean of its corners' images. Of a face that is seen
        obliquely its nearer half is the wider one there.
        """
        by_right = np.c_[right, np.ones(4)] @ np.linalg.inv(self.homographies(theta)[0][0, 1]).T
        square = np.concatenate([UNIT_SQUARE, by_right[:, :2] / by_right[:, 2:]])
        width = self._width(theta)
        return float((self.places(theta, square).mean(0) - self._start(theta)) @ width / (width @ width))

    def _width(self, theta: Array) -> Array:
        """From the middle of the region's left side to that of its right side (3,) m, at time 0."""
        _, _, n, d = self.motion(theta)
        left, right = self.rig.left.rays(0.5 * (self.quad[[0, 1]] + self.quad[[3, 2]]))
        return np.asarray(d * (right / (n @ right) - left / (n @ left)))

    def _start(self, theta: Array) -> Array:
        """World point (3,) of the region's centre at time 0."""
        return np.asarray(self._ray * np.exp(theta[PARAMETER_INDEX["log_depth"]]))

    def homographies(self, theta: Array) -> tuple[Array, Array]:
        """H (…, F, 2, 3, 3) from the unit square to both views by ``theta`` (…, n), and ∂H/∂d."""
        return self._view_homographies(self.rig, *self.motion(theta))

    def homographies_by_rig(self, rigs: list[StereoRig], theta: Array) -> Array:
        """H (Q, F, 2, 3, 3) by ``theta`` (n,) for each of Q ``rigs``."""
        motion = self.motion(theta)
        return np.array([self._view_homographies(rig, *motion)[0] for rig in rigs])

    def _view_homographies(self, rig: StereoRig, R: Array, t: Array, n: Array, d: Array) -> tuple[Array, Array]:
        """`homographies` of a `motion` for ``rig``."""
        back = rig.left.K_inv @ self._outline_homography
        K = np.stack([rig.left.K, rig.right.K])
        R_view = np.stack([np.eye(3), rig.R])
        t_view = np.stack([np.zeros(3), rig.t])
        H_d = K @ (R_view @ R) @ back
        shift = (R_view @ t[..., None])[..., 0] + t_view
        plane = shift[..., None] * n[..., None, None, None, :]
        H = d[..., None, None, None, None] * H_d + K @ plane @ back
        if self.readouts.any():
            shear = self.timing.shear(self.readouts)
            return shear @ H, shear @ H_d
        return np.asarray(H), H_d

    def projections(self, theta: Array) -> Array:
        """Matrices (…, F, 2, 3, 4) by which both views show a point that moves with the vehicle, given in the world's
        axes as it is at time 0, at every frame by ``theta`` (…, n)."""
        R, t, _, _ = self.motion(theta)
        K = np.stack([self.rig.left.K, self.rig.right.K])
        if self.readouts.any():
            K = self.timing.shear(self.readouts) @ K
        R_view = np.stack([np.eye(3), self.rig.R])
        t_view = np.stack([np.zeros(3), self.rig.t])
        shift = (R_view @ t[..., None])[..., 0] + t_view
        return np.asarray(K @ np.concatenate([R_view @ R, shift[..., None]], axis=-1))

    def places(self, theta: Array, square: Array) -> Array:
        """World points (N, 3) at time 0 of ``square`` (N, 2), points of the unit square of the region, by ``theta``
        (n,)."""
        _, _, n, d = self.motion(theta)
        rays = np.c_[square, np.ones(len(square))] @ (self.rig.left.K_inv @ self._outline_homography).T
        return np.asarray(rays * (d / (rays @ n))[:, None])

    def quads(self, theta: Array) -> Array:
        """The region's corners (…, F, 2, 4, 2) px in both views at every frame by ``theta`` (…, n)."""
        return corners_of(self.homographies(theta)[0])

    def directions(self, theta: Array) -> Array:
        """Unit vectors (F, 2, 3), in the vehicle's axes, from the region's centre to the cameras, by ``theta`` (n,)."""
        R, t, _, _ = self.motion(theta)
        seen_from = ((self.rig.centres - t)[..., None, :] @ R)[..., 0, :] - self._start(theta)
        return np.asarray(seen_from / np.linalg.norm(seen_from, axis=-1, keepdims=True))

    def centres(self, theta: Array) -> Array:
        """World points (F, 3) of the region's centre."""
        R, t, _, _ = self.motion(theta)
        return np.asarray(R[:, 0] @ self._start(theta) + t[:, 0])


@lru_cache(maxsize=16)
def _acceleration_modes(first: float, last: float, sigma: float, scale: float) -> CubicSpline:
    """Modes of an acceleration (m/s²) between two times: a Gaussian process of ``sigma`` m/s², correlated over
    ``scale`` s."""
    t = np.linspace(first - 0.1, last + 0.1, 81)
    return CubicSpline(t, gaussian_process_modes(t, sigma, scale).T)


def rotate_normal(normal: Array, yaw: Array | float, tilt: Array | float) -> Array:
    """A unit ``normal`` (3,) in path axes T, P, B, rotated by ``yaw`` (…) about B and by ``tilt`` (…) about the
    horizontal axis: (…, 3)."""
    B = np.array([0.0, 0.0, 1.0])
    across = np.cross(B, normal)
    across /= max(float(np.linalg.norm(across)), 1e-9)
    n = normal + np.asarray(yaw)[..., None] * across + np.asarray(tilt)[..., None] * B
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))


def corners_of(H: Array) -> Array:
    """Images (…, 4, 2) of the unit square's corners under ``H`` (…, 3, 3)."""
    p = np.c_[UNIT_SQUARE, np.ones(4)] @ np.swapaxes(H, -1, -2)
    return np.asarray(p[..., :2] / p[..., 2:])


def prior(trajectory: Trajectory, speed: float, terms: tuple[str, ...] = (), is_constant: bool = False) -> Prior:
    """The prior by how drivers brake, turn and keep their lane, how fronts are tilted, and the path's covariance.

    ``speed`` (m/s) is the mean, with a wide prior. Those of MOTION_TERMS that are not in ``terms`` are fixed at
    their means, the acceleration at that of drivers who hold their speed or, where it ``is_constant``, at nearly zero.
    """
    std = parameter_stds(trajectory)
    for name in MOTION_TERMS:
        if name not in terms:
            std[trajectory.index(name)] = 0.0
    if "acceleration" not in terms:
        std[PARAMETER_INDEX["acceleration"]] = CONSTANT_SPEED_STD_MPS2 if is_constant else trajectory.driver.steadiness
    mean = np.zeros_like(std)
    mean[:2] = np.log(trajectory.plane.centre[2]), speed
    mean[len(MOTION_PARAMETER_NAMES) :][: len(trajectory.deviation.mean)] = trajectory.deviation.mean
    mean[PARAMETER_INDEX["curvature"]] = trajectory.curvature_mean
    mean[PARAMETER_INDEX["normal_tilt"]] = trajectory.plane.mean_tilt
    free = np.flatnonzero(std > 0)
    return Prior(mean, free, np.diag(1.0 / std[free] ** 2))


def parameter_stds(trajectory: Trajectory) -> Array:
    """Prior standard deviations (n,) of all parameters, with all motion terms."""
    std = np.ones(len(trajectory.steps))
    std[: len(MOTION_PARAMETER_NAMES)] = (
        LOG_DEPTH_STD,
        SPEED_STD_MPS,
        trajectory.driver.braking,
        *trajectory.plane.normal_std,
        CURVATURE_STD_PER_M,
    )
    return std
