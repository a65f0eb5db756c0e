"""Vehicle after vehicle, measured while the cameras record.

First the empty scene is learned, unless a detector proposes the vehicles along given paths; from then on every pair of
frames is looked through for vehicles. Each vehicle that has gone is outlined, and measured on the frames of the last
seconds, in a process of its own so that the looking goes on.
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
from paceline.detection.background_model import Detect, DetectedScene, EmptyScene, Scene
from paceline.detection.finder import Finder, Found, Register, as_seen, found_on
from paceline.detection.lane_paths import ways_of
from paceline.detection.search import with_lanes_found
from paceline.detection.tracks import Track
from paceline.documents.loading import Clip
from paceline.errors import UnusableInput
from paceline.lanes.road_detection import NoRoad
from paceline.recordings.background import FRAMES, Background, background_of, no_background
from paceline.recordings.live_stereo import LiveViews, RawPair, undistorted
from paceline.recordings.stereo import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.joint_calibration import with_neighbours
from paceline.speed.measurement import measure, require_two_views
from paceline.speed.results import Measurement
from paceline.speed.verdict import apply_tolerance
from paceline.verdicts import Message, message

LEARNING = 30.0  # s in which the empty scene is learned
APART = 0.2  # s between pairs to measure on, at most: of more pairs than needed every second or third one is left out

Told = Callable[[Found, Measurement | None, Message], None]
Looked = Callable[[RawPair, list[Track]], None]


@dataclass(frozen=True, eq=False)
class Recent:
    """The pairs of the last seconds, as a recording of ``clip``'s rig."""

    clip: Clip
    pairs: list[RawPair]
    rows: slice  # outside which nothing is looked at
    notices: list[str] = field(default_factory=list)

    @property
    def indices(self) -> NDArray[np.int64]:
        return np.array([pair.index for pair in self.pairs], np.int64)

    def __len__(self) -> int:
        return len(self.pairs)

    def frames(self) -> Iterator[StereoFrame]:
        return in_ideal_pixels(self.pairs, self.clip, self.rows)


