"""The recording of one camera: numbered images or a video, read in order as grey images on a 0–255 scale."""

from __future__ import annotations

import glob
import re
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import av
import cv2
import numpy as np
from av.format import Flags
from numpy.typing import NDArray

from paceline.arrays import Array, Image
from paceline.errors import UnusableInput, refuse_pipe_or_device
from paceline.processor_cores import max_threads
from paceline.recordings.time_stamps import longest_increasing_subsequence
from paceline.verdicts import message, plural

StoredImage = NDArray[Any]  # uint8 or uint16

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp"}
MAX_KEPT_BYTES = 128 << 20  # of a view, 42 images of 1024 × 768
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


class ImageSource(Protocol):
    """One view of a recording."""

    name: str
    notices: list[str]
    times: Array | None  # (N,) seconds; None where the source carries none

    @property
    def numbers(self) -> list[int] | None:
        """The frames' own numbers, rising; None where they have none."""
        ...

    def __len__(self) -> int: ...

    def read(self, frames: Sequence[int]) -> Iterator[Image | None]:
        """The images (H, W), 0–255, of ``frames`` (increasing); None for a video's frame that cannot be decoded."""
        ...

    def label(self, frame: int) -> str:
        """The name of this frame in messages."""
        ...


def open_source(path: Path, bit_depth: int | None = None, video_rate: float | None = None) -> ImageSource:
    """The images of a folder, the images that a pattern (``left/*.png``, ``left/%04d.png``) matches, or a video.

    ``bit_depth`` is how many bits of 16-bit images are used (all 16 by default); ``video_rate``, in frames per second,
    is used in place of a video's own time stamps. Raises UnusableInput where there is nothing to read.
    """
    if path.is_dir():
        files = [p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and not p.name.startswith(".")]
        return ImageFiles(str(path), files, bit_depth)
    if path.exists():
        refuse_pipe_or_device(path)
        return VideoFile(path, bit_depth, video_rate)
    pattern = re.sub(r"%0(\d+)d", lambda m: "[0-9]" * int(m[1]), str(path))
    if glob.has_magic(pattern):
        return ImageFiles(str(path), [Path(p) for p in glob.glob(pattern)], bit_depth)
    raise UnusableInput(f"{path}: no such file or folder; expected a folder of images, a pattern or a video")


class ImageFiles:
    """Image files in natural order of their names (2 before 10)."""

    def __init__(self, name: str, files: Sequence[Path], bit_depth: int | None = None) -> None:
        if len(files) < 2:
            raise UnusableInput(f"{name}: {['no images', 'only one image'][len(files)]}; expected at least two")
        self.name = name
        self.files = sorted(files, key=lambda p: [int(t) if t.isdecimal() else t for t in re.split(r"(\d+)", p.name)])
        self.times: Array | None = None
        self.notices: list[str] = []
        self._bit_depth = bit_depth
        first = read_image_file(self.files[0])
        if first.dtype == np.uint16 and bit_depth is None and first.max() < 65536 // 16:
            self.notices.append(message("bit_depth_suspect", image=self.label(0)))
        if first.dtype == np.uint8 and bit_depth not in (None, 8):
            self.notices.append(message("bit_depth_ignored", source=name, bit_depth=bit_depth))

    def __len__(self) -> int:
        return len(self.files)

    def label(self, frame: int) -> str:
        return str(self.files[frame])

    @property
    def numbers(self) -> list[int] | None:
        """The numbers in the files' names, their last run of digits; None unless every name has one, rising."""
        digits = [re.findall(r"\d+", p.stem) for p in self.files]
        if not all(digits):
            return None
        numbers = [int(d[-1]) for d in digits]
        return numbers if all(a < b for a, b in zip(numbers, numbers[1:], strict=False)) else None

    def read(self, frames: Sequence[int]) -> Iterator[Image | None]:
        for frame in frames:
            image = read_image_file(self.files[frame])
            yield to_grey(image, 16 if self._bit_depth is None else self._bit_depth, self.label(frame))


