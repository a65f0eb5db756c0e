"""The first particles: where the outline puts them, and, a frame later, which way and how fast they go."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.cameras import StereoRig
from paceline.documents.loading import VehicleDocument
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.filter import motion_models
from paceline.speed.filter.motion_models import FreeMotion, PathMotion, State
from paceline.speed.filter.resampling import Weights
from paceline.speed.geometry.initial_plane import InitialPlane
from paceline.speed.geometry.paths import LANE_KEEPING_STD

SpeedPrior = tuple[float, float]  # a speed and its standard deviation, m/s

SCALE_CANDIDATES = np.geomspace(0.72, 1.4, 23)  # of the template from the first frame to the second
MATCH_SIGMA_PX = 0.7  # of a matched template's position and size
MIN_START_ESS_SHARE = 0.2  # effective sample size, as a share of the particles, that the second frame leaves at least
MAX_START_ITERATIONS = 4  # of the first registration
START_STEP_TOLERANCE = 0.02  # change of the registered position at which it has converged, as a share of the distance
START_SPEED_STD_FACTOR = 2.0  # std of the drawn speeds over that of the speed from two registered positions


def initial_state(plane: InitialPlane, vehicle: VehicleDocument, n: int, rng: np.random.Generator) -> State:
    """``n`` particles at the operator's quadrilaterals, at distances as uncertain as the plane's; the first is sure."""
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
    model: PathMotion,
    rig: StereoRig,
    guess: SpeedPrior | None,
    configuration: SpeedConfiguration,
    rng: np.random.Generator,
) -> State:
    """``state`` set off along ``model``'s path: at speeds about a ``guess``, or over all that vehicles drive.

    Each particle draws its own heading: from the covariance of the path's reconstruction, and from how drivers keep to
    a path.
    """
    N = len(state)
    speed = np.linspace(*configuration.start.speed_range, N) if guess is None else np.abs(rng.normal(*guess, N))
    start = model.path.nearest(plane.centre)
    heading = np.zeros((N, 2))
    if not configuration.exact_path:
        yaw, pitch = model.path.heading_modes(np.array([start]))
        heading = rng.normal(0.0, 1.0, (N, len(yaw))) @ np.concatenate([yaw, pitch], axis=1)
        heading += rng.normal(0.0, 1.0, (N, 2)) * LANE_KEEPING_STD
    forward = model.path.frames(np.array(start))[:, 0]
    s = start + (motion_models.plane_centres(rig, state) - plane.centre) @ forward
    return replace(state, speed=speed, s=s, heading=heading)


def operator_speed(vehicle: VehicleDocument, configuration: SpeedConfiguration) -> SpeedPrior | None:
    """The operator's guess of the speed, m/s, with its standard deviation."""
    return None if vehicle.speed is None else (vehicle.speed, configuration.speed_guess_spread * vehicle.speed)


def speed_prior(
    place: Array,
    covariance: Array,
    plane: InitialPlane,
    way: PathMotion | FreeMotion,
    dt: float,
    vehicle: VehicleDocument,
    configuration: SpeedConfiguration,
) -> SpeedPrior:
    """The speed, m/s, by which the ``plane`` is at the ``place`` (3,), of that ``covariance``, where it was seen after
    ``dt`` s, as uncertain as both places leave it or more: what the particles then make of the sight must not count it
    twice. A stated speed is worth as much as it is sure."""
    gone = place - plane.centre
    forward = gone / max(float(np.linalg.norm(gone)), 1e-9)
    if isinstance(way, PathMotion):
        forward = way.path.frames(np.array(way.path.nearest(plane.centre)))[:, 0]
    depth_std = plane.inverse_depth_std * float(np.linalg.norm(plane.centre))
    doubt = float(np.hypot(np.sqrt(forward @ covariance @ forward), depth_std)) / dt
    speed = float(np.clip(gone @ forward / dt, 0.0, configuration.start.speed_range[1]))
    operator = operator_speed(vehicle, configuration)
    if operator is None:
        return speed, max(configuration.speed_guess_spread * speed, START_SPEED_STD_FACTOR * doubt)
    said, std = operator
    return said + (speed - said) * std**2 / (std**2 + doubt**2), std


def draw_free_start(
    state: State,
    plane: InitialPlane,
    rig: StereoRig,
    vehicle: VehicleDocument,
    first: Image,
    now: Image,
    dt: float,
    configuration: SpeedConfiguration,
    rng: np.random.Generator,
) -> State:
    """``state`` set off without a path: at velocities about where the left view's picture went and how it grew."""
    fastest = 1.3 * vehicle.speed if vehicle.speed else configuration.start.speed_range[1]
    focal = rig.left.K[0, 0]
    before = plane.centre
    shift, growth = match_template(first, now, vehicle.left, fastest * dt * focal / before[2])
    after = rig.left.rays(vehicle.left.mean(0) + shift) * before[2] / growth
    size = float(np.sqrt(np.prod(np.ptp(vehicle.left, axis=0))))
    N = len(state)
    across = rng.normal(0.0, MATCH_SIGMA_PX * before[2] / focal / dt, (N, 3))
    along = rng.normal(0.0, MATCH_SIGMA_PX * before[2] / size / dt, (N, 1)) * before / np.linalg.norm(before)
    velocity = (after - before) / dt + across + along
    return replace(state, velocity=velocity, speed=np.linalg.norm(velocity, axis=1))


def match_template(first: Image, now: Image, quad: Array, reach: float) -> tuple[Array, float]:
    """Where the picture inside ``quad`` (4, 2) went from ``first`` to ``now``: its shift (2,) in pixels, at most
    about ``image_bounds``, and the factor by which it grew."""
    x0, y0 = np.maximum(np.floor(quad.min(0)).astype(int), 0)
    x1, y1 = np.ceil(quad.max(0)).astype(int) + 1
    template = first[y0:y1, x0:x1]
    across = int(reach) + (x1 - x0) // 4
    down = int(min(reach, 0.25 * reach + (y1 - y0)))
    left, top = max(x0 - across, 0), max(y0 - down, 0)
    window = now[top : y1 + down, left : x1 + across]
    best = (-1.0, np.zeros(2), 1.0)
    for growth in SCALE_CANDIDATES:
        scaled = cv2.resize(template, None, fx=growth, fy=growth, interpolation=cv2.INTER_LINEAR)
        if scaled.shape[0] > window.shape[0] or scaled.shape[1] > window.shape[1]:
            continue
        scores = cv2.matchTemplate(window, scaled, cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(np.argmax(scores)), scores.shape)
        if scores[y, x] > best[0]:
            middle = np.array([left + x + scaled.shape[1] / 2, top + y + scaled.shape[0] / 2])
            best = (float(scores[y, x]), middle - np.array([x0 + x1, y0 + y1]) / 2, float(growth))
    return best[1], best[2]


def tempered_weights(lw: Array) -> Weights:
    """Weights by a power of the likelihood that leaves particles enough alive for a covariance that means something."""
    weights = Weights(lw)
    while MIN_START_ESS_SHARE * len(lw) > weights.ESS:
        lw = 0.5 * lw
        weights = Weights(lw)
    return weights
