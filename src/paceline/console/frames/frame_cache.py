"""Cache of decoded frames for display: recordings are opened once, decoded in order, frames kept as JPEG."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.cameras import VIEW_NAMES, Camera
from paceline.console.confinement import NotFound, check_document, named_files
from paceline.console.document_references import PartialFollowModel, is_follow, live_views, read_cached
from paceline.documents.loading import Clip, load_camera, load_clip_recording
from paceline.errors import UnusableInput
from paceline.recordings.image_sources import ImageSource, open_source
from paceline.recordings.stereo import StereoRecording, open_recording

Numbers = NDArray[np.int64]
FileStamps = tuple[tuple[Path, int, int], ...]

MAX_OPEN_CLIPS = 4
MAX_JPEG_BYTES = 96 << 20
MAX_FORWARD_FRAMES = 12  # frames that are decoded one after another; farther ahead the decoder seeks
FRAME_JPEG_QUALITY = 90
THUMBNAIL_WIDTH_PX = 320


class RecordingFrames:
    """Random access to the frames of a recording; fastest forwards, and thread-safe.

    ``frames`` are the frame numbers that its document uses, ``times`` (N,) their seconds; frame k of view v is
    number ``numbers[v][k]`` of ``sources[v]``.
    """

    def __init__(
        self, sources: Sequence[ImageSource], numbers: Sequence[Numbers], frames: Numbers, times: Array
    ) -> None:
        self.frames = [int(i) for i in frames]
        self.times = times
        self._sources, self._numbers = sources, numbers
        self._lock = threading.Lock()
        self._streams: list[Iterator[Image | None] | None] = [None for _ in sources]
        self._next = [0 for _ in sources]  # position of each stream

    @property
    def seconds(self) -> float:
        """Duration of the recording."""
        return float(self.times[-1] - self.times[0]) if len(self.times) else 0.0

    def position_of(self, frame: int) -> int:
        """The position of the ``frame`` in the recording. Raises UnusableInput where there is none."""
        position = int(np.searchsorted(self.frames, frame))
        if position >= len(self.frames) or self.frames[position] != frame:
            raise UnusableInput(f"frame {frame}: is not in the recording")
        return position

    def picture(self, view: int, frame: int) -> Image:
        """The grey image (H, W), 0–255, of a ``view`` (0 left or the only one, 1 right) in ``frame``, as recorded."""
        if view >= len(self._sources):
            raise UnusableInput(f"view {view}: the recording has one view only")
        position = self.position_of(frame)
        with self._lock:
            stream = self._streams[view]
            if stream is None or not 0 <= position - self._next[view] <= MAX_FORWARD_FRAMES:
                stream = self._streams[view] = self._sources[view].read(self._numbers[view][position:].tolist())
                self._next[view] = position
            image = None
            try:
                while self._next[view] <= position:
                    image = next(stream)
                    self._next[view] += 1
            except BaseException:
                self._streams[view] = None
                raise
        if image is None:
            raise UnusableInput(f"{self._name(view)}: frame {frame} cannot be decoded")
        return image

    def _name(self, view: int) -> str:
        return VIEW_NAMES[view] if len(self._sources) > 1 else "video"


class StereoFrames(RecordingFrames):
    """The frames of a clip.yaml's recording, numbered as in the left view."""

    def __init__(self, file: Path) -> None:
        self.clip: Clip = load_clip_recording(file)
        self.recording: StereoRecording = open_recording(self.clip)
        pairing = self.recording.pairing
        super().__init__(
            self.recording.sources, (pairing.left, pairing.right), self.recording.indices, self.recording.times
        )


class ChaseFrames(RecordingFrames):
    """The frames of a follow.yaml's recording."""

    def __init__(self, file: Path) -> None:
        model = read_cached(PartialFollowModel, file)
        self.camera: Camera = load_camera(file.parent / model.camera)
        rate = None if model.rate is None else model.rate.value
        video_rate = rate if model.rate is not None and model.rate.override else None
        source = open_source(file.parent / model.video, model.bit_depth, video_rate)
        if source.times is None and rate is None:
            raise UnusableInput(f"{file}: rate: missing; a folder of images needs it")
        numbers = np.arange(len(source))
        times = numbers / (rate or 1.0) if source.times is None else source.times
        self.notices = source.notices
        first = next(iter(source.read([0])), None)
        if first is not None and first.shape != self.camera.image_size[::-1]:
            width, height = self.camera.image_size
            first_size = f"{first.shape[1]} × {first.shape[0]}"
            raise UnusableInput(f"{file}: video: has {first_size} pixels, but the camera has {width} × {height}")
        super().__init__([source], [numbers], numbers, times)