class KeptImages:
    """A ``source`` whose images are decoded once, and kept where all of them take at most `MAX_KEPT_BYTES`."""

    def __init__(self, source: ImageSource) -> None:
        self._source = source
        self._images: dict[int, Image] = {}
        self.name, self.notices, self.times = source.name, source.notices, source.times

    def __len__(self) -> int:
        return len(self._source)

    @property
    def numbers(self) -> list[int] | None:
        return self._source.numbers

    def label(self, frame: int) -> str:
        return self._source.label(frame)

    def read(self, frames: Sequence[int]) -> Iterator[Image | None]:
        if all(frame in self._images for frame in frames):
            yield from (self._images[frame] for frame in frames)
            return
        for frame, image in zip(frames, self._source.read(frames), strict=True):
            if image is not None and image.nbytes * len(self) <= MAX_KEPT_BYTES:
                self._images[frame] = image
            yield image


class VideoFile:
    """A video file, timed by its presentation time stamps (never by its frame rate).

    Where it carries none, as raw H.264 and MJPEG streams do, its frames are numbered and its ``times`` None. Frames
    whose time stamps repeat or are out of order are left out. With a ``rate``, in frames per second, all frames
    count, whatever their time stamps, and are timed by it.
    Opening it reads the packets' time stamps, and decodes only what follows the last key frame to find out whether the
    file is cut short.
    """

    def __init__(self, path: Path, bit_depth: int | None = None, rate: float | None = None) -> None:
        self.name = str(path)
        self.notices: list[str] = []
        self._path = path
        self._bit_depth = bit_depth
        self._seekable = True  # to key frames; not where only the decoder gives time stamps
        self._threads = "SLICE"  # frame-parallel decoding loses a varying number of frames at a damaged end
        self._is_timed = True
        self._key_stamps: list[int] = []  # time stamps of key frames to which can be seeked
        self._pts, time_base = self._scan(stamps_matter=rate is None)
        self.times: Array | None = np.array([float(p * time_base) for p in self._pts]) if self._is_timed else None
        if rate is not None:
            if self.times is not None:
                usual_s = float(np.median(np.diff(self.times)))
                self.notices.append(message("rate_overrides", video=self.name, rate=rate, usual_s=usual_s))
            self.times = np.arange(len(self._pts)) / rate

    def __len__(self) -> int:
        return len(self._pts)

    @property
    def numbers(self) -> list[int] | None:
        return None

    def label(self, frame: int) -> str:
        return f"{self.name}: frame {frame}"

    def read(self, frames: Sequence[int]) -> Iterator[Image | None]:
        for span in self._spans(frames):
            yield from self._read_span(span)

    def _spans(self, frames: Sequence[int]) -> Iterator[Sequence[int]]:
        """Parts of ``frames`` between which all pictures from one key frame to another can be left out."""
        before = np.searchsorted(self._key_stamps, [self._pts[f] for f in frames], "right")  # key frames until each
        starts = [0, *(np.flatnonzero(np.diff(before) > 1) + 1).tolist(), len(frames)]
        for start, stop in pairwise(starts):
            yield frames[start:stop]

    def _read_span(self, frames: Sequence[int]) -> Iterator[Image | None]:
        frame_by_pts = {self._pts[f]: f for f in frames}
        order = list(frames)
        for picture in self._decode_from(order[0] if order else 0):
            frame = frame_by_pts.get(picture.pts) if picture.pts is not None else None
            if frame is None or not order or frame < order[0]:  # its time stamp is that of a frame before it
                continue
            while order[0] < frame:
                order.pop(0)
                yield None
            order.pop(0)
            yield self._grey(picture, frame)
            if not order:
                return
        yield from [None] * len(order)

    def _decode_from(self, frame: int) -> Iterator[av.VideoFrame]:
        """Pictures from the key frame at or before ``frame``; from the first where a file cannot be seeked."""
        if frame and self._seekable:
            pictures = self._decode(self._pts[frame])
            first = None
            with suppress(av.FFmpegError):
                first = next(pictures, None)
            if first is not None and first.pts is not None and first.pts <= self._pts[frame]:
                yield first
                yield from pictures
                return
        yield from self._decode()

    def _decode(self, start: int | None = None) -> Iterator[av.VideoFrame]:
        """Whole pictures in presentation order, from the key frame at or before time stamp ``start``."""
        with av.open(self._path) as container:
            stream = container.streams.video[0]
            stream.thread_type, stream.codec_context.thread_count = self._threads, max_threads()
            if start is not None:
                container.seek(start, stream=stream)
            packets, number = container.demux(stream), 0
            while True:
                try:  # a damaged packet loses its own pictures only
                    pictures = next(packets).decode()
                except StopIteration:
                    return
                except av.FFmpegError:
                    continue
                for picture in pictures:
                    if not isinstance(picture, av.VideoFrame):
                        continue
                    if not self._is_timed:
                        picture.pts, number = number, number + 1
                    if not picture.is_corrupt:
                        yield picture

    def _scan(self, stamps_matter: bool) -> tuple[list[int], Fraction]:
        try:
            with av.open(self._path) as container:
                if container.format.name == "tty" or not container.streams.video:
                    raise UnusableInput(f"{self.name}: holds no video")
                stream = container.streams.video[0]
                self._is_timed = Flags.no_timestamps not in Flags(container.format.flags)  # else FFmpeg invents them
                pts, keys, cut, unordered = _packets(container, stream)
                time_base = stream.time_base or Fraction(1, av.time_base)
                stated_end = _stated_end(container, stream)
        except av.FFmpegError as error:
            raise UnusableInput(f"{self.name}: cannot be read as a video ({error.strerror})") from error
        if self._is_timed and None in pts:  # the container numbers its packets only; the decoder may know better
            pts, keys = [picture.pts for picture in self._decode()], []
            self._seekable, self._is_timed = False, None not in pts
        self._is_timed &= stamps_matter or not unordered and len(set(pts)) == len(pts)  # else they tell no frames apart
        if not self._is_timed:
            packets = len(pts) + unordered
            self._seekable, time_base, keys, stated_end, unordered = False, Fraction(1), [], None, 0
            pts = [picture.pts for picture in self._decode()]
            if len(pts) < packets:
                raise UnusableInput(
                    f"{self.name}: {packets - len(pts)} of {packets} pictures cannot be decoded, and without stamps "
                    "that count nothing tells when the others were taken; expected a whole stream, or its time stamps"
                )
        stamps = sorted({p for p in pts if p is not None})
        if left_out := unordered + len(pts) - len(stamps):
            self._seekable = False  # there may be several places of one time stamp
            self.notices.append(message("frames_restamped", video=self.name, frames=plural(left_out, "frame")))
        if keys:
            decodable = {picture.pts for picture in self._decode(keys[-1] if self._seekable else None)}
            if keys[-1] not in decodable:  # not every container can be seeked to a key frame
                decodable = {picture.pts for picture in self._decode()}
            last = max((p for p in decodable if p is not None), default=stamps[0] - 1)
            cut = cut or stamps[-1] > last
            stamps = [p for p in stamps if p <= last]
        if self._seekable:
            self._key_stamps = sorted(keys)
        if len(stamps) < 2:
            raise UnusableInput(f"{self.name}: fewer than two frames can be decoded")
        end = float(stamps[-1] * time_base)
        last_duration = float(max(np.median(np.diff(stamps)), stamps[-1] - stamps[-2]) * time_base)
        if cut or (stated_end is not None and stated_end > end + 1.5 * last_duration):
            self.notices.append(message("video_truncated", video=self.name, frame=len(stamps) - 1, time_s=end))
        else:
            self._threads = "AUTO"
        return stamps, time_base

    def _grey(self, picture: av.VideoFrame, frame: int) -> Image:
        if re.search(r"f(16|32)", picture.format.name):
            raise UnusableInput(f"{self.label(frame)}: holds floating-point pixels; expected integers of 8 to 16 bits")
        if picture.format.name in ("gray", "gray16le"):
            return to_grey(picture.to_ndarray(), 16 if self._bit_depth is None else self._bit_depth, self.label(frame))
        return to_grey(picture.reformat(format="gray16le").to_ndarray(), 16, self.label(frame))


