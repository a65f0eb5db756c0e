"""The motion of particles: [Zhu] (9)–(11) or a coordinated turn without a path, (22)–(24) along a straight one,
(25)–(27) along a curve.

The state of N particles is kept in aligned arrays. The 2-D substates are dependent variables: they follow the plane's
motion through the homographies (5), and no noise is added to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from paceline.arrays import Array, Indices
from paceline.cameras import Camera, StereoRig
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.geometry import quadrilaterals_cpu
from paceline.speed.geometry.paths import Path

NoiseDraws = list[tuple[float, int]]  # for each kind of noise, in the order of drawing: sigma, and numbers a particle

ZHU_FRAME_INTERVAL_S = 0.2  # s, the frame interval of [Zhu], to which its noises per frame refer
COVARIANCE_FLOOR_M2 = 1e-12  # m², keeps a covariance positive definite
NO_DISPLACEMENT = np.zeros(3)  # m, between exposures at the same instant


@dataclass(frozen=True, eq=False)
class State:
    """N particles: 2-D substates, the plane n·P = d in the left camera's frame, and its motion.

    Along a path the motion is ``speed`` at arc length ``s``, and ``heading`` is each particle's own angle (yaw,
    pitch, in radians) between the true path and the drawn one. Without a path it is ``velocity`` and
    ``turning`` (Euler angles per second).
    """

    left: Array  # (N, 4, 2) px
    right: Array  # (N, 4, 2) px
    normal: Array  # (N, 3)
    distance: Array  # (N,) m
    speed: Array  # (N,) m/s
    s: Array  # (N,) m
    heading: Array  # (N, 2) rad
    velocity: Array  # (N, 3) m/s
    turning: Array  # (N, 3) rad/s

    def __len__(self) -> int:
        return len(self.speed)

    def __getitem__(self, index: Indices) -> State:
        return State(*(np.take(getattr(self, name), index, axis=0) for name in self.__dataclass_fields__))


def apply_rigid_motion(
    state: State, rig: StereoRig, dt: Array, dR: Array | None = None, displacement: Array = NO_DISPLACEMENT
) -> State:
    """``state`` after the rigid motions P' = ΔR P + Δt, given as (N, 3) and (N, 3, 3) (None: no rotation).

    Equations (5)–(8), (10), (11) of [Zhu], with planes that move by ``displacement`` (3,) m from the left exposure, at
    which the state holds, to the right one.
    """
    n, d = state.normal, state.distance
    R, t = rig.R, rig.t
    n_right = n @ R.T
    d_right = d + n_right @ t + n @ displacement
    dt_right = dt @ R.T  # with ΔR_right the decomposition of T ΔT T⁻¹ of (8)
    dR_right = None
    if dR is not None:
        dR_right = R @ dR @ R.T
        dt_right = dt_right + t - dR_right @ t
        n = _combine_columns(dR, n)
    before = state.normal / d[:, None]
    return replace(
        state,
        left=_map_regions(state.left, rig.left, dR, dt, before),
        right=_map_regions(state.right, rig.right, dR_right, dt_right, n_right / d_right[:, None]),
        normal=n,
        distance=d + np.einsum("ni,ni->n", dt, n),
    )


def _map_regions(quads: Array, camera: Camera, dR: Array | None, dt: Array, plane: Array) -> Array:
    """(11): vertices (N, 4, 2) taken through the homographies K (ΔR + Δt nᵀ/d) K⁻¹ of (5); ``plane`` is n/d."""
    turns = np.eye(3)[None] if dR is None else np.ascontiguousarray(dR)
    transferred = np.empty(quads.shape)
    quadrilaterals_cpu.transfer(quads, turns, np.ascontiguousarray(dt), plane, camera.K, camera.K_inv, transferred)
    return transferred


def _combine_columns(columns: Array, weights: Array) -> Array:
    """Σⱼ weightsⱼ·columnsⱼ (N, 3) of (N, 3, k) and (N, k)."""
    return np.asarray(np.einsum("nij,nj->ni", columns, weights))


def cross_homographies(rig: StereoRig, state: State) -> Array:
    """(15) for every particle's plane: H_c = K_r (R + t nᵀ/d) K_l⁻¹ (N, 3, 3) from the left view to the right one."""
    plane = (state.normal / state.distance[:, None]) @ rig.left.K_inv
    across = rig.right.K @ rig.R @ rig.left.K_inv
    return np.asarray(across + (rig.right.K @ rig.t)[:, None] * plane[:, None, :])


