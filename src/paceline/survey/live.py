"""Measurement of vehicle after vehicle while the cameras record.

First the background is estimated, unless a detector proposes the vehicles along given paths; from then on vehicles are
detected in every image pair. Each vehicle that has passed is outlined and measured on the buffered image pairs, in a
process of its own so that detection goes on.
"""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context, parent_process
from threading import Thread

import numpy as np
from numpy.typing import NDArray

from paceline.blas import on_one_blas_thread
from paceline.cameras import ALL_ROWS
from paceline.detection import plane_sweep
from paceline.detection.background_model import (
    BackgroundModel,
    DetectBoxes,
    DetectorBackground,
    RunningMedianBackground,
)
from paceline.detection.finder import DetectedVehicle, DuplicateFilter, VehicleFinder, outline, without_outline
from paceline.detection.lane_paths import lane_paths_of
from paceline.detection.search import with_detected_lanes
from paceline.detection.tracks import DetectionTrack
from paceline.documents.loading import Clip
from paceline.errors import UnusableInput
from paceline.imaging.recorded_cameras import with_assumed_exposures
from paceline.lanes.road_detection import RoadNotFound
from paceline.recordings.background import Background, background_from, background_problem
from paceline.recordings.live_stereo import LiveStereo, RawPair, undistort_pair
from paceline.recordings.stereo import StereoFrame
from paceline.speed.acceptance import apply_tolerance
from paceline.speed.configuration import BackgroundSettings, SpeedConfiguration
from paceline.speed.joint_calibration import with_neighbours
from paceline.speed.measurement import measure_separately, require_two_views
from paceline.speed.passage import with_passage
from paceline.speed.results import Measurement
from paceline.verdicts import Message, message

MAX_PAIR_SPACING_S = 0.2  # greatest time between the pairs that are measured, where pairs are left out

OnResult = Callable[[DetectedVehicle, Measurement | None, Message], None]
OnFrame = Callable[[RawPair, list[DetectionTrack]], None]


@dataclass(frozen=True, eq=False)
class BufferedRecording:
    """The buffered image pairs, as a recording of the rig of ``clip``."""

    clip: Clip
    pairs: list[RawPair]
    rows: slice  # that are used
    notices: list[str] = field(default_factory=list)

    @property
    def indices(self) -> NDArray[np.int64]:
        return np.array([pair.index for pair in self.pairs], np.int64)

    def __len__(self) -> int:
        return len(self.pairs)

    def frames(self) -> Iterator[StereoFrame]:
        return undistorted_frames(self.pairs, self.clip, self.rows)


