"""The recording of one camera, from files or live: grey frames with their times.

Frames are as recorded, not undistorted. A frame that cannot be decoded is passed on without an image, so that a tracker
can count its time. Memory does not grow with the recording's length.
"""

from __future__ import annotations

import errno
import re
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Full, Queue
from statistics import median
from threading import Thread
from time import monotonic
from typing import Protocol

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.format import Flags
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import Camera
from paceline.errors import UnusableInput
from paceline.processor_cores import max_threads
from paceline.recordings.image_sources import ImageFiles, ImageSource, open_source
from paceline.recordings.time_stamps import MIN_GAP_RATIO
from paceline.verdicts import message

Grey = NDArray[np.uint8]  # (H, W)

MAX_LISTED_NOTICES = 8  # notices of one kind that are listed
MAX_FRAME_INTERVALS = 31  # latest intervals, whose median is the typical one
LIVE_OPTIONS = {"rtsp_flags": "prefer_tcp"}  # of FFmpeg; sources without them ignore them
DEVICE_PROBLEMS = {  # messages for a device where those of the operating system mislead
    errno.EBUSY: "it is in use already",
    errno.EINVAL: "it offers no format that FFmpeg can read",
    errno.ENODEV: "it is no camera that FFmpeg can read",
    errno.ENOTTY: "it is no camera that FFmpeg can read",
    errno.ENOSPC: "its USB bus has no bandwidth left; each camera needs a bus of its own, or smaller pictures",
}
OPEN_TIMEOUT_S, SILENCE_TIMEOUT_S = 15.0, 10.0  # time after which a live source is unreachable, or has ended
MAX_QUEUED_PICTURES = 8  # images received and not yet read; beyond them the source has to wait
STOP_POLL_INTERVAL_S = 0.1  # time between checks for a request to stop


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One frame: ``index`` from 0, ``time`` in seconds, ``image`` (H, W) or None where it cannot be decoded."""

    index: int
    time: float
    image: Grey | None


class CameraSource(Protocol):
    """The location and timing of a chase-camera recording, as in a follow.yaml."""

    @property
    def path(self) -> Path: ...
    @property
    def video(self) -> str: ...
    @property
    def rate(self) -> float | None: ...
    @property
    def rate_override(self) -> bool: ...
    @property
    def bit_depth(self) -> int | None: ...
    @property
    def camera(self) -> Camera: ...


class Feed(Protocol):
    """A source of frames, from files or live."""

    name: str
    notices: list[str]

    def read(self, start: int) -> Iterator[CameraFrame]: ...
    def label(self, frame: int) -> str: ...
    def stop(self) -> None:
        """Ends :meth:`read` before the next frame, also while it waits for one."""
        ...


class CameraRecording:
    """The frames of one camera; iterate it for :class:`CameraFrame` after :class:`CameraFrame`.

    ``total`` is how many there are, None for a live source, which can be iterated once only.
    """

    def __init__(self, camera: Camera, feed: Feed, total: int | None) -> None:
        self.camera = camera
        self.total = total
        self.name = feed.name
        self._feed = feed
        self._missing = _LimitedLines()
        self._gaps = _Gaps()

    @property
    def live(self) -> bool:
        return self.total is None

    @property
    def device(self) -> bool:
        """Whether it is a live camera of this computer, whose time stamps are those of `time.monotonic`."""
        return self.live and _is_device(self.name)

    @property
    def notices(self) -> list[str]:
        """What a user should know about the recording, one plain line each; iterating may add to it."""
        undecoded = [message("frames_undecodable", frames=line) for line in self._missing.lines()]
        return [*self._feed.notices, *undecoded, *self._gaps.notices]

    def stop(self) -> None:
        """Ends the iteration after the present frame, as if the recording ended there; a signal handler may call it."""
        self._feed.stop()

    def __iter__(self) -> Iterator[CameraFrame]:
        return self.frames()

    def frames(self, start: int = 0) -> Iterator[CameraFrame]:
        """The frames from index ``start`` on. Raises UnusableInput, naming the frame, for one of another size."""
        width, height = self.camera.image_size
        steps: deque[float] = deque(maxlen=MAX_FRAME_INTERVALS)
        before: CameraFrame | None = None
        for frame in self._feed.read(start):
            if frame.image is None:
                self._missing.add(self._feed.label(frame.index))
            elif frame.image.shape != (height, width):
                size_text = f"{frame.image.shape[1]} × {frame.image.shape[0]}"
                raise UnusableInput(
                    f"{self._feed.label(frame.index)}: has {size_text} pixels, but the camera has {width} × {height}"
                )
            if before is not None:
                step = frame.time - before.time
                if steps and step > MIN_GAP_RATIO * median(steps):
                    self._gaps.add(before.index, step, median(steps))
                steps.append(step)
            before = frame
            yield frame


def open_camera(clip: CameraSource) -> CameraRecording:
    """The recording that a follow.yaml names: images, a video file, or a live source that PyAV opens.

    An address (``rtsp://…``), a device (``/dev/video0``) or a named pipe is live. Raises UnusableInput for whatever
    can be found out without reading all of it.
    """
    path = Path(clip.video)
    if "://" in clip.video or path.is_char_device() or path.is_fifo():
        if clip.rate_override:
            raise UnusableInput(f"{clip.path}: rate.override: expected a file; a live source may lose frames unseen")
        live = LiveFeed(clip.video, clip.camera.image_size)
        _note_unused_rate(clip, live)
        return CameraRecording(clip.camera, live, None)
    source = open_source(path, clip.bit_depth, clip.rate if clip.rate_override else None)
    if source.times is None:
        if clip.rate is None:
            untimed = (
                "a folder of images needs it" if isinstance(source, ImageFiles) else f"{clip.video} has no time stamps"
            )
            raise UnusableInput(f"{clip.path}: rate: missing; {untimed}")
        times = _frame_counters(source) / clip.rate
    else:
        times = source.times
        _note_unused_rate(clip, source)
    return CameraRecording(clip.camera, FileFeed(source, times), len(source))


def _note_unused_rate(clip: CameraSource, source: ImageSource | Feed) -> None:
    if clip.rate is not None and not clip.rate_override:
        source.notices.append(message("rate_ignored", clip=clip.path, source=f"{source.name} carries its"))


def _frame_counters(images: ImageSource) -> Array:
    """The images' places in the recording (N,), from 0: numbers in their names that skip mean dropped frames."""
    numbers = images.numbers
    if numbers is not None:
        counts = np.array(numbers, float) - numbers[0]
        step = np.diff(counts).min()
        if not (counts % step).any():  # clock readings are no counters
            return np.asarray(counts / step)
    return np.arange(len(images), dtype=float)


class FileFeed:
    """Images or a video file whose frames were taken at ``times`` (N,) seconds."""

    def __init__(self, source: ImageSource, times: Array) -> None:
        self.name = source.name
        self.notices = source.notices
        self.label = source.label
        self._source = source
        self._times = times
        self._stopped = False

    def stop(self) -> None:
        self._stopped = True

    def read(self, start: int) -> Iterator[CameraFrame]:
        numbers = range(start, len(self._times))
        for index, image in zip(numbers, self._images(numbers), strict=True):
            # rounds, unlike a cast
            grey = None if image is None else np.asarray(cv2.convertScaleAbs(image), np.uint8)
            yield CameraFrame(index, float(self._times[index]), grey)
            if self._stopped:
                return

    def _images(self, numbers: Sequence[int]) -> Iterator[NDArray[np.float32] | None]:
        if not isinstance(self._source, ImageFiles):
            yield from self._source.read(numbers)
            return
        for index in numbers:
            try:
                yield from self._source.read([index])
            except UnusableInput:  # one bad file in a long run is passed over, as in a video
                yield None


@dataclass(frozen=True, eq=False)
class _Picture:
    """A received picture: its time stamp in seconds, None where it has none, and the image (H, W), None where it cannot
    be decoded."""

    stamp: float | None
    image: Grey | None


class LiveFeed:
    """A camera or stream that PyAV opens, read once; frames have its own time stamps, or that of their arrival.

    It is received in a thread of its own: while FFmpeg waits for data it does not react to signals, and data that
    arrives while nothing reads would be lost.
    """

    def __init__(self, address: str, size: tuple[int, int]) -> None:
        """Asks a device for pictures of ``size`` (width, height). Raises UnusableInput when the source cannot be opened
        or shows no video."""
        self.name = re.sub(r"//[^/@]*@", "//", address)  # no password in messages
        self.notices: list[str] = []
        self._stopped = False
        try:
            self._container = _open(address, size)
        except UnusableInput:
            raise
        except (av.FFmpegError, OSError, ValueError) as error:
            reason = (
                DEVICE_PROBLEMS.get(getattr(error, "errno", 0)) if _is_device(address) else None
            ) or _describe_error(error)
            raise UnusableInput(f"{self.name}: cannot be opened as a live video ({reason})") from error
        if not self._container.streams.video:
            self._container.close()
            raise UnusableInput(f"{self.name}: shows no video")
        self._untimed = Flags.no_timestamps in Flags(self._container.format.flags)
        if self._untimed:  # FFmpeg would invent times from a guessed rate
            self.notices.append(message("no_time_stamps", source=self.name))

    def label(self, frame: int) -> str:
        return f"{self.name}: frame {frame}"

    def stop(self) -> None:
        self._stopped = True

    def read(self, start: int) -> Iterator[CameraFrame]:
        received: Queue[_Picture | Exception | None] = Queue(MAX_QUEUED_PICTURES)
        Thread(target=self._receive, args=[received], daemon=True).start()
        clock = _MonotonicClock(self.name, self.notices)
        index, start_time = -1, monotonic()
        try:
            while (picture := self._next(received)) is not None:
                damaged = index < 0 and picture.image is None and monotonic() - start_time < SILENCE_TIMEOUT_S
                if picture.stamp is None or damaged:  # as the first ones of many sources
                    continue
                index += 1
                time = clock.read(index, picture.stamp)
                if index >= start:
                    yield CameraFrame(index, time, picture.image)
        finally:
            self.stop()
        if index < 0:
            raise UnusableInput(f"{self.name}: sends no picture that can be decoded and has a time stamp")

    def _next(self, received: Queue[_Picture | Exception | None]) -> _Picture | None:
        """The oldest picture not yet read; None at the end, or after ``SILENCE_TIMEOUT_S`` without one."""
        start_time = monotonic()
        while not self._stopped:
            try:
                picture = received.get(timeout=STOP_POLL_INTERVAL_S)
            except Empty:
                if monotonic() - start_time > SILENCE_TIMEOUT_S:
                    self.notices.append(message("source_silent", source=self.name, limit_s=SILENCE_TIMEOUT_S))
                    return None
                continue
            if isinstance(picture, Exception):
                raise picture
            return picture
        return None

    def _receive(self, received: Queue[_Picture | Exception | None]) -> None:
        def enqueue(picture: _Picture | Exception | None) -> None:
            while not self._stopped:
                try:
                    return received.put(picture, timeout=STOP_POLL_INTERVAL_S)
                except Full:
                    continue

        try:
            for picture in self._pictures():
                enqueue(picture)
                if self._stopped:
                    break
            enqueue(None)
        except Exception as error:  # is raised where it is read
            enqueue(error)
        finally:
            self._container.close()  # ends the connection, which may take a while

    def _pictures(self) -> Iterator[_Picture]:
        stream = self._container.streams.video[0]
        stream.codec_context.thread_count = max_threads()
        stream.thread_type = "SLICE"  # frame-parallel decoding would delay every frame
        packets = self._container.demux(stream)
        start_time = monotonic()
        while True:
            try:
                packet = next(packets)
                arrival = monotonic() - start_time
            except StopIteration:
                self.notices.append(message("source_ended", source=self.name, problem=""))
                return
            except (av.FFmpegError, OSError) as error:
                if not self._stopped:
                    problem = f" ({_describe_error(error)})"
                    self.notices.append(message("source_ended", source=self.name, problem=problem))
                return
            try:
                for picture in packet.decode():
                    if isinstance(picture, av.VideoFrame):
                        stamp = arrival if self._untimed else picture.time
                        yield _Picture(stamp, None if picture.is_corrupt else _grey(picture))
            except av.FFmpegError:
                stamp_s = (
                    None if packet.pts is None or packet.time_base is None else float(packet.pts * packet.time_base)
                )
                yield _Picture(arrival if self._untimed else stamp_s, None)


def _is_device(address: str) -> bool:
    return Path(address).is_char_device()


def _open(address: str, size: tuple[int, int]) -> InputContainer:
    """Opens the ``address`` with FFmpeg, in a thread of its own: without end, and without reacting to signals, it may
    wait for the first picture of a device or for the writer of a pipe."""
    answer: Queue[InputContainer | Exception] = Queue()

    def ask() -> None:
        try:
            if _is_device(address):
                answer.put(_open_device(address, size))
            else:
                answer.put(av.open(address, options=LIVE_OPTIONS, timeout=(OPEN_TIMEOUT_S, 2 * SILENCE_TIMEOUT_S)))
        except Exception as error:  # is raised by the caller
            answer.put(error)

    Thread(target=ask, daemon=True).start()
    try:
        opened = answer.get(timeout=None if "://" in address else OPEN_TIMEOUT_S)
    except Empty:
        raise TimeoutError(errno.ETIMEDOUT, f"no answer within {OPEN_TIMEOUT_S:.0f} s") from None
    if isinstance(opened, Exception):
        raise opened
    return opened


def _open_device(device: str, size: tuple[int, int]) -> InputContainer:
    """A ``device`` that sends pictures of ``size`` (width, height), in the format that FFmpeg prefers or else as JPEG:
    many offer their larger ones only so. Raises UnusableInput when it offers other sizes only."""
    size_text, offered_sizes = "{} × {}".format(*size), ""
    for preferred in {}, {"input_format": "mjpeg"}:
        # as mere "options" they would be the decoder's, too, which then takes pictures of any size for those
        options = {"video_size": size_text.replace(" × ", "x"), **preferred}
        try:
            container = av.open(device, format="v4l2", container_options=options)
        except (av.FFmpegError, OSError):
            if offered_sizes:
                break
            raise
        video = container.streams.video[0]
        if (video.width, video.height) == size:
            return container
        offered_sizes = offered_sizes or f"{video.width} × {video.height}"
        container.close()
    raise UnusableInput(
        f"{device}: offers {offered_sizes} pixels where {size_text} are asked for; "
        "expected the image_size of its calibration"
    )


def _describe_error(error: Exception) -> str:
    """FFmpeg's error for a live source as text."""
    if isinstance(error, av.error.ExitError):  # PyAV's own time limit
        return f"no answer within {OPEN_TIMEOUT_S:.0f} s"
    return getattr(error, "strerror", None) or "not known to FFmpeg"


class _MonotonicClock:
    """The time of a live source, continued evenly where its time stamps jump back."""

    def __init__(self, name: str, notices: list[str]) -> None:
        self._name, self._notices = name, notices
        self._offset = 0.0
        self._last = -np.inf
        self._step = 0.0

    def read(self, index: int, stamp: float) -> float:
        time = stamp + self._offset
        if time <= self._last:
            back, time = self._last - time, self._last + self._step
            self._offset = time - stamp
            if len(self._notices) < MAX_LISTED_NOTICES:
                self._notices.append(message("times_backward", source=self._name, back_s=back, frame=index))
        elif np.isfinite(self._last):
            self._step = time - self._last
        self._last = time
        return time


def _grey(picture: av.VideoFrame) -> Grey:
    # a copy: what a grey camera shows lies in the driver's memory, which is gone once the device is closed
    return np.array(picture.reformat(format="gray").to_ndarray(), np.uint8)


@dataclass
class _Gaps:
    """The number of gaps between frames, and the longest one: the ``step`` (s) from frame ``index`` to the next, where
    it is the ``usual_step`` before."""

    count: int = 0
    index: int = -1
    step: float = 0.0
    usual_step: float = 0.0
    latest: int = -1  # index before the latest gap; of frames that are read again no gap counts twice

    def add(self, index: int, step: float, usual_step: float) -> None:
        if index <= self.latest:
            return
        self.count, self.latest = self.count + 1, index
        if step > self.step:
            self.index, self.step, self.usual_step = index, step, usual_step

    @property
    def notices(self) -> list[str]:
        """One notice of all gaps."""
        if not self.count:
            return []
        others = f"{self.count} gaps, the longest: " if self.count > 1 else ""
        gap = f"{others}frames {self.index} and {self.index + 1} lie {self.step:.3f} s apart"
        return [message("frames_missing", gap=gap, usual_s=self.usual_step)]


@dataclass
class _LimitedLines:
    """The first notices of one kind, and the total number."""

    first: list[str] = field(default_factory=list)
    count: int = 0

    def add(self, line: str) -> None:
        self.count += 1
        if len(self.first) < MAX_LISTED_NOTICES:
            self.first.append(line)

    def lines(self) -> list[str]:
        more = self.count - len(self.first)
        return [*self.first[:-1], f"{self.first[-1]}, and {more} more like it"] if more else self.first