def plane_centres(rig: StereoRig, state: State) -> Array:
    """Points (N, 3) in which the rays through the left regions' centres meet the planes."""
    rays = rig.left.rays(diagonal_crossings(state.left))
    return np.asarray(rays * (state.distance / np.einsum("ni,ni->n", rays, state.normal))[:, None])


def diagonal_crossings(quads: Array) -> Array:
    """Projected centres (…, 2) of the planar regions ``quads`` (…, 4, 2): where their diagonals meet."""
    crossings = np.empty((*quads.shape[:-2], 2))
    quadrilaterals_cpu.cross_diagonals(quads.reshape(-1, 4, 2), crossings.reshape(-1, 2))
    return crossings


def ensemble_kalman_update(
    rig: StereoRig,
    state: State,
    W: Array,
    measurements: Array,
    noise: Array,
    model: FreeMotion | PathMotion,
    displacement: Array = NO_DISPLACEMENT,
) -> State:
    """``state`` after an ensemble Kalman step with measured centres of the plane.

    ``measurements`` (N, 3) are one perturbed measurement for each particle, ``noise`` (3, 3) its covariance. The gain
    comes from the weighted particles' covariance. The planes move by ``displacement`` (3,) m between the exposures.
    """
    centres, fields = plane_centres(rig, state), model.corrected_fields
    columns = [centres, *(getattr(state, f).reshape(len(state), -1) for f in fields)]
    x = np.concatenate(columns, axis=1)
    deviation = x - W @ x
    gain = kalman_gain(((W[:, None] * deviation).T @ deviation)[:, :3], noise)
    change = (measurements - centres) @ gain.T
    updates, start = {}, 3
    for f, column in zip(fields, columns[1:], strict=True):
        width = column.shape[1]
        updates[f] = getattr(state, f) + change[:, start : start + width].reshape(getattr(state, f).shape)
        start += width
    after = apply_rigid_motion(state, rig, change[:, :3], None, displacement)
    return model.after_shift(replace(after, **updates), change[:, :3])


def headings(velocity: Array, reference: Array) -> Array:
    """Angles (N,) rad about the camera's y axis from ``reference`` (3,) to each ``velocity`` (N, 3)."""
    x, z = velocity[:, 0], velocity[:, 2]
    return np.asarray(np.arctan2(reference[2] * x - reference[0] * z, reference[2] * z + reference[0] * x))


def with_normal(rig: StereoRig, state: State, normal: Array) -> State:
    """``state`` with planes of the ``normal`` (3,) through the same centres; the regions stay as they are."""
    centres = plane_centres(rig, state)
    return replace(state, normal=np.tile(normal, (len(centres), 1)), distance=centres @ normal)


def kalman_gain(covariance: Array, noise: Array) -> Array:
    """The gain (k, 3) of a measurement of the plane's centre with covariance ``noise`` (3, 3).

    ``covariance`` (k, 3) is that of everything, the centre first, with the centre.
    """
    return np.asarray(covariance @ np.linalg.inv(covariance[: len(noise)] + noise))


def cholesky_factor(covariance: Array) -> Array:
    """The lower triangular root (m, m) of a ``covariance`` (m, m), m²."""
    return np.asarray(np.linalg.cholesky(covariance + COVARIANCE_FLOOR_M2 * np.eye(len(covariance))), float)


def _draw_noise(draws: NoiseDraws, N: int, rng: np.random.Generator) -> list[Array]:
    return [rng.normal(0.0, sigma, N if k == 1 else (N, k)) for sigma, k in draws]


