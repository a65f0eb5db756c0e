"""The vehicles of a clip, followed together on a GPU, and on the CPU from the frame at which the GPU goes away."""

from __future__ import annotations

from typing import TYPE_CHECKING

from paceline.recordings.stereo import StereoFrame
from paceline.speed.filter.device import DeviceFailure, as_device_failure
from paceline.speed.filter.estimate import Estimate
from paceline.speed.filter.particle_set import pack_views
from paceline.speed.filter.tracker import Tracker
from paceline.verdicts import message

if TYPE_CHECKING:
    from paceline.speed.filter.cuda.device import CudaDevice


class TrackerBatch:
    """Trackers that go through the same frames. On a ``device`` they take each step together, in the same launches.

    With ``carry_on``, a device that fails is left: all trackers go on in the computer's memory from where they were
    before that frame, and ``notices`` says so. Otherwise the DeviceFailure is raised.
    """

    def __init__(self, device: CudaDevice | None = None, carry_on: bool = False) -> None:
        self.device, self.carry_on = device, carry_on
        self.notices: list[str] = []
        self._trackers: list[Tracker] = []
        self._checkpoints: list[dict[str, object]] = []
        self._frame = -1
        self._estimates: dict[str, Estimate] = {}

    def join(self, tracker: Tracker) -> Tracker:
        """``tracker`` itself, which from now on is asked for its estimates through `update`."""
        self._trackers.append(tracker)
        self._checkpoints.append(tracker.checkpoint())
        return tracker

    def update(self, tracker: Tracker, frame: StereoFrame) -> Estimate:
        """The estimate of ``tracker`` at ``frame``; the first to be asked for it takes all the others along."""
        if self.device is not None and frame.index != self._frame:
            self._estimates, self._frame = {}, frame.index
            try:
                with as_device_failure():
                    self._update_together(frame)
            except DeviceFailure as failure:
                if not self.carry_on:
                    raise
                self.device = None
                for each, before in zip(self._trackers, self._checkpoints, strict=True):
                    each.restore(before)
                self._estimates = {}
                self.notices.append(message("gpu_fallback", frame=frame.index, problem=failure.reason))
        found = self._estimates.pop(tracker.vehicle.id, None)
        return tracker.update(frame) if found is None else found

    def _update_together(self, frame: StereoFrame) -> None:
        assert self.device is not None
        seen = [t for t in self._trackers if t.status == "tracking" and t.vehicle.frame <= frame.index]
        for tracker in seen:
            if tracker.begins:
                self._estimates[tracker.vehicle.id] = tracker.update(frame)
        moving = [t for t in seen if t.vehicle.id not in self._estimates]
        for tracker in moving:
            tracker.propose(frame)
        for tracker in moving:
            tracker.guide(frame)
        if moving:
            both = pack_views(frame, [t.particle_set.image_bounds() for t in moving])
            for tracker in moving:
                tracker.views = both
            self.device.weight(moving)
            judged = [t.judge() for t in moving]
            self._estimates |= {t.vehicle.id: t.conclude(frame, j) for t, j in zip(moving, judged, strict=True)}
        if self.carry_on:
            self._checkpoints = [t.checkpoint() for t in self._trackers]
