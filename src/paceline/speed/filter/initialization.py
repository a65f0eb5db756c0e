"""The first two frames of a track: the plane and its reference, then direction and speed ("track initiation")."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.imaging.outline_motion import SCALE_CANDIDATES, match_template, place_between_views
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import motion_models
from paceline.speed.filter.estimate import MIN_REFERENCE_SIMILARITY
from paceline.speed.filter.likelihood import ObservationModel, pack_views
from paceline.speed.filter.motion_models import CoordinatedTurn, FreeMotion, PathMotion, State, turned
from paceline.speed.filter.particle_set import Device, Particles, ParticleSet
from paceline.speed.filter.registration import (
    PlaneObservation,
    ReferenceTexture,
    register_plane,
    update_by_registration,
)
from paceline.speed.filter.resampling import Weights
from paceline.speed.geometry.fitted_arc import MIN_TURNING_RADIUS_M
from paceline.speed.geometry.initial_plane import InitialPlane, likeliest_face, normal_of_face
from paceline.speed.geometry.paths import Path, path_ahead

SpeedPrior = tuple[float, float]  # a speed and its standard deviation, m/s

TEMPLATE_MATCH_SIGMA_PX = 0.7  # standard deviation of a matched template's position and size
MIN_HEADING_TRAVEL_M = 2.0  # distance travelled from which on its direction is used
CURVATURE_LENGTH_M = 5.0  # m of a path over which its curvature is taken
MIN_START_ESS_SHARE = 0.2  # least effective sample size after the second frame, as a share of the particles
MAX_START_ITERATIONS = 4  # iterations of the first registration
START_STEP_TOLERANCE = 0.02  # relative change of the registered distance at which the iteration has converged
# m/s², of the vehicle on its way: side friction 0.2, for which roads are designed at 30 mph (AASHTO, A Policy on
# Geometric Design of Highways and Streets); up to twice as much is driven
LATERAL_ACCELERATION_STD_MPS2 = 2.0
START_SPEED_STD_FACTOR = 2.0  # std of the drawn speeds over that of the speed from two registered positions


@dataclass(frozen=True, eq=False)
class Initialization:
    """The initialization of one vehicle's track, with what `tracker.Tracker` has for it.

    ``motions`` are the candidates, one for each direction along the path where particles keep to it; ``paths`` are the
    drawn path in both directions, empty where there is none; ``texture`` is None without registration.
    """

    rig: StereoRig
    vehicle: VehicleDocument
    configuration: SpeedConfiguration
    motions: Sequence[PathMotion | FreeMotion]
    paths: Sequence[Path]
    model: ObservationModel
    texture: ReferenceTexture | None
    plane: InitialPlane
    device: Device
    rng: np.random.Generator

    def initialize_plane(self, frame: StereoFrame) -> tuple[InitialPlane, ParticleSet]:
        """The first frame: the plane at the depth at which the views agree, and particles there, without a speed."""
        c, plane = self.configuration, self.plane
        if self.texture is not None:
            with suppress(np.linalg.LinAlgError):  # without texture the plane stays where it was outlined
                plane = self.texture.initialize((frame.left, frame.right), self.vehicle.left, plane)
        factor = c.start.particle_factor if self.vehicle.speed is None else 1
        state = initial_state(plane, self.vehicle, c.particles * factor, self.rng)
        return plane, self.particles(self.motions[0], state, Weights.equal(len(state)))

    def particles(self, motion: PathMotion | FreeMotion, state: State, weights: Weights) -> ParticleSet:
        """Particles of ``state`` and ``weights`` that move by ``motion``, as the vehicle does at its first frame."""
        return ParticleSet(self.rig, motion, state, weights, self.vehicle.displacement)

    def initialize_speed(self, frame: StereoFrame, first: StereoFrame, start: State) -> Particles:
        """The second frame: particles with the direction and the speed of the vehicle.

        From ``start``, their state at the ``first`` frame, particles are drawn for each candidate motion; the likeliest
        candidate is kept. Registration starts from its weighted mean; the particles are drawn anew about the speed that
        it finds, because the weights would leave too few of them to represent its uncertainty.
        """
        dt, images = frame.time - first.time, (first.left, frame.left, frame.right)
        prior = operator_speed(self.vehicle, self.configuration)
        outcomes = []
        for motion in self.motions:
            drawn = self.draw_start(start, motion, images, dt, prior)
            state = motion.propagate(drawn, dt, self.rng, self.vehicle.displacement)
            views = pack_views(frame, [(state.left, state.right)])
            lw = self.device.log_likelihood(self.model, views, state)
            outcomes.append((float(np.logaddexp.reduce(lw)), state, lw, motion))
        _, state, lw, motion = max(outcomes, key=lambda outcome: outcome[0])
        if self.texture is None:
            likeliest = self.particles(motion, state, Weights(lw))
        else:
            likeliest = self.particles(motion, state, tempered_weights(lw))
            particle_set, observation = self.refine_start(self.texture, frame, likeliest, start, images, dt)
            if observation is not None and observation.inside_gate:
                update_by_registration(self.texture, particle_set, observation, self.rng)
                return self.device.particle_set(particle_set)
        likeliest.resample(self.configuration, self.rng)
        return self.device.particle_set(likeliest)

    def refine_start(
        self,
        texture: ReferenceTexture,
        frame: StereoFrame,
        likeliest: ParticleSet,
        start: State,
        images: tuple[Image, Image, Image],
        dt: float,
    ) -> tuple[ParticleSet, PlaneObservation | None]:
        """Particles drawn anew about the speed that registration finds from the ``likeliest`` ones, and where it finds
        the plane from these.

        This is repeated until the registered position converges: while the particles have very different speeds, their
        mean region may be too far from the vehicle for one registration.
        """
        motion, particle_set = likeliest.motion, likeliest
        start = start[np.arange(self.configuration.particles)]
        observation = register_plane(texture, particle_set, frame)
        for _ in range(MAX_START_ITERATIONS):
            if observation is None or observation.registration.similarity < MIN_REFERENCE_SIMILARITY:
                break
            before, covariance = observation.place, observation.registration.covariance
            prior = speed_prior(before, covariance, self.plane, motion, dt, self.vehicle, self.configuration)
            if isinstance(motion, CoordinatedTurn):
                drawn = self.turn_start(draw_registered_start(start, self.plane, observation, dt, self.rng), dt)
            else:
                drawn = self.draw_start(start, motion, images, dt, prior)
            state = motion.propagate(drawn, dt, self.rng, self.vehicle.displacement)
            particle_set = self.particles(motion, state, Weights.equal(len(state)))
            observation = register_plane(texture, particle_set, frame)
            if observation is None:
                break
            change = float(np.linalg.norm(observation.place - before))
            if change < START_STEP_TOLERANCE * prior[0] * dt:
                break
        return particle_set, observation

    def draw_start(
        self,
        start: State,
        motion: PathMotion | FreeMotion,
        images: tuple[Image, Image, Image],
        dt: float,
        prior: SpeedPrior | None,
    ) -> State:
        """``start`` with drawn motions; ``images`` are the left one of the first frame and both of the
        second."""
        if isinstance(motion, PathMotion):
            return draw_path_start(start, self.plane, motion, self.rig, prior, self.configuration, self.rng)
        state = draw_free_start(start, self.plane, self.rig, self.vehicle, images, dt, self.configuration, self.rng)
        return self.turn_start(state, dt) if isinstance(motion, CoordinatedTurn) else state

    def turn_start(self, state: State, dt: float) -> State:
        """``state``, whose ``velocity`` is the mean one of the next ``dt`` s, with drawn yaw rates, about those of the
        drawn path.

        Where the vehicle travels far enough within ``dt``, its plane is aligned with the direction of travel.
        """
        velocity = state.velocity.mean(0)
        curvature = curvature_ahead(self.paths, self.plane.centre, velocity)
        state = draw_yaw_rate(state, dt, curvature, self.rng)
        if not is_heading_known(velocity * dt):
            return state
        direction_std = float(np.std(motion_models.headings(state.velocity, velocity)))
        face = likeliest_face(self.rig, self.vehicle, self.plane, velocity, direction_std)
        if face is None:
            return state
        return motion_models.with_normal(self.rig, state, normal_of_face(self.plane.normal, velocity, face))


def is_heading_known(travel: Array) -> bool:
    """Whether a vehicle's ``travel`` (3,) m is long enough to tell its direction."""
    return bool(np.linalg.norm(travel) > MIN_HEADING_TRAVEL_M)