def _packets(
    container: av.container.InputContainer, stream: av.VideoStream
) -> tuple[list[int | None], list[int], bool, int]:
    """The packets' presentation time stamps, those of key frames, whether the packets end too early, and how
    many are left out because they are out of order."""
    pts: list[int | None] = []
    dts: list[int | None] = []
    key_frames: list[bool] = []
    cut = False
    try:
        for packet in container.demux(stream):
            if packet.size and not packet.is_discard:
                pts.append(packet.pts)
                dts.append(packet.dts)
                key_frames.append(packet.is_keyframe)
    except av.FFmpegError:
        cut = True
    selection = _in_order(pts, dts)
    ordered = [p for p, is_ordered in zip(pts, selection, strict=True) if is_ordered]
    keys = [p for p, *chosen in zip(pts, selection, key_frames, strict=True) if all(chosen) and p is not None]
    return ordered, keys, cut or len(pts) < stream.frames, len(pts) - len(ordered)


def _in_order(pts: list[int | None], dts: list[int | None]) -> list[bool]:
    """The packets (N,) that come in the order of their decoding time stamps ``dts``, but for those with the same
    presentation time stamp as one that does not: when pictures are read, these cannot be told apart."""
    known = [k for k, stamp in enumerate(dts) if stamp is not None]
    stamps = [stamp for stamp in dts if stamp is not None]
    selection = [True] * len(pts)
    if all(a <= b for a, b in zip(stamps, stamps[1:], strict=False)):
        return selection
    for k, is_ordered in zip(known, longest_increasing_subsequence(stamps).tolist(), strict=True):
        selection[k] = is_ordered
    passed: set[int | None] = set()  # presentation time stamps of packets out of order so far
    for k, stamp in enumerate(pts):
        if not selection[k]:
            passed.add(stamp)
        selection[k] = selection[k] and stamp not in passed
    return selection


