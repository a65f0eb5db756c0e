"""Stereo tracking of one vehicle with a particle filter: [Zhu] section III."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.cameras import StereoRig
from paceline.documents import VehicleDocument
from paceline.recordings import StereoFrame
from paceline.speed import likelihood, motion, registration
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.likelihood import Grid, Observation
from paceline.speed.motion import FreeMotion, PathMotion, State
from paceline.speed.particles import Weights, resample
from paceline.speed.paths import Path
from paceline.speed.planes import FirstPlane, first_plane, squared

Array = NDArray[np.float64]
Image = NDArray[np.float32]

SPEED_RANGE = (0.5, 75.0)  # m/s, searched where no first guess is given
SEARCH = 8  # times as many particles while the speed is unknown
ROUGHENING = 0.1  # share of a static parameter's spread that resampling gives back to it
SEEN = 0.55  # likeness to the reference below which a frame teaches nothing
LOST = 0.25  # likeness below which the vehicle is not in view
GROWTHS = np.geomspace(0.72, 1.4, 23)  # of a picture from one frame to the next
MATCH_SIGMA = 0.7  # px, of a matched picture's place and size
DIRECTED = 2.0  # m, a travel that has a direction
PATIENCE = 4  # frames that may pass so before the vehicle is given up


@dataclass(frozen=True, eq=False)
class Estimate:
    """The filter's estimate at one frame (SI units, ideal pixels)."""

    frame: int
    time: float
    speed: float
    speed_std: float
    position: Array  # (3,)
    yaw_rate: float  # rad/s, positive to the right; NaN at the first frame
    left: Array  # (4, 2)
    right: Array  # (4, 2)
    ess: float
    status: str  # tracking | lost | ended
    likeness: float  # correlation with the reference, −1 … 1
    particles_left: Array  # (N, 2)
    particles_right: Array  # (N, 2)


