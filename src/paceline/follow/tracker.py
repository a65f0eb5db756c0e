"""Following one vehicle by its edges: the stages of [NIST], and what makes them hold where the paper's failed."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from math import isfinite
from time import perf_counter

import numpy as np

from paceline.arrays import Array, Bytes
from paceline.cameras import Camera
from paceline.errors import UnusableInput
from paceline.follow import fitting
from paceline.follow.belief import Belief, Picture
from paceline.follow.coasting import Coasting
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.features import Projection
from paceline.follow.fitting import Fit
from paceline.follow.lock import Lock
from paceline.follow.origin import CAME, Origin
from paceline.follow.pace import DRIVES, Pace
from paceline.follow.probation import Probation
from paceline.follow.ranging import place_of
from paceline.follow.readout import displacement_deviation
from paceline.follow.recognition import Look, Recogniser
from paceline.follow.results import FollowEstimate
from paceline.path_following.pure_pursuit import Steering
from paceline.recordings.odometry import Pose
from paceline.targets.line_model import Target


class FollowTracker:
    """Follows one vehicle, a frame at a time::

        tracker = FollowTracker(camera, target, (597.28, 226.0, 1.0))
        for index, (time, image) in enumerate(frames):
            estimate = tracker.update(image, time, index)

    ``start`` is where the operator sees the target in the first frame: its centre in pixels of the image as recorded,
    x and y, and its scale, 1 for the size at the target's nominal range. Raises ValueError for a start that is not in
    the image or has no size.
    """

    def __init__(
        self,
        camera: Camera,
        target: Target,
        start: Sequence[float],
        configuration: FollowConfiguration | None = None,
    ) -> None:
        *middle, scale = start
        center = np.array(middle, float)
        width, height = camera.image_size
        if not (np.isfinite(scale) and scale > 0):
            raise ValueError(f"scale: expected a number above 0, found {scale:g}")
        if not (0 <= center[0] <= width - 1 and 0 <= center[1] <= height - 1):
            raise ValueError(f"center: expected a pixel of the image, {width}×{height}, found {center.tolist()}")
        self.camera, self.target = camera, target
        self.configuration = configuration or FollowConfiguration()
        self.projection = Projection(camera, target)
        self._begin(np.array([*camera.undistort_points(center), scale]))

    def _begin(self, location: Array) -> None:
        c = self.configuration
        self.probation = Probation(Lock(location, Recogniser(self.projection, c), c), c)
        self.belief = Belief(c)
        self.steering = Steering(c.steering_settings(), c.steering)
        self.pace, self.origin, self.coasting = Pace(), Origin(self.projection), Coasting()
        self._picture = Picture()
        self._time: float | None = None  # of the frame before

    def update(self, image: Bytes | None, time: float, frame: int, pose: Pose | None = None) -> FollowEstimate:
        """The estimate for ``image`` (H, W), taken at ``time``, s; None for a frame that could not be read.

        ``pose`` is the chase vehicle's odometry. Raises UnusableInput, and stays as it was, for an image of another
        size or kind and for a time that is none.
        """
        began = perf_counter()
        image = self._checked(image, frame)
        if not isfinite(time):
            raise UnusableInput(f"frame {frame}: expected its time in seconds, found {time}")
        jump = self._pass_time(time)
        self.pace.move(pose)
        fault = self._picture.fault(image)
        for lock in self.probation.locks:
            lock.predict(time)  # stage 6
        look, note = Look(fault), ""
        followed, was_pending = self.lock, self.probation.pending
        if image is not None and not fault:
            look = self.lock.look(image, self.belief.lost and not was_pending)  # stages 7 and 1 to 4
            look, note = self.probation.judge(image, time, look)
            if was_pending and not self.probation.pending:
                self.belief = Belief(self.configuration)  # it was confirmed
            look = self._plausible(image, look, time)
        was_lost = self.belief.status == "lost"
        status, reason = self.belief.step(time, look.complaint, self.lock.continuity.steady, look.sure)
        if was_lost and status == "tracking":
            self.probation.resume()
        if was_pending or look.slid or self.lock is not followed:
            self.origin, self.coasting = Origin(self.projection), Coasting()  # what was followed was elsewhere
        if image is not None and not fault and self.configuration.continuity:
            self._keep(image, time, look.fit if status == "tracking" else None)
        if look.fit is not None and status == "tracking":
            self.lock.learn(look, time)  # stage 5
            self.pace.learn(time, self.projection.distance(look.fit.location[2]))
        return self._estimate(frame, time, pose, began, look, status, reason or note or jump or look.note)

    def beginning_at(self, location: Array) -> FollowTracker:
        """Another one, which has seen nothing yet and begins without doubt at ``location`` (3,), ideal pixels and
        scale."""
        other = copy(self)
        other.configuration = self.configuration.model_copy(update={"probation": False})
        other._begin(location)
        return other

    @property
    def lock(self) -> Lock:
        """What is believed of the target."""
        return self.probation.lock

    def _plausible(self, image: Bytes, look: Look, time: float) -> Look:
        """The ``look`` at a target that was not seen in the image before, with a complaint where it drives as that
        cannot, or has come from where that was not."""
        asked = self.configuration.continuity and self.belief.status != "tracking"
        if look.fit is None or look.complaint or not asked:
            return look
        if self.pace.complains(time, self.projection.distance(look.fit.location[2])):
            return replace(look, complaint=DRIVES)
        return replace(look, complaint=CAME) if self.origin.complains(image, look.fit.location) else look

    def _keep(self, image: Bytes, time: float, seen: Fit | None) -> None:
        """Remember the image for later questions of where something has come from."""
        if seen is not None:
            self.origin.see(image, seen.location)
        else:
            self.origin.miss(image, time, self.lock.expected, self.lock.tau)

    def _pass_time(self, time: float) -> str:
        """Note the time of a frame; what is to be said about it where it jumps."""
        last, self._time = self._time, time
        if last is None or 0 < time - last <= self.configuration.jump_limit:
            return ""
        self.pace, self.origin, self.coasting = Pace(), Origin(self.projection), Coasting()
        for lock in self.probation.locks:
            lock.rest(last, time)
        if time < last:
            self.belief.rest(last, time)
        return f"the time jumps by {time - last:.2f} s: its motion is learned anew"

    def _checked(self, image: Bytes | None, frame: int) -> Bytes | None:
        if image is None:
            return None
        width, height = self.camera.image_size
        if image.ndim != 2 or image.dtype != np.uint8 or image.shape != (height, width):
            found = "×".join(str(n) for n in (*image.shape[1::-1], *image.shape[2:]))
            raise UnusableInput(
                f"frame {frame}: expected a grey image of {width}×{height} bytes, found {found} of {image.dtype}"
            )
        return np.ascontiguousarray(image)

    # --- stages 8 and 9 ----------------------------------------------------------------------------------------------

    def _estimate(
        self,
        frame: int,
        time: float,
        pose: Pose | None,
        began: float,
        look: Look,
        status: str,
        reason: str,
    ) -> FollowEstimate:
        measured = look.fit is not None and status == "tracking"
        expected, doubt = self.lock.expected, self.lock.doubt
        if look.fit is not None and measured:
            fit = look.fit
            if self.configuration.adaptive_decay and not look.slid:
                fit = fitting.fused(fit, expected, doubt)
            location, covariance = fit.location, fit.covariance
        else:
            location, covariance = expected, np.diag(doubt**2 + self.lock.foregone**2)
            if (coasted := self.coasting.position(time, self.pace.travelled)) is not None:
                location, covariance[2, 2] = self._coasted(*coasted)
        if self.configuration.rolling_shutter:
            displacement = displacement_deviation(self.camera, float(location[1]))
            covariance = covariance + np.diag([displacement**2, displacement**2, 0.0])
        m = look.measurement if measured else None
        tolerance = max(self.configuration.model_tolerance, self.target.tolerance)
        width = float(self.target.size[0])
        place = place_of(location, covariance, self.camera, self.target.nominal_range, tolerance, width)
        if measured:
            self.coasting.learn(time, place.position, self.pace.travelled)
        right, _, ahead = place.position.tolist()
        steering = self.steering.angle(time, ahead, right, measured, pose, look.sure)
        return FollowEstimate(
            frame=frame,
            time=time,
            center=self.camera.distort_points(location[:2]),
            scale=float(location[2]),
            weights=look.fit.weights if look.fit is not None and measured else np.zeros(3),
            position=place.position,
            position_std=place.std,
            bearing=place.bearing,
            steering=steering,
            status=status,
            reason=reason,
            residual=float("nan") if m is None else m.residual,
            lines=self.camera.distort_points(self.projection.lines(location)),
            points=np.zeros((0, 2)) if m is None else m.points,
            owners=np.zeros(0, np.int64) if m is None else m.owners,
            window=look.window,
            latency=perf_counter() - began,
        )

    def _coasted(self, position: Array, std: float) -> tuple[Array, float]:
        """The location (3,) of a ``position`` (3,) m, and its scale's variance where ``std`` m is that of the range."""
        x, y, _ = self.camera.K @ (position / position[2])
        scale = self.target.nominal_range / position[2]
        return np.array([x, y, scale]), (scale * std / position[2]) ** 2


def warm_up() -> None:
    """Compile all that a tracker needs, or load it from the cache, so that the first frame is not late."""
    camera = Camera((96, 96), np.array([[90.0, 0.0, 47.5], [0.0, 90.0, 47.5], [0.0, 0.0, 1.0]]))
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    target = Target("square", 4.0, corners, np.array([[0, 1], [1, 2], [2, 3], [3, 0]]))
    image = np.full((96, 96), 60, np.uint8)
    image[25:71, 25:71] = 180
    for configuration in (FollowConfiguration(), FollowConfiguration.as_published()):
        tracker = FollowTracker(camera, target, (47.5, 47.5, 1.0), configuration)
        for k in range(3):
            image[0, k] = 61 + k  # no two frames alike
            tracker.update(image, k / 15, k)