def _stated_end(container: av.container.InputContainer, stream: av.VideoStream) -> float | None:
    """The end of the video in seconds, as the container states it; None where it does not."""
    if stream.duration is not None and stream.time_base is not None:
        return float((stream.duration + (stream.start_time or 0)) * stream.time_base)
    if container.duration is not None and len(container.streams) == 1:
        return float(Fraction(container.duration + (container.start_time or 0), av.time_base))
    return None


def read_image_file(path: Path) -> StoredImage:
    """The image as stored, (H, W) or (H, W, 3) in blue, green, red order, 8 or 16 bits, turned as its EXIF says: as
    every program shows it.

    Raises UnusableInput for a file that is missing, empty, damaged or of another kind.
    """
    refuse_pipe_or_device(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror})") from error
    if not data:
        raise UnusableInput(f"{path}: is empty; expected an image")
    if data.startswith(PNG_SIGNATURE) and not _png_is_whole(data):  # OpenCV returns what it can of a damaged one
        raise UnusableInput(f"{path}: is truncated or damaged; expected a whole image")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR)
    except cv2.error:
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise UnusableInput(f"{path}: is truncated, damaged or not an image")
    if image.dtype not in (np.uint8, np.uint16):
        raise UnusableInput(f"{path}: holds {image.dtype} pixels; expected integers of 8 or 16 bits")
    return image


def _png_is_whole(data: bytes) -> bool:
    """Whether all chunks are present with valid checksums."""
    offset = len(PNG_SIGNATURE)
    while offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        end = offset + 8 + length
        if end + 4 > len(data) or zlib.crc32(data[offset + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            return False
        if kind == b"IEND":
            return True
        offset = end + 4
    return False


def to_grey(image: StoredImage, bits: int, label: str) -> Image:
    """The luma (Rec. 601) of an image as read, as float32 (H, W) on a 0–255 scale; alpha is ignored.

    16-bit images use ``bits`` bits; UnusableInput, naming ``label``, where a value does not fit.
    """
    grey = image.astype(np.float32)
    if grey.ndim == 3:
        grey = np.asarray(cv2.cvtColor(np.ascontiguousarray(grey[:, :, :3]), cv2.COLOR_BGR2GRAY), np.float32)
    if image.dtype == np.uint16:
        full = 2**bits - 1
        if bits < 16 and image.max() > full:
            raise UnusableInput(f"{label}: holds the value {image.max()}, which does not fit in bit_depth {bits}")
        grey *= np.float32(255 / full)
    return grey
