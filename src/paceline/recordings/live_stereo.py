"""Live stereo: pairs of frames from two cameras; frames that arrive faster than they are processed are dropped.

Each view is received in a thread of its own. An address or a named pipe has its own clock, a device that of this
computer; a file is played at the rate of its time stamps.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from threading import Condition, Thread
from typing import Protocol

import numpy as np

from paceline.cameras import ALL_ROWS, Camera, Quantity, StereoRig
from paceline.recordings.monocular import STOP_POLL_INTERVAL_S, CameraFrame, CameraRecording, Grey, open_camera
from paceline.recordings.stereo import MIN_REPORTED_SKEW_S, StereoFrame, rig_notices
from paceline.verdicts import message

MAX_QUEUED_FRAMES = 64  # frames per view; a pause of seconds loses none, beyond them the oldest is dropped
CLOCK_OFFSET_FRAMES = 8  # frames per live view from which the offset between the two clocks is estimated
PAIR_TOLERANCE = 0.25, 0.5  # greatest offset between the frames of a pair, in frame intervals: of files, of live views
PAIRED_TOLERANCE_FACTOR = 1.5  # factor on the tolerance once a pair was found, so that jitter does not end the pairing
MAX_LIVE_INTERVALS = 15  # latest intervals, whose median is the frame interval; single ones vary with exposure and load
MAX_DELAY_DIFFERENCE_S = 1.0  # difference between the delays of two cameras that share this computer's clock


@dataclass(frozen=True, eq=False)
class RawPair:
    """The frames of both cameras at ``time``, s: images (H, W) as recorded, not undistorted; ``index`` counts the
    left view's frames from 0, ``skew`` is right minus left, s."""

    index: int
    time: float
    left: Grey
    right: Grey
    skew: float


class LiveSource(Protocol):
    """The addresses and settings of two live cameras, as in a clip.yaml."""

    @property
    def path(self) -> Path: ...
    @property
    def addresses(self) -> tuple[str, str]: ...
    @property
    def rate(self) -> float | None: ...
    @property
    def rate_override(self) -> bool: ...
    @property
    def bit_depth(self) -> int | None: ...
    @property
    def rig(self) -> StereoRig: ...
    @property
    def offset(self) -> Quantity | None: ...


class LiveStereo:
    """The live pairs of frames of a rig; to be iterated once. Memory does not grow with time.

    A stated ``offset`` counts as in a recording: it is added to the times of the right view, once frames are paired.
    ``dropped`` counts the left view's frames that were not used because newer ones had come. Raises UnusableInput for
    sources that cannot be opened.
    """

    def __init__(self, clip: LiveSource) -> None:
        self._views = [
            LiveCamera(
                open_camera(_ViewSource(clip.path, address, clip.rate, clip.rate_override, clip.bit_depth, camera))
            )
            for address, camera in zip(clip.addresses, clip.rig.cameras, strict=True)
        ]
        self._rig = clip.rig
        self._stated_offset = 0.0 if clip.offset is None else clip.offset.value
        self._clock_offset = 0.0  # s, right clock minus left clock; 0 where they share one
        self._max_skew = 0.0  # s, the greatest of all pairs

    @property
    def dropped(self) -> int:
        return self._views[0].dropped

    @property
    def interval(self) -> float:
        """Seconds between two frames of the left view, of late."""
        return self._views[0].interval

    @property
    def notices(self) -> list[str]:
        """What a user should know about the sources, one plain line each."""
        messages = rig_notices(self._rig)
        if self._clock_offset:
            messages.append(message("no_common_clock"))
        if self._max_skew > MIN_REPORTED_SKEW_S:
            skew = f"up to {1e3 * self._max_skew:.1f} ms apart, which is allowed for"
            messages.append(message("views_skewed", frames="left and right frames", skew=skew))
        return [*messages, *(line for camera in self._views for line in camera.recording.notices)]

    def stop(self) -> None:
        """Ends the iteration after the present pair, as if the sources ended there; a signal handler may call it."""
        for camera in self._views:
            camera.stop()

    def __iter__(self) -> Iterator[RawPair]:
        left, right = self._views
        start_time = time.monotonic()
        for camera in self._views:
            camera.begin(start_time)
        try:
            self._clock_offset = _clock_offset(left, right)
            for pair in _pairs(left, right, self._clock_offset):
                self._max_skew = max(self._max_skew, abs(pair.skew))
                offset = self._stated_offset
                yield replace(pair, time=pair.time + 0.5 * offset, skew=pair.skew + offset)
        finally:
            self.stop()
        for camera in self._views:
            if camera.error is not None:
                raise camera.error


@dataclass(frozen=True)
class _ViewSource:
    """One view as a `monocular.CameraSource`."""

    path: Path
    video: str
    rate: float | None
    rate_override: bool
    bit_depth: int | None
    camera: Camera


