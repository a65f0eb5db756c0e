"""The pictures of clips as they were recorded, for looking at: opened once, decoded in order, kept a while as JPEG."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.console.safety import check_clip, named_files
from paceline.documents import Clip, load_recorded
from paceline.errors import UnusableInput
from paceline.recordings import StereoRecording, open_recording

Image = NDArray[np.float32]
Stamps = tuple[tuple[Path, int, int], ...]

VIEWS = ("left", "right")
OPEN_AT_ONCE = 4  # clips
KEPT = 96 << 20  # bytes of JPEG
READ_ON = 12  # pairs that are rather decoded on the way than sought anew
QUALITY = 90
THUMBNAIL = 320  # px wide


class Pictures:
    """The pairs of one recording in any order, though fastest forwards; several threads may ask."""

    def __init__(self, clip: Clip) -> None:
        self.clip = clip
        self.recording: StereoRecording = open_recording(clip)
        self._lock = threading.Lock()
        self._streams: list[Iterator[Image | None] | None] = [None, None]
        self._next = [0, 0]  # pair at which each stream stands

    @property
    def frames(self) -> list[int]:
        """The left frames' numbers, which clip.yaml counts by."""
        return [int(i) for i in self.recording.indices]

    def pair_of(self, frame: int) -> int:
        """The place of the left frame ``frame``. Raises UnusableInput where it has no pair."""
        pair = int(np.searchsorted(self.recording.indices, frame))
        if pair >= len(self.recording) or self.recording.indices[pair] != frame:
            raise UnusableInput(f"frame {frame}: is not in the recording")
        return pair

    def picture(self, view: int, frame: int) -> Image:
        """The grey image (H, W), 0–255, of a ``view`` (0 left, 1 right) in ``frame``, as recorded."""
        pair = self.pair_of(frame)
        with self._lock:
            stream = self._streams[view]
            if stream is None or not 0 <= pair - self._next[view] <= READ_ON:
                pairing = self.recording.pairing
                numbers = (pairing.left, pairing.right)[view][pair:].tolist()
                stream = self._streams[view] = self.recording.sources[view].read(numbers)
                self._next[view] = pair
            image = None
            try:
                while self._next[view] <= pair:
                    image = next(stream)
                    self._next[view] += 1
            except BaseException:
                self._streams[view] = None
                raise
        if image is None:
            raise UnusableInput(f"{VIEWS[view]}: frame {frame} cannot be decoded")
        return image


class Gallery:
    """The clips that are being looked at."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lock = threading.Lock()
        self._opened: OrderedDict[Path, tuple[Stamps, Pictures]] = OrderedDict()
        self._jpegs: OrderedDict[tuple[Pictures, int, int], bytes] = OrderedDict()  # view -1: a thumbnail
        self._size = 0

    def open(self, file: Path) -> Pictures:
        """The pictures of a clip.yaml, opened anew when a file of it has changed. Raises UnusableInput."""
        with self._lock:
            known = self._opened.get(file)
            if known is not None and is_unchanged(known[0]):
                self._opened.move_to_end(file)
                return known[1]
        check_clip(self._root, file)
        stamps = stamps_of(named_files(self._root, file))
        pictures = Pictures(load_recorded(file))
        with self._lock:
            self._opened[file] = stamps, pictures
            while len(self._opened) > OPEN_AT_ONCE:
                self._opened.popitem(last=False)
        return pictures

    def jpeg(self, file: Path, view: int, frame: int) -> bytes:
        """One picture as JPEG."""
        key = self.open(file), view, frame
        return self._kept(key) or self._keep(key, _jpeg(key[0].picture(view, frame)))

    def thumbnail(self, file: Path) -> bytes:
        """The first left picture, small, as JPEG."""
        pictures = self.open(file)
        key = pictures, -1, 0
        kept = self._kept(key)
        if kept is not None:
            return kept
        image = pictures.picture(0, pictures.frames[0])
        height = max(round(THUMBNAIL * image.shape[0] / image.shape[1]), 1)
        small = cv2.resize(image, (THUMBNAIL, height), interpolation=cv2.INTER_AREA)
        return self._keep(key, _jpeg(np.asarray(small, np.float32)))

    def _kept(self, key: tuple[Pictures, int, int]) -> bytes | None:
        with self._lock:
            if key in self._jpegs:
                self._jpegs.move_to_end(key)
            return self._jpegs.get(key)

    def _keep(self, key: tuple[Pictures, int, int], jpeg: bytes) -> bytes:
        with self._lock:
            self._size += len(jpeg) - len(self._jpegs.get(key, b""))
            self._jpegs[key] = jpeg
            while self._size > KEPT:
                self._size -= len(self._jpegs.popitem(last=False)[1])
        return jpeg


def stamps_of(files: list[Path]) -> Stamps:
    """What changes when one of ``files`` does: each with its time of change and size, zeros where it is not there."""
    found = []
    for file in files:
        try:
            stat = file.stat()
            found.append((file, stat.st_mtime_ns, stat.st_size))
        except (OSError, ValueError):  # a name with a zero byte
            found.append((file, 0, 0))
    return tuple(found)


def is_unchanged(stamps: Stamps) -> bool:
    """Whether all files are as they were when ``stamps`` were taken."""
    return stamps_of([file for file, _, _ in stamps]) == stamps


def _jpeg(image: Image) -> bytes:
    grey = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1])