def initial_state(plane: InitialPlane, vehicle: VehicleDocument, n: int, rng: np.random.Generator) -> State:
    """``n`` particles at the operator's quadrilaterals, at distances drawn about the plane's; the first at its own."""
    scale = 1.0 / np.maximum(1.0 + rng.normal(0.0, plane.inverse_depth_std, n), 0.2)
    scale[0] = 1.0
    return State(
        left=np.repeat(vehicle.left[None], n, axis=0),
        right=np.repeat(vehicle.right[None], n, axis=0),
        normal=np.repeat(plane.normal[None], n, axis=0),
        distance=plane.distance * scale,
        speed=np.zeros(n),
        s=np.zeros(n),
        heading=np.zeros((n, 2)),
        velocity=np.zeros((n, 3)),
        turning=np.zeros((n, 3)),
    )


def draw_path_start(
    state: State,
    plane: InitialPlane,
    motion: PathMotion,
    rig: StereoRig,
    prior: SpeedPrior | None,
    configuration: SpeedConfiguration,
    rng: np.random.Generator,
) -> State:
    """``state`` with motions along ``motion``'s path: speeds drawn from the ``prior``, or spread over the speed range.

    Each particle draws its own heading from the covariance of the path's reconstruction and from how closely drivers
    keep to a path.
    """
    N, driver = len(state), configuration.driver
    speed = np.linspace(*configuration.start.speed_range, N) if prior is None else np.abs(rng.normal(*prior, N))
    start = motion.path.nearest(plane.centre)
    heading = np.zeros((N, 2))
    if not configuration.exact_path:
        yaw, pitch = motion.path.heading_modes(np.array([start]))
        heading = rng.normal(0.0, 1.0, (N, len(yaw))) @ np.concatenate([yaw, pitch], axis=1)
        heading += rng.normal(0.0, 1.0, (N, 2)) * [driver.heading, driver.pitch]
    forward = motion.path.frames(np.array(start))[:, 0]
    s = start + (motion_models.plane_centres(rig, state) - plane.centre) @ forward
    return replace(state, speed=speed, s=s, heading=heading)


