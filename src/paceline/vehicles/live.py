"""Vehicle after vehicle, measured while the cameras record.

First the empty scene is learned; from then on every pair of frames is looked through for vehicles, and each vehicle
that has gone is measured on the frames of the last seconds, in a process of its own so that the looking goes on.
"""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from multiprocessing import get_context

import numpy as np
from numpy.typing import NDArray

from paceline.documents import Clip
from paceline.errors import UnusableInput
from paceline.lanes.background import FRAMES, Background, background_of, no_background
from paceline.lanes.finding import NoRoad
from paceline.live_views import LiveViews, RawPair, undistorted
from paceline.recordings import StereoFrame
from paceline.speed.configuration import SpeedConfiguration
from paceline.speed.measurement import measure, refuse_one_view
from paceline.speed.results import Measurement
from paceline.vehicles.finding import Finder, Found
from paceline.vehicles.measuring import with_lanes_found
from paceline.vehicles.scene import EmptyScene
from paceline.vehicles.ways import ways_of

LEARNING = 30.0  # s in which the empty scene is learned
REMEMBERED = 150  # pairs of frames that are kept for the vehicles in view
BACKLOG = 4  # vehicles that wait to be measured, at most
BUSY = "not measured: vehicles come faster than this computer measures them"
FORGOTTEN = "not measured: it was in view for longer than frames are kept"

Told = Callable[[Found, Measurement | None, str], None]


@dataclass(frozen=True, eq=False)
class Recent:
    """The pairs of the last seconds, as a recording of ``clip``'s rig."""

    clip: Clip
    pairs: list[RawPair]
    notices: list[str] = field(default_factory=list)

    @property
    def indices(self) -> NDArray[np.int64]:
        return np.array([pair.index for pair in self.pairs], np.int64)

    def __len__(self) -> int:
        return len(self.pairs)

    def frames(self) -> Iterator[StereoFrame]:
        return in_ideal_pixels(self.pairs, self.clip)


def in_ideal_pixels(pairs: Iterable[RawPair], clip: Clip) -> Iterator[StereoFrame]:
    """The frames of ``pairs`` as the measurement takes them."""
    before = None
    for pair in pairs:
        yield undistorted(pair, clip.rig, before)
        before = pair


def survey(
    clip: Clip,
    views: LiveViews,
    configuration: SpeedConfiguration,
    told: Told,
    learning: float = LEARNING,
    ready: Callable[[int], None] = lambda paths: None,
) -> None:
    """Measure every vehicle that passes, until the sources end or are stopped.

    ``told`` is called once for each vehicle that has gone, in the order in which they were found, with its measurement,
    or None and why it has none; ``ready`` with the number of paths once the scene is learned. Raises UnusableInput
    where no empty road is seen in the first ``learning`` seconds, or where there are neither paths nor lanes.
    """
    pairs = iter(views)
    background = _learned(clip, pairs, learning)
    if reason := no_background(background):
        raise UnusableInput(f"{clip.path}: {reason}")
    if not clip.paths:
        try:
            clip = with_lanes_found(clip, background)
        except NoRoad as error:
            raise UnusableInput(f"{clip.path}: paths: there are none, and no lane was found: {error}") from None
    ready(len(clip.paths))
    finder = Finder(ways_of(clip), EmptyScene(background.images))
    recent: deque[RawPair] = deque(maxlen=REMEMBERED)

    def remembered() -> Iterator[RawPair]:
        for pair in pairs:
            recent.append(pair)
            yield pair

    with _another_process() as measuring:
        desk = _Desk(clip, configuration, measuring, told)
        for frame in in_ideal_pixels(remembered(), clip):
            for found in finder.see(frame):
                desk.take(found, recent)
            desk.tell()
        for found in finder.finish():
            desk.take(found, recent)
        desk.close()


def _another_process() -> ProcessPoolExecutor:
    """A process for the measuring. Ctrl-C at a terminal reaches every process: this one goes on, so that what has
    passed is still measured."""
    executor = ProcessPoolExecutor(1, get_context("spawn"))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        executor.submit(int)  # begins the process, which inherits what is blocked
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return executor


def _learned(clip: Clip, pairs: Iterator[RawPair], learning: float) -> Background:
    """The background of the first ``learning`` seconds, by frames spread evenly over them."""
    stacks: tuple[list[NDArray[np.float16]], list[NDArray[np.float16]]] = [], []
    begun, due = None, 0.0
    for frame in in_ideal_pixels(pairs, clip):
        if begun is None:
            refuse_one_view(clip, frame)
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


class _Desk:
    """Takes vehicles that have gone, has them measured one after the other, and tells what came of it."""

    def __init__(
        self, clip: Clip, configuration: SpeedConfiguration, measuring: ProcessPoolExecutor, told: Told
    ) -> None:
        self._clip, self._configuration, self._measuring, self._told = clip, configuration, measuring, told
        self._waiting: deque[tuple[Found, Future[Measurement] | None, str]] = deque()
        self._count = 0

    def take(self, found: Found, recent: Iterable[RawPair]) -> None:
        reason, future = found.reason, None
        if found.vehicle is not None:
            vehicle = replace(found.vehicle, id=f"v{self._count}")
            found = replace(found, vehicle=vehicle)
            self._count += 1
            pairs = [pair for pair in recent if pair.index >= vehicle.frame]
            if sum(waiting is not None for _, waiting, _ in self._waiting) >= BACKLOG:
                reason = BUSY
            elif not pairs or pairs[0].index > vehicle.frame:
                reason = FORGOTTEN
            else:
                clip = replace(self._clip, vehicles=[vehicle])
                future = self._measuring.submit(_measured, clip, pairs, self._configuration)
        self._waiting.append((found, future, reason))

    def tell(self) -> None:
        """What is known by now, in order."""
        while self._waiting and ((future := self._waiting[0][1]) is None or future.done()):
            self._tell_first()

    def close(self) -> None:
        """Wait for what is being measured."""
        while self._waiting:
            self._tell_first()

    def _tell_first(self) -> None:
        found, future, reason = self._waiting.popleft()
        measurement = None
        if future is not None:
            try:
                measurement = future.result()
            except UnusableInput as unusable:
                reason = str(unusable)
        self._told(found, measurement, reason)


def _measured(clip: Clip, pairs: list[RawPair], configuration: SpeedConfiguration) -> Measurement:
    return measure(clip, Recent(clip, pairs), configuration).measurements[0]