@dataclass(eq=False)
class LiveCamera:
    """A view and the thread that receives it."""

    recording: CameraRecording
    interval: float = np.inf  # s, between two of its frames, of late
    dropped: int = 0
    error: Exception | None = None
    _waiting: deque[tuple[CameraFrame, float]] = field(default_factory=deque)  # with its arrival
    _changed: Condition = field(default_factory=Condition)
    _intervals: deque[float] = field(default_factory=lambda: deque(maxlen=MAX_LIVE_INTERVALS))
    _last: float = -np.inf
    _ended: bool = False
    _stopped: bool = False

    def begin(self, start_time: float) -> None:
        Thread(target=self._receive, args=[start_time], daemon=True).start()

    def stop(self) -> None:
        self._stopped = True
        self.recording.stop()

    def peek(self) -> CameraFrame | None:
        """The oldest queued frame, once there is one and the interval is known; None at the end, and once stopped."""
        with self._changed:
            while not (self._stopped or (self._waiting and np.isfinite(self.interval))):
                if self._ended:
                    return None
                self._changed.wait(STOP_POLL_INTERVAL_S)
            return None if self._stopped else self._waiting[0][0]

    def pop(self, frame: CameraFrame) -> None:
        """Removes ``frame`` from the queue, unless it has been dropped meanwhile."""
        with self._changed:
            if self._waiting and self._waiting[0][0] is frame:
                self._waiting.popleft()

    def delay_s(self) -> float:
        """Median delay, arrival minus time stamp, s, of the first frames that arrive as evenly as they were taken;
        frames buffered before reading began arrive all at once and are skipped."""
        delays: deque[float] = deque(maxlen=CLOCK_OFFSET_FRAMES)
        for _ in range(MAX_QUEUED_FRAMES):
            if self.peek() is None:
                break
            with self._changed:
                frame, arrival = self._waiting.popleft()
            delays.append(arrival - frame.time)
            if len(delays) == CLOCK_OFFSET_FRAMES and max(delays) - min(delays) < PAIR_TOLERANCE[True] * self.interval:
                break
        return median(delays) if delays else 0.0

    def _receive(self, start_time: float) -> None:
        try:
            for frame in self.recording:
                if not self.recording.live:
                    self._wait_until(start_time + frame.time)
                if self._stopped:
                    break
                if frame.image is not None:
                    self._enqueue(frame)
        except Exception as error:  # is raised where the pairs are read
            self.error = error
        with self._changed:
            self._ended = True
            self._changed.notify()

    def _wait_until(self, moment: float) -> None:
        while not self._stopped and (left := moment - time.monotonic()) > 0:
            time.sleep(min(left, STOP_POLL_INTERVAL_S))

    def _enqueue(self, frame: CameraFrame) -> None:
        with self._changed:
            if np.isfinite(self._last):
                self._intervals.append(frame.time - self._last)
                self.interval = median(self._intervals)
            self._last = frame.time
            if len(self._waiting) == MAX_QUEUED_FRAMES:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((frame, time.monotonic()))
            self._changed.notify()


def _clock_offset(left: LiveCamera, right: LiveCamera) -> float:
    """The right view's clock minus the left one's, s; 0 where they share one, as files do."""
    if not (left.recording.live or right.recording.live):
        return 0.0
    ahead = left.delay_s() - right.delay_s()
    devices = left.recording.device and right.recording.device
    return 0.0 if devices and abs(ahead) < MAX_DELAY_DIFFERENCE_S else ahead


def _pairs(left: LiveCamera, right: LiveCamera, ahead: float) -> Iterator[RawPair]:
    """Pairs of frames that were taken at the same time; frames without a partner are left out."""
    files = not (left.recording.live or right.recording.live)
    one_clock = ahead == 0.0
    tolerance = PAIR_TOLERANCE[not files]
    while (a := left.peek()) is not None and (b := right.peek()) is not None:
        skew = b.time - ahead - a.time
        if abs(skew) <= tolerance * left.interval:
            tolerance = PAIRED_TOLERANCE_FACTOR * PAIR_TOLERANCE[not files]
            left.pop(a)
            right.pop(b)
            assert a.image is not None and b.image is not None
            yield RawPair(a.index, a.time + 0.5 * skew * one_clock, a.image, b.image, skew * one_clock)
        elif skew > 0:
            left.pop(a)
        else:
            right.pop(b)


def undistort_pair(pair: RawPair, rig: StereoRig, before: RawPair | None, rows: slice = ALL_ROWS) -> StereoFrame:
    """``pair`` in ideal pixels, black outside of ``rows``; a duplicate where an image equals that of the pair
    ``before``."""
    left, right = (
        camera.undistort_image(image.astype(np.float32), rows)
        for camera, image in zip(rig.cameras, (pair.left, pair.right), strict=True)
    )
    repeated = before is not None and (
        np.array_equal(pair.left, before.left) or np.array_equal(pair.right, before.right)
    )
    return StereoFrame(pair.index, pair.time, left, right, pair.skew, repeated)