def last_outline(track: DetectionTrack) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The outline (4, 2) of the last detection of a ``track``, in ideal pixels of both views, clockwise from the top
    left."""
    assert track.last is not None, "a track begins with a detection"
    (left, right), (low, high) = track.last.x, track.last.y
    corners = np.array([[left, high], [right, high], [right, low], [left, low]])
    return track.last.lane.pixels(track.last.s, corners)


def undistorted_frames(pairs: Iterable[RawPair], clip: Clip, rows: slice = ALL_ROWS) -> Iterator[StereoFrame]:
    """The frames of ``pairs`` in ideal pixels, black outside ``rows``."""
    previous = None
    for pair in pairs:
        yield undistort_pair(pair, clip.rig, previous, rows)
        previous = pair


@on_one_blas_thread
def survey(
    clip: Clip,
    views: LiveStereo,
    configuration: SpeedConfiguration,
    on_result: OnResult,
    on_ready: Callable[[int], None] = lambda paths: None,
    on_frame: OnFrame = lambda pair, tracks: None,
    detect: DetectBoxes | None = None,
) -> Message:
    """Measures every vehicle that passes, until the sources end or are stopped; returns why no vehicle was found, if
    none was.

    ``on_result`` is called once for each vehicle that has passed, in the order in which they were found, with its
    measurement, or None and the reason; ``on_ready`` with the number of paths once the background is estimated;
    ``on_frame`` with every image pair that has been processed, and the tracks visible in it. With ``detect``, vehicles
    are found only inside its boxes, and the background is not estimated where the clip has paths. Raises UnusableInput
    where the road is not visible in the first seconds, or where there are neither paths nor lanes.
    """
    plane_sweep.warm_up()
    pairs = iter(views)

    def first() -> Iterator[RawPair]:
        for pair in pairs:
            on_frame(pair, [])
            yield pair

    model: BackgroundModel | None = None if detect is None else DetectorBackground(detect)
    if model is None or not clip.paths:
        background = _estimate_background(clip, first(), configuration.background)
        if reason := background_problem(background):
            raise UnusableInput(f"{clip.path}: {reason}")
        if not clip.paths:
            try:
                clip = with_detected_lanes(clip, background, configuration.lanes.width)
            except RoadNotFound as error:
                raise UnusableInput(f"{clip.path}: paths: there are none, and no lane was found: {error}") from None
        model = model or RunningMedianBackground(background.images)
    else:
        model.update(_first_frame(clip, pairs))
    on_ready(len(clip.paths))
    clip = with_assumed_exposures(clip, views.interval)
    finder = VehicleFinder(lane_paths_of(clip, configuration.line_sigma), model, configuration)
    buffer: deque[RawPair] = deque(maxlen=configuration.live.buffer_pairs)

    def buffered() -> Iterator[RawPair]:
        for pair in pairs:
            buffer.append(pair)
            yield pair

    with worker_process() as worker:
        queue = MeasurementQueue(clip, configuration, worker, on_result, finder.rows)
        rows = finder.rows if detect is None else ALL_ROWS  # a detector needs whole vehicles
        for frame in undistorted_frames(buffered(), clip, rows):
            for track in finder.finished_tracks(frame):
                queue.submit(track, buffer)
            queue.publish()
            on_frame(buffer[-1], finder.visible_tracks)
        for track in finder.remaining_tracks():
            queue.submit(track, buffer)
        queue.close()
    return model.no_vehicle_reason


def worker_process() -> ProcessPoolExecutor:
    """A process that measures. Ctrl-C at a terminal reaches every process: this one ignores it, so that what has passed
    is still measured. It ends when its parent process is killed."""
    executor = ProcessPoolExecutor(1, get_context("spawn"), _end_with_parent)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        executor.submit(int)  # starts the process, which inherits the blocked signal
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return executor


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    Thread(target=wait, daemon=True).start()


def _first_frame(clip: Clip, pairs: Iterator[RawPair]) -> StereoFrame:
    """The first of the ``pairs``, checked."""
    frame = next(undistorted_frames(pairs, clip), None)
    if frame is None:
        raise UnusableInput(f"{clip.path}: left and right: ended before they showed anything")
    require_two_views(clip, frame)
    return frame


def _estimate_background(clip: Clip, pairs: Iterator[RawPair], settings: BackgroundSettings) -> Background:
    """The background of the first seconds, from frames spread evenly over them."""
    stacks: tuple[list[NDArray[np.float16]], list[NDArray[np.float16]]] = [], []
    start_time, next_s = None, 0.0
    for frame in undistorted_frames(pairs, clip):
        if start_time is None:
            require_two_views(clip, frame)
            start_time = frame.time
        elapsed = frame.time - start_time
        if elapsed >= next_s and not frame.duplicate:
            next_s += settings.seconds / (settings.frames - 1)
            for stack, image in zip(stacks, (frame.left, frame.right), strict=True):
                stack.append(image.astype(np.float16))
        if elapsed >= settings.seconds:
            break
    else:
        raise UnusableInput(
            f"{clip.path}: left and right: ended within the {settings.seconds:g} s in which the empty road is learned"
        )
    return background_from(*stacks)


@dataclass(eq=False)
class PendingVehicle:
    """A vehicle that waits: first for its outline, then, with it in ``found``, for its measurement on the ``pairs``
    since it appeared."""

    track: DetectionTrack
    outlined: Future[DetectedVehicle]
    pairs: list[RawPair]
    found: DetectedVehicle | None = None
    is_duplicate: bool = False
    measured: Future[Measurement] | None = None


class MeasurementQueue:
    """Vehicles that have passed, measured one after the other in a ``worker`` process, and their results in order."""

    def __init__(
        self,
        clip: Clip,
        configuration: SpeedConfiguration,
        worker: ProcessPoolExecutor,
        on_result: OnResult,
        rows: slice = ALL_ROWS,
    ) -> None:
        self._clip, self._configuration, self._worker, self._on_result = clip, configuration, worker, on_result
        self._rows, self._pending = rows, deque[PendingVehicle]()
        self._duplicates, self._count = DuplicateFilter(), 0
        self._recent = deque[Measurement](maxlen=2 * configuration.joint_calibration.neighbours)

    def submit(self, track: DetectionTrack, buffer: Iterable[RawPair]) -> None:
        """Add the vehicle of a ``track``, of which the ``buffer`` holds image pairs."""
        limit = self._configuration.live.queue
        if (count := sum(bool(waiting.pairs) for waiting in self._pending)) >= limit:
            outlined: Future[DetectedVehicle] = Future()
            outlined.set_result(without_outline(track, message("queue_full", waiting=count, max_waiting=limit)))
            self._pending.append(PendingVehicle(track, outlined, []))
        else:
            pairs = [pair for pair in buffer if pair.index >= track.first.frame]
            self._pending.append(PendingVehicle(track, self._worker.submit(outline, track, self._configuration), pairs))

    def publish(self) -> None:
        """Hand out the results that are known by now, in order."""
        for waiting in self._pending:
            if waiting.found is None and not waiting.outlined.done():
                break
            self._start_measurement(waiting)
        while self._pending and (first := self._pending[0]).found and (first.measured is None or first.measured.done()):
            self._publish_first()

    def close(self) -> None:
        """Wait for all results and hand them out."""
        for waiting in self._pending:
            self._start_measurement(waiting)
        while self._pending:
            self._publish_first()

    def _start_measurement(self, waiting: PendingVehicle) -> None:
        """Have a vehicle measured, once its outline is known."""
        if waiting.found is not None:
            return
        waiting.found = waiting.outlined.result()
        waiting.is_duplicate = not self._duplicates.is_new(waiting.track, waiting.found)
        if waiting.is_duplicate:
            return
        if (vehicle := waiting.found.vehicle) is None:
            return
        vehicle = replace(vehicle, id=f"v{self._count}")
        self._count += 1
        waiting.found = replace(waiting.found, vehicle=vehicle)
        pairs = [pair for pair in waiting.pairs if pair.index >= vehicle.frame]
        if not pairs or pairs[0].index > vehicle.frame:
            reason = message("frames_expired", max_pairs=self._configuration.live.buffer_pairs)
            waiting.found = replace(waiting.found, reason=reason)
        else:
            clip = replace(self._clip, vehicles=[vehicle])
            chosen = subsample(pairs, self._configuration.live.pairs_per_vehicle)
            waiting.measured = self._worker.submit(_measure, clip, chosen, self._rows, self._configuration)

    def _publish_first(self) -> None:
        waiting = self._pending.popleft()
        assert waiting.found is not None, "the outline has been determined"
        if waiting.is_duplicate:
            return
        measurement, reason = None, waiting.found.reason
        if waiting.measured is not None:
            try:
                measurement = self._jointly_calibrated(waiting.measured.result())
            except UnusableInput as unusable:
                reason = message("input_unusable", problem=unusable)
        self._on_result(waiting.found, measurement, reason)

    def _jointly_calibrated(self, m: Measurement) -> Measurement:
        """``m`` with what the measurements of recent vehicles add to the calibration."""
        joint = apply_tolerance(with_neighbours(m, self._recent, self._configuration), self._configuration.tolerance)
        if m.rig_information is not None:
            self._recent.append(m)
        return joint


def subsample(pairs: list[RawPair], max_pairs: int) -> list[RawPair]:
    """The first of ``pairs`` and every n-th after it: about ``max_pairs``, or more if they would be too far apart."""
    interval = (pairs[-1].time - pairs[0].time) / max(len(pairs) - 1, 1)
    max_step = int(MAX_PAIR_SPACING_S / interval + 0.1) if interval > 0 else 1
    return pairs[:: max(min(-(-len(pairs) // max_pairs), max_step), 1)]


@on_one_blas_thread
def _measure(clip: Clip, pairs: list[RawPair], rows: slice, configuration: SpeedConfiguration) -> Measurement:
    result = measure_separately(clip, BufferedRecording(clip, pairs, rows), configuration)
    return with_passage(result.measurements[0], clip, result.paths)