class Tracker:
    """Follows one vehicle through a recording, a frame at a time::

        tracker = Tracker(rig, vehicle, path)
        for frame in recording.frames(vehicle.frame):
            estimate = tracker.update(frame)

    ``path`` (None for free motion) is the drawn one, not yet moved to the lane's centre: which side is right is known
    only when the vehicle has moved. The first update takes the operator's quadrilaterals as they are.
    """

    def __init__(
        self,
        rig: StereoRig,
        vehicle: VehicleDocument,
        path: Path | None = None,
        lateral_offset: float = 0.0,
        configuration: SpeedConfiguration | None = None,
    ) -> None:
        self.rig = rig
        self.vehicle = vehicle
        self.configuration = configuration or SpeedConfiguration()
        self.rng = np.random.default_rng([self.configuration.seed, *vehicle.id.encode()])
        self.grid = Grid.for_region(self.configuration.parts, vehicle.left)
        self.path = path
        self.plane = first_plane(rig, vehicle, path, self.configuration.click_sigma)
        both_ways = [] if path is None else [path.shifted(lateral_offset), path.reversed().shifted(lateral_offset)]
        self._candidates = [PathMotion(rig, p, self.configuration) for p in both_ways]
        self.motion: PathMotion | FreeMotion | None = None
        self.status = "tracking"
        self._time: float | None = None
        self._unseen = 0

    def update(self, frame: StereoFrame) -> Estimate:
        """The estimate at ``frame``; raises RuntimeError once the track has ended."""
        if self.status != "tracking":
            raise RuntimeError(f"vehicle {self.vehicle.id} is {self.status}")
        left, right = likelihood.pack(frame.left), likelihood.pack(frame.right)
        if self._time is None:
            return self._begin(frame, left, right)
        dt = frame.time - self._time
        if self.motion is None:
            self._acquire(frame, left, right, dt)
        else:
            self.state = self.motion.propagate(self.state, dt, self.rng)
        if self.configuration.guided:
            self._guide(frame)
        self._weigh(self._observe(left, right, self.state))
        estimate = self._estimate(frame, left, right, dt)
        self._resample()
        self._time = frame.time
        self._left_image = frame.left
        return estimate

    def _begin(self, frame: StereoFrame, left: likelihood.Packed, right: likelihood.Packed) -> Estimate:
        self.state = initial_state(self.plane, self.vehicle, self._count(), self.rng)
        self.weights = Weights.equal(len(self.state))
        self.reference = self._observe(left, right, self.state[:1]).features[0]
        if self.configuration.guided:
            self._settle(frame)
        self._time, self._first = frame.time, frame
        centre = self.plane.centre
        return Estimate(
            frame.index,
            frame.time,
            self.vehicle.speed or float("nan"),
            float("nan"),
            centre,
            float("nan"),
            self.vehicle.left,
            self.vehicle.right,
            float(self.configuration.particles),
            "tracking",
            1.0,
            *(c.repeat(1, axis=0) for c in self._clouds()),
        )

    def _settle(self, frame: StereoFrame) -> None:
        """The first frame: the texture as the left view shows it, and the depth at which the right view agrees."""
        images = frame.left, frame.right
        self.plane_grid = registration.PlaneGrid(self.grid)
        points = self._surface(self.vehicle.left, self.plane.normal, self.plane.distance)
        self.texture = registration.sample(self.rig, images, points, self.plane_grid)[0]
        ray = (self.plane.centre / np.linalg.norm(self.plane.centre))[:, None]
        found = registration.register(self.rig, images, points, self.texture, self.plane_grid, ray, (1,))
        std = float(np.sqrt(np.trace(found.covariance)))
        length = float(np.linalg.norm(self.plane.centre))
        self.plane = settled(self.plane, 1 + float(found.shift @ ray[:, 0]) / length, std / length)
        self.state = initial_state(self.plane, self.vehicle, len(self.state), self.rng)

    def _surface(self, left: Array, normal: Array, distance: float) -> Array:
        """Sample points (parts, samples, 3) on the plane behind the left region (4, 2)."""
        H = likelihood.unit_square_to(left[None])[0]
        rays = np.moveaxis(np.tensordot(self.rig.left.K_inv @ H, self.plane_grid.places, 1), 0, -1)
        return np.asarray(rays * (distance / (rays @ normal))[..., None])

    def _guide(self, frame: StereoFrame) -> None:
        """Move the particles by what registration saw: the weighted ensemble Kalman filter's proposal.

        The paper's dynamics model alone proposes blindly. Here every particle takes the Kalman step that the whole
        cloud's covariance gives between where its plane is and everything else in its state.
        """
        w, state = self.weights, self.state
        mean = State(*(w.mean(getattr(state, name))[None] for name in State.__dataclass_fields__))
        points = self._surface(mean.left[0], mean.normal[0], float(mean.distance[0]))
        found = registration.register(
            self.rig, (frame.left, frame.right), points, self.texture, self.plane_grid, np.eye(3)
        )
        if found.likeness < SEEN:
            return
        memory = self.configuration.reference_memory
        self.texture = memory * self.texture + (1 - memory) * found.texture.mean(0)
        places = motion.centres(self.rig, state)
        target = w.mean(places) + found.shift
        noise = self.rng.multivariate_normal(np.zeros(3), found.covariance, len(state))
        self.state = motion.corrected(self.rig, state, w.W, places, target + noise, found.covariance, self.motion)

    def _count(self) -> int:
        guessed = self.vehicle.speed is not None
        return self.configuration.particles * (1 if guessed else SEARCH)

    def _observe(self, left: likelihood.Packed, right: likelihood.Packed, state: State) -> Observation:
        cross = motion.cross_homographies(self.rig, state)
        return likelihood.observe(left, right, state.left, state.right, cross, self.grid)

    def _log_likelihood(self, seen: Observation) -> Array:
        c = self.configuration
        return likelihood.log_likelihood(seen, self.reference, c.lambda_single, c.lambda_cross)

    def _weigh(self, seen: Observation) -> None:
        self.weights = self.weights.updated(self._log_likelihood(seen))

    def _acquire(self, frame: StereoFrame, left: likelihood.Packed, right: likelihood.Packed, dt: float) -> None:
        """The second frame: which way the vehicle drives, and how fast."""
        starts = [self._along(m) for m in self._candidates] or [(self._matched(frame, dt), FreeMotion(self.rig, self.configuration))]
        outcomes = []
        for state, model in starts:
            after = model.propagate(state, dt, self.rng)
            lw = self._log_likelihood(self._observe(left, right, after))
            outcomes.append((np.logaddexp.reduce(lw), after, lw, model))
        _, self.state, lw, self.motion = max(outcomes, key=lambda o: o[0])
        if isinstance(self.motion, PathMotion):
            self.path = self.motion.path
        if self.configuration.guided:
            self.weights = Weights(lw)
            self._resample()

    def _along(self, model: PathMotion) -> tuple[State, PathMotion]:
        """First particles for one way along the path: speeds about the guess, or over all that drive."""
        N, guess = len(self.state), self.vehicle.speed
        if guess is None:
            speed = np.linspace(*SPEED_RANGE, N)
        else:
            speed = np.abs(self.rng.normal(guess, self.configuration.speed_guess_spread * guess, N))
        start = model.path.nearest(self.plane.centre)
        heading = np.zeros((N, 2))
        if not self.configuration.exact_path:
            yaw, pitch = model.path.heading_modes(np.array([start]))
            heading = self.rng.normal(0.0, 1.0, (N, len(yaw))) @ np.concatenate([yaw, pitch], axis=1)
        reach = model.path.frames(np.array(start))[:, 0]
        s = start + (motion.centres(self.rig, self.state) - self.plane.centre) @ reach
        return replace(self.state, speed=speed, s=s, heading=heading), model

    def _matched(self, frame: StereoFrame, dt: float) -> State:
        """First particles without a path: velocities about where the left view's picture went and how it grew."""
        quad = self.vehicle.left
        shift, growth = match(self._first.left, frame.left, quad, self._reach(dt))
        before = self.plane.centre
        after = self.rig.left.rays(quad.mean(0) + shift) * before[2] / growth
        N = len(self.state)
        velocity = (after - before) / dt
        size = float(np.sqrt(np.prod(np.ptp(quad, axis=0))))
        ray = before / np.linalg.norm(before)
        pixel = before[2] / self.rig.left.K[0, 0] / dt  # m/s across that one pixel means, and along the ray:
        depth = MATCH_SIGMA * before[2] / size / dt
        velocity = velocity + self.rng.normal(0.0, MATCH_SIGMA * pixel, (N, 3)) + self.rng.normal(0.0, depth, (N, 1)) * ray
        return replace(self.state, velocity=velocity, speed=np.linalg.norm(velocity, axis=1))

    def _square(self, position: Array) -> None:
        """Set the plane square to the travel so far, once that is long enough to have a direction."""
        travel = position - self.plane.centre
        if self.vehicle.plane == "free" and np.linalg.norm(travel) > DIRECTED:
            centres = motion.centres(self.rig, self.state)
            normal = squared(self.plane, travel).normal
            self.state = replace(
                self.state, normal=np.tile(normal, (len(self.state), 1)), distance=centres @ normal
            )

    def _reach(self, dt: float) -> float:
        """How many pixels the fastest vehicle can move in ``dt``."""
        fastest = 1.3 * self.vehicle.speed if self.vehicle.speed else SPEED_RANGE[1]
        return float(fastest * dt * self.rig.left.K[0, 0] / self.plane.centre[2])

    def _estimate(self, frame: StereoFrame, left: likelihood.Packed, right: likelihood.Packed, dt: float) -> Estimate:
        """The posterior mean (3), and the reference's update (14) from what it sees."""
        w, state = self.weights, self.state
        mean = State(*(w.mean(getattr(state, name))[None] for name in State.__dataclass_fields__))
        seen = self._observe(left, right, mean).features[0]
        likeness = float(np.mean([_likeness(a, b) for a, b in zip(seen, self.reference, strict=True)]))
        if likeness > SEEN:
            memory = self.configuration.reference_memory
            self.reference = memory * self.reference + (1 - memory) * seen
        self._unseen = self._unseen + 1 if likeness < LOST else 0
        centres = motion.centres(self.rig, state)
        position = w.mean(centres)
        if self._outside(mean, position):
            self.status = "ended"
        elif self._unseen >= PATIENCE:
            self.status = "lost"
        self._square(position)
        return Estimate(
            frame.index,
            frame.time,
            float(w.mean(state.speed)),
            float(w.std(state.speed)),
            position,
            self._yaw_rate(mean, dt),
            mean.left[0],
            mean.right[0],
            w.ESS,
            self.status,
            likeness,
            *self._clouds(),
        )

    def _outside(self, mean: State, position: Array) -> bool:
        """Whether the region has left an image, or has come too near to be one plane."""
        for quads, camera in ((mean.left, self.rig.left), (mean.right, self.rig.right)):
            low, high = quads[0].min(0), quads[0].max(0)
            if not np.isfinite(quads).all() or (low < 0).any() or (high > np.array(camera.image_size) - 1).any():
                return True
        return bool(position[2] < 1.0)

    def _yaw_rate(self, mean: State, dt: float) -> float:
        if isinstance(self.motion, PathMotion):
            s = np.array([mean.s[0] - mean.speed[0] * dt, mean.s[0]])
            T = self.motion.path.frames(s)[:, :, 0]
            return float(np.cross(T[0], T[1])[1] / dt)
        return float(mean.turning[0, 1])

    def _clouds(self) -> tuple[Array, Array]:
        """Where the particles see the plane's centre (N, 2), in both views."""
        keep = slice(0, self.configuration.particles)
        return (
            motion.diagonal_crossings(self.state.left[keep]),
            motion.diagonal_crossings(self.state.right[keep]),
        )

    def _resample(self) -> None:
        c = self.configuration
        if self.weights.ESS > c.resample_below * len(self.state) and len(self.state) == c.particles:
            return
        index = resample(c.resampling, self.weights.W, self.rng)
        if len(index) > c.particles:
            index = index[self.rng.permutation(len(index))[: c.particles]]
        spread = self.weights.std(self.state.heading)
        self.state = self.state[index]
        # a static parameter is drawn back to its mean as it is stirred, so that its spread stays what it was
        stay = np.sqrt(1 - ROUGHENING**2)
        mean = self.state.heading.mean(0)
        stirred = self.rng.normal(0.0, 1.0, self.state.heading.shape) * ROUGHENING * spread
        self.state = replace(self.state, heading=mean + stay * (self.state.heading - mean) + stirred)
        self.weights = Weights.equal(len(index))