class FrameCache:
    """The opened clips below the folder ``root``, and JPEGs of their frames."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lock = threading.Lock()
        self._opened: OrderedDict[Path, tuple[FileStamps, StereoFrames | ChaseFrames]] = OrderedDict()
        self._jpegs: OrderedDict[tuple[RecordingFrames, int, int], bytes] = OrderedDict()  # view -1: a thumbnail
        self._size = 0

    def stereo(self, file: Path) -> StereoFrames:
        """The frames of a clip.yaml. Raises UnusableInput, NotFound for another document."""
        pictures = self.open(file)
        if not isinstance(pictures, StereoFrames):
            raise NotFound(file.name)
        return pictures

    def chase(self, file: Path) -> ChaseFrames:
        """The frames of a follow.yaml. Raises UnusableInput, NotFound for another document."""
        pictures = self.open(file)
        if not isinstance(pictures, ChaseFrames):
            raise NotFound(file.name)
        return pictures

    def open(self, file: Path) -> StereoFrames | ChaseFrames:
        """The frames of a clip.yaml or follow.yaml, reopened once a file has changed. Raises UnusableInput."""
        with self._lock:
            known = self._opened.get(file)
            if known is not None and is_unchanged(known[0]):
                self._opened.move_to_end(file)
                return known[1]
        check_document(self._root, file)
        if views := live_views(file):
            raise UnusableInput(f"{file}: {views[0]} is a live source; its frames are not shown here")
        stamps = file_stamps(named_files(self._root, file))
        pictures = ChaseFrames(file) if is_follow(file) else StereoFrames(file)
        with self._lock:
            self._opened[file] = stamps, pictures
            while len(self._opened) > MAX_OPEN_CLIPS:
                self._opened.popitem(last=False)
        return pictures

    def jpeg(self, file: Path, view: int, frame: int) -> bytes:
        """One frame as JPEG."""
        key = self.open(file), view, frame
        return self._cached(key) or self._store(key, _encode_jpeg(key[0].picture(view, frame)))

    def thumbnail(self, file: Path) -> bytes:
        """The first frame of the left view, THUMBNAIL_WIDTH_PX wide, as JPEG."""
        pictures = self.open(file)
        key = pictures, -1, 0
        cached = self._cached(key)
        if cached is not None:
            return cached
        image = pictures.picture(0, pictures.frames[0])
        height = max(round(THUMBNAIL_WIDTH_PX * image.shape[0] / image.shape[1]), 1)
        small = cv2.resize(image, (THUMBNAIL_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        return self._store(key, _encode_jpeg(np.asarray(small, np.float32)))

    def _cached(self, key: tuple[RecordingFrames, int, int]) -> bytes | None:
        with self._lock:
            if key in self._jpegs:
                self._jpegs.move_to_end(key)
            return self._jpegs.get(key)

    def _store(self, key: tuple[RecordingFrames, int, int], jpeg: bytes) -> bytes:
        with self._lock:
            self._size += len(jpeg) - len(self._jpegs.get(key, b""))
            self._jpegs[key] = jpeg
            while self._size > MAX_JPEG_BYTES:
                self._size -= len(self._jpegs.popitem(last=False)[1])
        return jpeg


def file_stamps(files: list[Path]) -> FileStamps:
    """Modification time and size of each of ``files``, zeros where it does not exist."""
    stamps = []
    for file in files:
        try:
            stat = file.stat()
            stamps.append((file, stat.st_mtime_ns, stat.st_size))
        except (OSError, ValueError):  # a name with a zero byte
            stamps.append((file, 0, 0))
    return tuple(stamps)


def is_unchanged(stamps: FileStamps) -> bool:
    """Whether no file has changed since ``stamps`` were taken."""
    return file_stamps([file for file, _, _ in stamps]) == stamps


def _encode_jpeg(image: Image) -> bytes:
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, FRAME_JPEG_QUALITY])[1])
