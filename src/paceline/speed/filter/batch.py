"""The filter step, of one vehicle or of several together ([Zhu] section III), and the trackers of a clip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, TypeVar

from paceline.documents.loading import VehicleDocument
from paceline.recordings.stereo import StereoFrame
from paceline.speed.filter.device import DeviceFailure, as_device_failure
from paceline.speed.filter.estimate import Estimate
from paceline.speed.filter.likelihood import Views, pack_views
from paceline.speed.filter.particle_set import Particles
from paceline.verdicts import message

if TYPE_CHECKING:
    from paceline.speed.filter.cuda.device import CudaDevice


class FilterTracker(Protocol):
    """What a batch needs of `tracker.Tracker`, which documents each."""

    vehicle: VehicleDocument
    status: str
    particle_set: Particles

    @property
    def is_initialized(self) -> bool: ...

    def initialize(self, frame: StereoFrame) -> Estimate: ...

    def update(self, frame: StereoFrame) -> Estimate: ...

    def predict(self, frame: StereoFrame) -> None: ...

    def displace(self, frame: StereoFrame) -> None: ...

    def register(self, frame: StereoFrame) -> None: ...

    def weight(self, views: Views) -> None: ...

    def estimate(self, frame: StereoFrame) -> Estimate: ...

    def update_reference(self) -> None: ...

    def resample(self) -> None: ...

    def checkpoint(self) -> dict[str, object]: ...

    def restore(self, state: dict[str, object]) -> None: ...


AnyTracker = TypeVar("AnyTracker", bound=FilterTracker)


def step(trackers: Sequence[FilterTracker], frame: StereoFrame) -> list[Estimate]:
    """One step of the filters of ``trackers``, each past its first frame: [Zhu] section III.

    All trackers take each part of it together, because a GPU executes what was enqueued for all of them at once.
    """
    if not trackers:
        return []
    for tracker in trackers:
        tracker.predict(frame)
    for tracker in trackers:
        tracker.displace(frame)
    for tracker in trackers:
        tracker.register(frame)
    views = pack_views(frame, [tracker.particle_set.image_bounds() for tracker in trackers])
    for tracker in trackers:
        tracker.weight(views)
    estimates = [tracker.estimate(frame) for tracker in trackers]
    for tracker in trackers:
        tracker.update_reference()
    for tracker in trackers:
        tracker.resample()
    return estimates


class TrackerBatch:
    """Trackers that process the same frames. On a ``device`` they take each step together, in the same launches.

    With ``fall_back_to_cpu``, a device that fails is left: all trackers continue on the CPU from where they were before
    that frame, and ``notices`` states it. Otherwise the DeviceFailure is raised.
    """

    def __init__(self, device: CudaDevice | None = None, fall_back_to_cpu: bool = False) -> None:
        self.device, self.fall_back_to_cpu = device, fall_back_to_cpu
        self.notices: list[str] = []
        self._trackers: list[FilterTracker] = []
        self._checkpoints: list[dict[str, object]] = []
        self._frame = -1
        self._estimates: dict[str, Estimate] = {}

    def add(self, tracker: AnyTracker) -> AnyTracker:
        """Add ``tracker``, whose estimates then come from `update`; returns it."""
        self._trackers.append(tracker)
        self._checkpoints.append(tracker.checkpoint())
        return tracker

    def update(self, tracker: FilterTracker, frame: StereoFrame) -> Estimate:
        """The estimate of ``tracker`` at ``frame``; on a device the first call for a frame updates all trackers."""
        if self.device is not None and frame.index != self._frame:
            self._estimates, self._frame = {}, frame.index
            try:
                with as_device_failure():
                    self._update_together(frame)
            except DeviceFailure as failure:
                if not self.fall_back_to_cpu:
                    raise
                self.device = None
                for each_tracker, checkpoint in zip(self._trackers, self._checkpoints, strict=True):
                    each_tracker.restore(checkpoint)
                self._estimates = {}
                self.notices.append(message("gpu_fallback", frame=frame.index, problem=failure.reason))
        estimate = self._estimates.pop(tracker.vehicle.id, None)
        return tracker.update(frame) if estimate is None else estimate

    def _update_together(self, frame: StereoFrame) -> None:
        in_view = [t for t in self._trackers if t.status == "tracking" and t.vehicle.frame <= frame.index]
        new = [t for t in in_view if not t.is_initialized]
        old = [t for t in in_view if t.is_initialized]
        estimates = [t.initialize(frame) for t in new] + step(old, frame)
        self._estimates = {t.vehicle.id: estimate for t, estimate in zip(new + old, estimates, strict=True)}
        if self.fall_back_to_cpu:
            self._checkpoints = [t.checkpoint() for t in self._trackers]