def operator_speed(vehicle: VehicleDocument, configuration: SpeedConfiguration) -> SpeedPrior | None:
    """The speed that the operator stated, m/s, with its standard deviation; None without one."""
    return None if vehicle.speed is None else (vehicle.speed, configuration.speed_guess_spread * vehicle.speed)


def speed_prior(
    place: Array,
    covariance: Array,
    plane: InitialPlane,
    motion: PathMotion | FreeMotion,
    dt: float,
    vehicle: VehicleDocument,
    configuration: SpeedConfiguration,
) -> SpeedPrior:
    """The speed, m/s, that takes ``plane`` within ``dt`` s to the registered ``place`` (3,) of ``covariance`` (3, 3).

    Its standard deviation is greater than both positions imply: the registration is used once more for the update of
    the particles. It is combined with the operator's speed where there is one.
    """
    travel = place - plane.centre
    forward = travel / max(float(np.linalg.norm(travel)), 1e-9)
    if isinstance(motion, PathMotion):
        forward = motion.path.direction_near(plane.centre)
    depth_std = plane.inverse_depth_std * float(np.linalg.norm(plane.centre))
    measured_std = float(np.hypot(np.sqrt(forward @ covariance @ forward), depth_std)) / dt
    speed = float(np.clip(travel @ forward / dt, 0.0, configuration.start.speed_range[1]))
    operator = operator_speed(vehicle, configuration)
    if operator is None:
        return speed, max(configuration.speed_guess_spread * speed, START_SPEED_STD_FACTOR * measured_std)
    stated, std = operator
    return stated + (speed - stated) * std**2 / (std**2 + measured_std**2), std