def last_seen(track: Track) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The face (4, 2) of what a ``track`` has seen last, in ideal pixels of both views, clockwise from the top left."""
    assert track.last is not None, "a track begins with a sighting"
    (left, right), (low, high) = track.last.x, track.last.y
    corners = np.array([[left, high], [right, high], [right, low], [left, low]])
    return track.last.way.pixels(track.last.s, corners)


def in_ideal_pixels(pairs: Iterable[RawPair], clip: Clip, rows: slice = ALL_ROWS) -> Iterator[StereoFrame]:
    """The frames of ``pairs`` as the measurement takes them, outside of ``rows`` black."""
    before = None
    for pair in pairs:
        yield undistorted(pair, clip.rig, before, rows)
        before = pair


@on_one_blas_thread
def survey(
    clip: Clip,
    views: LiveViews,
    configuration: SpeedConfiguration,
    told: Told,
    learning: float = LEARNING,
    ready: Callable[[int], None] = lambda paths: None,
    looked: Looked = lambda pair, tracks: None,
    detect: Detect | None = None,
) -> Message:
    """Measure every vehicle that passes, until the sources end or are stopped; returns why there was none, where that
    is so.

    ``told`` is called once for each vehicle that has gone, in the order in which they were found, with its measurement,
    or None and why it has none; ``ready`` with the number of paths once the scene is learned; ``looked`` with every
    pair of frames that has been looked through, and what moves in it. With ``detect`` there are vehicles only in its
    boxes, and nothing is learned where the clip has paths. Raises UnusableInput where no empty road is seen in the
    first ``learning`` seconds, or where there are neither paths nor lanes.
    """
    plane_sweep.warm_up()
    pairs = iter(views)

    def first() -> Iterator[RawPair]:
        for pair in pairs:
            looked(pair, [])
            yield pair

    scene: Scene | None = None if detect is None else DetectedScene(detect)
    if scene is None or not clip.paths:
        background = _learned(clip, first(), learning)
        if reason := no_background(background):
            raise UnusableInput(f"{clip.path}: {reason}")
        if not clip.paths:
            try:
                clip = with_lanes_found(clip, background)
            except NoRoad as error:
                raise UnusableInput(f"{clip.path}: paths: there are none, and no lane was found: {error}") from None
        scene = scene or EmptyScene(background.images)
    else:
        scene.follow(_begun(clip, pairs))
    ready(len(clip.paths))
    finder = Finder(ways_of(clip), scene)
    recent: deque[RawPair] = deque(maxlen=configuration.live.buffer_pairs)

    def remembered() -> Iterator[RawPair]:
        for pair in pairs:
            recent.append(pair)
            yield pair

    with another_process() as measuring:
        desk = _Desk(clip, configuration, measuring, told, finder.rows)
        rows = finder.rows if detect is None else ALL_ROWS  # a detector knows whole vehicles
        for frame in in_ideal_pixels(remembered(), clip, rows):
            for track in finder.gone(frame):
                desk.take(track, recent)
            desk.tell()
            looked(recent[-1], finder.in_view)
        for track in finder.rest():
            desk.take(track, recent)
        desk.close()
    return scene.nothing


def another_process() -> ProcessPoolExecutor:
    """A process for the measuring. Ctrl-C at a terminal reaches every process: this one goes on, so that what has
    passed is still measured. Where the process that looks is killed, there is nobody to measure for."""
    executor = ProcessPoolExecutor(1, get_context("spawn"), _end_with_parent)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        executor.submit(int)  # begins the process, which inherits what is blocked
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


def _begun(clip: Clip, pairs: Iterator[RawPair]) -> StereoFrame:
    """The first of the ``pairs``, judged."""
    frame = next(in_ideal_pixels(pairs, clip), None)
    if frame is None:
        raise UnusableInput(f"{clip.path}: left and right: ended before they showed anything")
    require_two_views(clip, frame)
    return frame


def _learned(clip: Clip, pairs: Iterator[RawPair], learning: float) -> Background:
    """The background of the first ``learning`` seconds, by frames spread evenly over them."""
    stacks: tuple[list[NDArray[np.float16]], list[NDArray[np.float16]]] = [], []
    begun, due = None, 0.0
    for frame in in_ideal_pixels(pairs, clip):
        if begun is None:
            require_two_views(clip, frame)
            begun = frame.time
        passed = frame.time - begun
        if passed >= due and not frame.duplicate:
            due += learning / (FRAMES - 1)
            for stack, image in zip(stacks, (frame.left, frame.right), strict=True):
                stack.append(image.astype(np.float16))
        if passed >= learning:
            break
    else:
        raise UnusableInput(
            f"{clip.path}: left and right: ended within the {learning:g} s in which the empty road is learned"
        )
    return background_of(*stacks)


@dataclass(eq=False)
class _Case:
    """A vehicle that waits: first for its outline, then, known as ``found``, for its measurement on the ``pairs`` since
    it appeared."""

    track: Track
    outlined: Future[Found]
    pairs: list[RawPair]
    found: Found | None = None
    again: bool = False  # one that was found before
    measured: Future[Measurement] | None = None


class _Desk:
    """Takes vehicles that have gone, has them measured one after the other, and tells what came of it."""

    def __init__(
        self,
        clip: Clip,
        configuration: SpeedConfiguration,
        measuring: ProcessPoolExecutor,
        told: Told,
        rows: slice = ALL_ROWS,
    ) -> None:
        self._clip, self._configuration, self._measuring, self._told = clip, configuration, measuring, told
        self._rows, self._cases = rows, deque[_Case]()
        self._register, self._count = Register(), 0
        self._latest = deque[Measurement](maxlen=2 * configuration.joint_calibration.neighbours)

    def take(self, track: Track, recent: Iterable[RawPair]) -> None:
        if (waiting := sum(bool(case.pairs) for case in self._cases)) >= self._configuration.live.queue:
            outlined: Future[Found] = Future()
            outlined.set_result(
                as_seen(track, message("queue_full", waiting=waiting, max_waiting=self._configuration.live.queue))
            )
            self._cases.append(_Case(track, outlined, []))
        else:
            pairs = [pair for pair in recent if pair.index >= track.first.frame]
            self._cases.append(_Case(track, self._measuring.submit(found_on, track), pairs))

    def tell(self) -> None:
        """What is known by now, in order."""
        for case in self._cases:
            if case.found is None and not case.outlined.done():
                break
            self._go_on(case)
        while self._cases and (first := self._cases[0]).found and (first.measured is None or first.measured.done()):
            self._tell_first()

    def close(self) -> None:
        """Wait for what is being measured."""
        for case in self._cases:
            self._go_on(case)
        while self._cases:
            self._tell_first()

    def _go_on(self, case: _Case) -> None:
        """Have a vehicle measured, once it is known what its outline is."""
        if case.found is not None:
            return
        case.found = case.outlined.result()
        case.again = not self._register.is_new(case.track, case.found)
        if case.again:
            return
        if (vehicle := case.found.vehicle) is None:
            return
        vehicle = replace(vehicle, id=f"v{self._count}")
        self._count += 1
        case.found = replace(case.found, vehicle=vehicle)
        pairs = [pair for pair in case.pairs if pair.index >= vehicle.frame]
        if not pairs or pairs[0].index > vehicle.frame:
            case.found = replace(
                case.found, reason=message("frames_expired", max_pairs=self._configuration.live.buffer_pairs)
            )
        else:
            clip = replace(self._clip, vehicles=[vehicle])
            case.measured = self._measuring.submit(
                _measured,
                clip,
                thinned(pairs, self._configuration.live.pairs_per_vehicle),
                self._rows,
                self._configuration,
            )

    def _tell_first(self) -> None:
        case = self._cases.popleft()
        assert case.found is not None, "what is told is known"
        if case.again:
            return
        measurement, reason = None, case.found.reason
        if case.measured is not None:
            try:
                measurement = self._put_right(case.measured.result())
            except UnusableInput as unusable:
                reason = message("input_unusable", problem=unusable)
        self._told(case.found, measurement, reason)

    def _put_right(self, m: Measurement) -> Measurement:
        """``m`` with what the latest vehicles tell of the rig, too."""
        right = apply_tolerance(with_neighbours(m, self._latest, self._configuration), self._configuration.tolerance)
        if m.rig_information is not None:
            self._latest.append(m)
        return right


def thinned(pairs: list[RawPair], most_pairs: int) -> list[RawPair]:
    """The first of ``pairs`` and as many of the others, evenly spread, as a vehicle is measured on."""
    interval = (pairs[-1].time - pairs[0].time) / max(len(pairs) - 1, 1)
    most = int(APART / interval + 0.1) if interval > 0 else 1
    return pairs[:: max(min(-(-len(pairs) // most_pairs), most), 1)]


@on_one_blas_thread
def _measured(clip: Clip, pairs: list[RawPair], rows: slice, configuration: SpeedConfiguration) -> Measurement:
    return measure(clip, Recent(clip, pairs, rows), configuration).measurements[0]