class FreeMotion:
    """Six degrees of freedom at constant velocity, with noise ([Zhu] (9)–(11))."""

    name = "free"
    corrected_fields = ("velocity", "turning")

    def __init__(self, rig: StereoRig, configuration: SpeedConfiguration) -> None:
        self.rig = rig
        self.rotation_noise = configuration.rotation_noise
        self.translation_noise = configuration.translation_noise

    def propagate(
        self, state: State, dt: float, rng: np.random.Generator, displacement: Array = NO_DISPLACEMENT
    ) -> State:
        """All particles ``dt`` seconds later. The plane turns about its own centre and is carried along.

        Planes move by ``displacement`` (3,) m from the left exposure to the right one.
        """
        turning, velocity = _draw_noise(self.noise_draws(dt), len(state), rng)
        turning, velocity = state.turning + turning, state.velocity + velocity
        dR = Rotation.from_euler("xyz", turning * dt).as_matrix()
        centre = plane_centres(self.rig, state)
        shift = centre + velocity * dt - _combine_columns(dR, centre)
        after = apply_rigid_motion(state, self.rig, shift, dR, displacement)
        return replace(after, turning=turning, velocity=velocity, speed=np.linalg.norm(velocity, axis=1))

    def noise_draws(self, dt: float) -> NoiseDraws:
        """The noise of ``dt`` seconds: of the turning, in rad/s, and of the velocity, in m/s."""
        scale = float(np.sqrt(dt / ZHU_FRAME_INTERVAL_S))
        return [(self.rotation_noise * scale, 3), (self.translation_noise * scale, 3)]

    def velocity(self, state: State) -> Array:
        """The velocity (3,) m/s of a state of one particle."""
        return np.asarray(state.velocity[0])

    def yaw_rate(self, state: State, dt: float) -> float:
        """Turning (rad/s) about the camera's y axis, to the right, of a state of one particle."""
        return float(state.turning[0, 1])

    def after_shift(self, state: State, shift: Array) -> State:
        """``state`` whose planes were moved by ``shift`` (N, 3)."""
        return replace(state, speed=np.linalg.norm(state.velocity, axis=1))


class CoordinatedTurn(FreeMotion):
    """Constant turn rate and velocity: a vehicle rolls without slipping sideways, so its velocity turns with its body.

    The velocity turns by the yaw alone, about the camera's y axis, which is nearly the road's vertical.
    """

    def propagate(
        self, state: State, dt: float, rng: np.random.Generator, displacement: Array = NO_DISPLACEMENT
    ) -> State:
        """All particles ``dt`` seconds later. The plane turns with the vehicle as its centre moves along an arc."""
        turning, velocity = _draw_noise(self.noise_draws(dt), len(state), rng)
        turning, velocity = state.turning + turning, state.velocity + velocity
        dR = Rotation.from_euler("xyz", turning * dt).as_matrix()
        centre = plane_centres(self.rig, state)
        along, across = chord_of_turn(turning[:, 1] * dt)
        shift = centre + dt * turned(velocity, along, across) - _combine_columns(dR, centre)
        velocity = turned(velocity, np.cos(turning[:, 1] * dt), np.sin(turning[:, 1] * dt))
        after = apply_rigid_motion(state, self.rig, shift, dR, displacement)
        return replace(after, turning=turning, velocity=velocity, speed=np.linalg.norm(velocity, axis=1))


def chord_of_turn(yaw: Array) -> tuple[Array, Array]:
    """The means of cos and sin of an angle that grows from 0 to ``yaw`` (N,) rad."""
    half = 0.5 * yaw
    chord = np.sinc(half / np.pi)
    return chord * np.cos(half), chord * np.sin(half)


def turned(vectors: Array, cos: Array, sin: Array) -> Array:
    """``vectors`` (N, 3) turned about the camera's y axis by angles of this ``cos`` and ``sin`` (N,)."""
    x, y, z = vectors.T
    return np.stack([cos * x + sin * z, y, cos * z - sin * x], axis=1)