def settled(plane: FirstPlane, scale: float, std: float) -> FirstPlane:
    """``plane`` moved along its ray to ``scale`` times its distance, now known to ``std`` of it."""
    return replace(plane, centre=plane.centre * scale, distance=plane.distance * scale, inverse_depth_std=std)


def initial_state(plane: FirstPlane, vehicle: VehicleDocument, n: int, rng: np.random.Generator) -> State:
    """``n`` particles at the operator's quadrilaterals, at distances as uncertain as their triangulation."""
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


def match(first: Image, now: Image, quad: Array, reach: float) -> tuple[Array, float]:
    """Where the picture inside ``quad`` (4, 2) went from ``first`` to ``now``: its shift (2,) in pixels, at most
    ``reach``, and the factor by which it grew."""
    x0, y0 = np.maximum(np.floor(quad.min(0)).astype(int), 0)
    x1, y1 = np.ceil(quad.max(0)).astype(int) + 1
    template = first[y0:y1, x0:x1]
    across = int(reach) + (x1 - x0) // 4
    down = int(min(reach, 0.25 * reach + (y1 - y0)))
    left, top = max(x0 - across, 0), max(y0 - down, 0)
    window = now[top : y1 + down, left : x1 + across]
    best = (-1.0, np.zeros(2), 1.0)
    for growth in GROWTHS:
        scaled = cv2.resize(template, None, fx=growth, fy=growth, interpolation=cv2.INTER_LINEAR)
        if scaled.shape[0] > window.shape[0] or scaled.shape[1] > window.shape[1]:
            continue
        scores = cv2.matchTemplate(window, scaled, cv2.TM_CCOEFF_NORMED)
        y, x = np.unravel_index(int(np.argmax(scores)), scores.shape)
        if scores[y, x] > best[0]:
            middle = np.array([left + x + scaled.shape[1] / 2, top + y + scaled.shape[0] / 2])
            best = (float(scores[y, x]), middle - np.array([x0 + x1, y0 + y1]) / 2, float(growth))
    return best[1], best[2]


def _likeness(a: likelihood.Floats, b: likelihood.Floats) -> float:
    """Correlation of two features (parts, 16)."""
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum() + 1e-12))