def draw_free_start(
    state: State,
    plane: InitialPlane,
    rig: StereoRig,
    vehicle: VehicleDocument,
    images: tuple[Image, Image, Image],
    dt: float,
    configuration: SpeedConfiguration,
    rng: np.random.Generator,
) -> State:
    """``state`` with velocities drawn about the one by which the left view's template moved, to the depth of its match
    in the right view, or where it is outside this to that by which it grew; ``images`` are the left one of the first
    frame and both of the second."""
    fastest = 1.3 * vehicle.speed if vehicle.speed else configuration.start.speed_range[1]
    focal = rig.left.K[0, 0]
    before, middle = plane.centre, vehicle.left.mean(0)
    shift, growth = match_template(images[0], images[1], vehicle.left, fastest * dt * focal / before[2])
    moved = middle + shift + growth * (vehicle.left - middle)
    displaced = rig.displaced(vehicle.displacement)
    after = place_between_views(displaced, moved, images[1:], before[2] / SCALE_CANDIDATES[[0, -1]])
    if after is None:
        after = rig.left.rays(middle + shift) * before[2] / growth
        depth_std = TEMPLATE_MATCH_SIGMA_PX * before[2] / float(np.sqrt(np.prod(np.ptp(vehicle.left, axis=0))))
    else:
        depth_std = TEMPLATE_MATCH_SIGMA_PX * after[2] ** 2 / (focal * displaced.baseline)
    N = len(state)
    across = rng.normal(0.0, TEMPLATE_MATCH_SIGMA_PX * before[2] / focal / dt, (N, 3))
    along = rng.normal(0.0, depth_std / dt, (N, 1)) * before / np.linalg.norm(before)
    velocity = (after - before) / dt + across + along
    return replace(state, velocity=velocity, speed=np.linalg.norm(velocity, axis=1))


def draw_registered_start(
    state: State, plane: InitialPlane, observation: PlaneObservation, dt: float, rng: np.random.Generator
) -> State:
    """``state`` with velocities drawn about the one from ``plane`` to its registered place, ``dt`` s later."""
    depth_std = plane.inverse_depth_std * plane.centre
    covariance = observation.registration.covariance + np.outer(depth_std, depth_std)
    root = START_SPEED_STD_FACTOR / dt * motion_models.cholesky_factor(covariance)
    velocity = (observation.place - plane.centre) / dt + rng.normal(0.0, 1.0, (len(state), 3)) @ root.T
    return replace(state, velocity=velocity, speed=np.linalg.norm(velocity, axis=1))


def curvature_ahead(paths: Sequence[Path], place: Array, velocity: Array) -> float:
    """Curvature (1/m), to the right, at a ``place`` (3,) of that of the ``paths`` which goes in the direction of the
    ``velocity`` (3,), over `CURVATURE_LENGTH_M`; 0 where there is none."""
    if not paths:
        return 0.0
    path = path_ahead(paths, place, velocity)
    directions = path.frames(path.nearest(place) + np.array([0.0, CURVATURE_LENGTH_M]))[:, :, 0]
    return float(motion_models.headings(directions[1:], directions[0])[0]) / CURVATURE_LENGTH_M


def draw_yaw_rate(state: State, dt: float, curvature: float, rng: np.random.Generator) -> State:
    """``state``, whose ``velocity`` is the mean one of the next ``dt`` s, on turns with yaw rates drawn from how
    vehicles corner, about that of a road of this ``curvature`` (1/m), to the right: each particle begins in the
    direction from which its turn leads to the same place.
    """
    std = np.minimum(LATERAL_ACCELERATION_STD_MPS2 / np.maximum(state.speed, 1e-9), state.speed / MIN_TURNING_RADIUS_M)
    yaw_rate = curvature * state.speed + std * rng.normal(0.0, 1.0, len(state))
    half = 0.5 * yaw_rate * dt
    chord = np.sinc(half / np.pi)
    velocity = turned(state.velocity, np.cos(half) / chord, -np.sin(half) / chord)
    turning = state.turning + yaw_rate[:, None] * [0.0, 1.0, 0.0]
    return replace(state, velocity=velocity, speed=np.linalg.norm(velocity, axis=1), turning=turning)


def tempered_weights(lw: Array) -> Weights:
    """Weights by a power ½ᵏ of the likelihood at which the effective sample size suffices for a covariance."""
    weights = Weights(lw)
    while MIN_START_ESS_SHARE * len(lw) > weights.ESS:
        lw = 0.5 * lw
        weights = Weights(lw)
    return weights