class PathMotion:
    """Along a path: one speed, and the rotation of the path's frame ([Zhu] (22)–(27)).

    The path is a prior: every particle follows its own version of it, turned by its ``heading``, a random walk from
    frame to frame, as a vehicle may leave its lane. On a curve the noise (27) across the path is added.
    """

    corrected_fields = ("speed", "heading")

    def __init__(self, rig: StereoRig, path: Path, configuration: SpeedConfiguration) -> None:
        self.rig = rig
        self.path = path
        self.name = path.shape
        self.speed_noise = configuration.speed_noise
        self.distance_noise = configuration.distance_noise
        self.drift = np.array([configuration.lateral_noise, configuration.vertical_noise])
        lane_keeping = np.array([configuration.driver.heading, configuration.driver.pitch])
        self.turning = (
            np.zeros(2) if configuration.exact_path else configuration.heading_noise * lane_keeping / lane_keeping[0]
        )

    def propagate(
        self, state: State, dt: float, rng: np.random.Generator, displacement: Array = NO_DISPLACEMENT
    ) -> State:
        """All particles ``dt`` seconds later."""
        noise = _draw_noise(self.noise_draws(dt), len(state), rng)
        speed = state.speed + noise[0]
        heading = state.heading + np.stack(noise[2:4], axis=1)
        s = self._advanced(state.s, speed * dt + noise[1])
        F = self.path.frames(state.s)
        start = self.path.at(state.s)
        step = self.path.at(s) - start
        length = np.einsum("ni,ni->n", step, F[:, :, 0])
        shift = step + length[:, None] * _combine_columns(F[:, :, 1:], heading)
        if self.name == "line":
            after = apply_rigid_motion(state, self.rig, shift, None, displacement)  # (22)–(24)
            return replace(after, speed=speed, s=s, heading=heading)
        F_after = self.path.frames(s)
        dR = F_after @ np.swapaxes(F, -1, -2)  # (26)
        drift = _combine_columns(F_after[:, :, 1:], noise[4] * self.drift * np.sqrt(dt / ZHU_FRAME_INTERVAL_S))
        shift += start - _combine_columns(dR, start) + drift  # (27)
        after = apply_rigid_motion(state, self.rig, shift, dR, displacement)
        return replace(after, speed=speed, s=s, heading=heading)

    def noise_draws(self, dt: float) -> NoiseDraws:
        """The noise of ``dt`` seconds: of the speed, in m/s, of the way, in m, of the yaw and the pitch, in rad, and on
        a curve of the drift's place."""
        scale = float(np.sqrt(dt / ZHU_FRAME_INTERVAL_S))
        sigmas = self.speed_noise, self.distance_noise, *self.turning.tolist()
        along = [(sigma * scale, 1) for sigma in sigmas]
        return along if self.name == "line" else [*along, (1.0, 2)]

    def velocity(self, state: State) -> Array:
        """The velocity (3,) m/s of a state of one particle."""
        F = self.path.frames(state.s)
        return np.asarray((state.speed[:, None] * (F[:, :, 0] + _combine_columns(F[:, :, 1:], state.heading)))[0])

    def yaw_rate(self, state: State, dt: float) -> float:
        """Turning (rad/s) about the camera's y axis, to the right, over the last ``dt``, of one particle."""
        s = np.array([state.s[0] - state.speed[0] * dt, state.s[0]])
        before, current = self.path.frames(s)[:, :, 0]
        return float(np.cross(before, current)[1] / dt)

    def after_shift(self, state: State, shift: Array) -> State:
        """``state`` whose planes were moved by ``shift`` (N, 3): their arc lengths follow."""
        T = self.path.frames(state.s)[:, :, 0]
        return replace(state, s=state.s + (shift * T).sum(-1))

    def _advanced(self, s: Array, length: Array) -> Array:
        """τ' with ‖C(τ') − C(τ)‖ = |length| on the side of its sign: (25), by two secant steps from the arc."""
        after = s + length
        if self.name == "line":
            return after
        start = self.path.at(s)
        for _ in range(2):
            chord = np.linalg.norm(self.path.at(after) - start, axis=-1)
            after = after + np.sign(length) * (np.abs(length) - chord)
        return after
