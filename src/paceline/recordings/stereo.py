"""Stereo recordings: pairs of undistorted grey frames by time.

Each view has a :mod:`source <paceline.recordings.image_sources>` of its own; a :class:`Pairing` pairs their frames and
gives the times at which they were taken. Frames left out and suspected faults are reported in ``notices``.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from paceline.arrays import Array, Image, Indices, Mask
from paceline.cameras import VIEW_NAMES, StereoRig
from paceline.errors import UnusableInput, refuse_pipe_or_device
from paceline.recordings.image_sources import ImageFiles, ImageSource, KeptImages, open_source
from paceline.recordings.time_stamps import MIN_GAP_RATIO, longest_increasing_subsequence
from paceline.verdicts import Message, message

MIN_REPORTED_SKEW_S = 1.1e-3  # skew above that of rounding both views to whole milliseconds
MAX_LISTED_FRAMES = 8  # frames listed in a notice
MAX_INTERVAL_S = 10.0  # between two frames, as for a `rate`
TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """The frames of both cameras at one time.

    ``index`` counts the left view's frames from 0. ``left`` and ``right`` are (H, W) grey on a 0–255 scale in ideal
    pixels, ``time`` and ``skew`` (right minus left) are in seconds. ``duplicate``: a view repeats its previous image.
    """

    index: int
    time: float
    left: Image
    right: Image
    skew: float
    duplicate: bool


@dataclass(frozen=True, eq=False)
class Pairing:
    """The pairing of the two views' frames, N pairs in order of time.

    ``left``, ``right`` (N,) count each view's frames from 0; ``times`` (N,) are midway between the two exposures and
    ``skews`` (N,) right minus left, in seconds; ``interval`` is the usual time between frames; ``notices`` say what was
    left out.
    """

    left: Indices
    right: Indices
    times: Array
    skews: Array
    interval: float
    notices: list[Message] = field(default_factory=list)

    @property
    def numbers(self) -> Indices:
        """The numbers (2, N) of the frames in both views."""
        return np.stack([self.left, self.right])


class StereoSource(Protocol):
    """The location and timing of a stereo recording, as in a clip.yaml."""

    @property
    def path(self) -> Path: ...
    @property
    def left(self) -> Path: ...
    @property
    def right(self) -> Path: ...
    @property
    def rate(self) -> float | None: ...
    @property
    def rate_override(self) -> bool: ...
    @property
    def times(self) -> Path | None: ...
    @property
    def tolerance(self) -> float | None: ...
    @property
    def bit_depth(self) -> int | None: ...
    @property
    def rig(self) -> StereoRig: ...


class StereoFrames(Protocol):
    """Frames of a rig and their notices, to be iterated as often as needed."""

    @property
    def indices(self) -> Indices: ...
    @property
    def notices(self) -> list[str]: ...
    def __len__(self) -> int: ...
    def frames(self) -> Iterator[StereoFrame]: ...


class StereoRecording:
    """Pairs of frames of a rig; iterate it, as often as needed, for :class:`StereoFrame` after :class:`StereoFrame`.

    Memory does not grow with its length beyond that of `KeptImages`. ``rotations`` (N, 2, 3) are rotation vectors (rad)
    by which each camera has turned in each frame, which the frames are freed from; None where they are stationary.
    """

    def __init__(
        self,
        rig: StereoRig,
        left: ImageSource,
        right: ImageSource,
        pairing: Pairing,
        rotations: Array | None = None,
    ) -> None:
        """Raises UnusableInput when the first images do not have the rig's size."""
        self.rig = rig
        self.pairing = pairing
        self.rotations = rotations
        self._sources = left, right
        self._repeated: tuple[set[int], set[int]] = set(), set()
        self._damaged: tuple[set[int], set[int]] = set(), set()
        for side in (0, 1):
            image = next(self._sources[side].read([0]))
            if image is None:
                raise UnusableInput(f"{self._sources[side].label(0)}: cannot be decoded")
            self._check_size(side, 0, image)

    def __len__(self) -> int:
        return len(self.pairing.times)

    def __iter__(self) -> Iterator[StereoFrame]:
        return self.frames()

    def corrected(self, offset: float | Array, rotations: Array | None) -> StereoRecording:
        """The same with the right exposures ``offset`` s later, or each by its own (N,), and freed from ``rotations``
        (N, 2, 3)."""
        times, skews = self.pairing.times + offset / 2, self.pairing.skews + offset
        pairing = replace(self.pairing, times=times, skews=skews)
        return StereoRecording(self.rig, *self._sources, pairing, rotations)

    def with_lag(self, lag: float) -> StereoRecording:
        """Two videos paired anew, the right exposures ``lag`` s later than their time stamps say.

        Raises UnusableInput where no frames are then of about the same time.
        """
        left, right = (source.times for source in self._sources)
        assert left is not None and right is not None
        pairing = pair_by_time(left, right + lag, self.pairing.interval / 2)
        pairing.notices.extend(_gap_notices(pairing))
        return StereoRecording(self.rig, *self._sources, pairing)

    def view(self, side: int, numbers: Sequence[int]) -> Iterator[Image | None]:
        """Pictures of one view, free of distortion, by their ``numbers`` in its file (increasing); None for one that
        cannot be decoded."""
        for image in self._sources[side].read(numbers):
            yield None if image is None else self.rig.cameras[side].undistort_image(image)

    def retimed(self, times: Array, selection: Mask) -> StereoRecording:
        """The same with its pairs taken at ``times`` (N,) s, and only those that are in the ``selection`` (N,)."""
        p = self.pairing
        pairing = replace(
            p, left=p.left[selection], right=p.right[selection], times=times[selection], skews=p.skews[selection]
        )
        rotations = None if self.rotations is None else self.rotations[selection]
        return StereoRecording(self.rig, *self._sources, pairing, rotations)

    @property
    def sources(self) -> tuple[ImageSource, ImageSource]:
        """The left and the right recording, distorted."""
        return self._sources

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the left view, pixels."""
        return self.rig.left.image_size

    @property
    def indices(self) -> Indices:
        """The frames' ``index`` (N,)."""
        return self.pairing.left

    @property
    def times(self) -> Array:
        """Seconds (N,), midway between the two exposures."""
        return self.pairing.times

    @property
    def skews(self) -> Array:
        """Right minus left, seconds (N,)."""
        return self.pairing.skews

    @property
    def notices(self) -> list[str]:
        """What a user should know about the recording, one plain line each; iterating may add to it."""
        messages: list[str] = rig_notices(self.rig)
        messages += [*self._sources[0].notices, *self._sources[1].notices, *self.pairing.notices]
        for source, repeated, damaged in zip(self._sources, self._repeated, self._damaged, strict=True):
            if damaged:
                messages.append(message("frames_undecodable", frames=f"{source.name}: {_format_frames(damaged)}"))
            if repeated:
                frames = counted_frames(repeated)
                messages.append(message("frames_repeated", source=source.name, frames=frames))
        return messages

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[StereoFrame]:
        """The frames with ``start`` ≤ index < ``stop``. Raises UnusableInput, naming the file, for one that is bad."""
        last = len(self) if stop is None else int(np.searchsorted(self.indices, stop))
        return self._frames_at(range(int(np.searchsorted(self.indices, start)), last))

    def selected(self, indices: Indices) -> Iterator[StereoFrame]:
        """The frames with these ``indices`` (N,), increasing, in one pass that decodes no more than it has to. Raises
        UnusableInput as `frames`."""
        return self._frames_at(np.searchsorted(self.indices, indices).tolist())

    def _frames_at(self, places: Sequence[int]) -> Iterator[StereoFrame]:
        """The frames at these ``places``, increasing, among the pairs."""
        selection = set(places)
        chosen = sorted(selection | {place - 1 for place in places if place})  # earlier ones, to recognise copies
        numbers = self.pairing.left[chosen].tolist(), self.pairing.right[chosen].tolist()
        previous: list[Image | None] = [None, None]
        views = [source.read(view_numbers) for source, view_numbers in zip(self._sources, numbers, strict=True)]
        for i, (k, *images) in enumerate(zip(chosen, *views, strict=True)):
            ideal, duplicate = [], False
            for side, image in enumerate(images):
                frame = numbers[side][i]
                if image is None:
                    self._damaged[side].add(frame)
                    continue
                self._check_size(side, frame, image)
                if k in selection:
                    if _is_copy(image, previous[side]):
                        self._repeated[side].add(frame)
                        duplicate = True
                    rotation = None if self.rotations is None else self.rotations[k, side]
                    ideal.append(self.rig.cameras[side].undistort_image(image, rotation=rotation))
                previous[side] = image
            if len(ideal) == 2:
                time, skew = float(self.times[k]), float(self.skews[k])
                yield StereoFrame(numbers[0][i], time, ideal[0], ideal[1], skew, duplicate)

    def _check_size(self, side: int, frame: int, image: Image) -> None:
        width, height = self.rig.cameras[side].image_size
        if image.shape != (height, width):
            raise UnusableInput(
                f"{self._sources[side].label(frame)}: has {image.shape[1]} × {image.shape[0]} pixels, but the rig's "
                f"{('left', 'right')[side]} camera has {width} × {height}"
            )


def open_recording(clip: StereoSource) -> StereoRecording:
    """The recording of a clip. Raises UnusableInput for every problem that shows without reading all of it."""
    video_rate = clip.rate if clip.rate_override else None
    left, right = (open_source(path, clip.bit_depth, video_rate) for path in (clip.left, clip.right))
    if clip.times is not None:
        pairing = pair_by_time(*read_times(clip.times, len(left), len(right)), clip.tolerance)
    elif left.times is None and right.times is None:
        if clip.rate is None:
            untimed = "folders of images need it" if isinstance(left, ImageFiles) else f"{left.name} has no time stamps"
            raise UnusableInput(f"{clip.path}: rate: missing; {untimed}, or times")
        pairing = pair_images(left, right, clip.rate)
    elif left.times is None or right.times is None:
        source = left if left.times is None else right
        raise UnusableInput(
            f"{clip.path}: {source.name} has no time stamps, the other view has; expected times for both"
        )
    else:
        pairing = pair_by_time(left.times, right.times, clip.tolerance)
        right.notices.extend(_start_notices(left, right, pairing.interval))
        if clip.rate is not None and not clip.rate_override:
            left.notices.append(message("rate_ignored", clip=clip.path, source="the videos carry their"))
    pairing.notices.extend(_gap_notices(pairing))
    return StereoRecording(clip.rig, KeptImages(left), KeptImages(right), pairing)


def rig_notices(rig: StereoRig) -> list[str]:
    """That the rig was corrected since its calibration, if so."""
    return [message("rig_corrected", points=rig.scene_points)] if rig.scene_points else []


def pair_by_time(left: Array, right: Array, tolerance: float | None = None) -> Pairing:
    """Pairs the frames taken at ``left`` (N,) and ``right`` (M,) seconds that are each other's nearest.

    Frames whose times do not increase with the others' are left out. At most ``tolerance`` seconds may lie between the
    two of a pair, a quarter of the median frame interval by default. Raises UnusableInput when no two frames are that
    near.
    """
    ordered = [np.flatnonzero(longest_increasing_subsequence(times)) for times in (left, right)]
    notices = [*_restamped("left", left, ordered[0]), *_restamped("right", right, ordered[1])]
    a, b = left[ordered[0]], right[ordered[1]]
    interval = float(np.median(np.concatenate([np.diff(a), np.diff(b)])))
    if tolerance is None:
        tolerance = 0.25 * interval
    to_right, to_left = _nearest(a, b), _nearest(b, a)
    mutual = (to_left[to_right] == np.arange(len(a))) & (np.abs(b[to_right] - a) <= tolerance + 1e-9)
    i, j = ordered[0][mutual], ordered[1][to_right[mutual]]
    if not len(i):
        raise UnusableInput(
            f"left and right: no two frames lie within {1e3 * tolerance:.3g} ms of each other "
            f"(left {a[0]:.3f} to {a[-1]:.3f} s, right {b[0]:.3f} to {b[-1]:.3f} s)"
        )
    within = f"within {1e3 * tolerance:.3g} ms"
    notices += [*_unmatched("left", ordered[0], i, within), *_unmatched("right", ordered[1], j, within)]
    skews = right[j] - left[i]
    if np.abs(skews).max() > MIN_REPORTED_SKEW_S:
        median, largest = 1e3 * float(np.median(skews)), 1e3 * float(np.abs(skews).max())
        skew = f"{median:+.1f} ms from the left ones (median; at most {largest:.1f} ms)"
        notices.append(message("views_skewed", frames="right frames", skew=skew))
    return Pairing(i, j, (left[i] + right[j]) / 2, skews, interval, notices)


def pair_images(left: ImageSource, right: ImageSource, rate: float) -> Pairing:
    """Pairs images taken at ``rate`` frames per second by the frame numbers in their names, or else in order.

    Numbers that skip mean dropped frames. Equally many images that skip alike are paired in order, whatever number
    each view begins with. Raises UnusableInput when the counts differ and the pairs cannot be determined.
    """
    numbers = _frame_counters(left.numbers, right.numbers)
    if numbers is None:
        if len(left) != len(right):
            raise UnusableInput(
                f"{left.name} has {len(left)} images and {right.name} {len(right)}; expected as many, or frame numbers "
                "in their names that tell which belong together"
            )
        i = np.arange(len(left))
        notices: list[Message] = []
        if left.numbers is not None:
            notices.append(message("frame_numbers_no_counters", source=left.name))
        return Pairing(i, i, i / rate, np.zeros(len(i)), 1 / rate, notices)
    n, m = numbers
    if len(n) == len(m) and np.array_equal(n - n[0], m - m[0]):
        i = j = np.arange(len(n))
        notices = [] if n[0] == m[0] else [message("frame_numbers_offset", left=n[0], right=m[0])]
    else:
        common, i, j = np.intersect1d(n, m, assume_unique=True, return_indices=True)
        if not len(common):
            raise UnusableInput(f"{left.name} and {right.name}: no two images have the same number in their names")
        notices = [
            *_unmatched("left", np.arange(len(n)), i, "of the same number"),
            *_unmatched("right", np.arange(len(m)), j, "of the same number"),
        ]
    return Pairing(i, j, (n[i] - n[0]) / rate, np.zeros(len(i)), 1 / rate, notices)


def read_times(path: Path, left: int, right: int) -> tuple[Array, Array]:
    """The columns left_s and right_s, in seconds, of a times.csv for ``left`` and ``right`` frames.

    Raises UnusableInput, naming the row, for anything but numbers, and for columns of which no two increase.
    """
    refuse_pipe_or_device(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if row]
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise UnusableInput(f"{path}: is not a table of comma-separated text") from error
    header = [name.strip() for name in rows[0]] if rows else []
    if header[:3] != ["frame", "left_s", "right_s"]:
        raise UnusableInput(f"{path}: the first line reads {','.join(header)!r}; expected 'frame,left_s,right_s'")
    if not left == right == len(rows) - 1:
        raise UnusableInput(
            f"{path}: has {len(rows) - 1} rows, but there are {left} left and {right} right images; expected one each"
        )
    values = np.empty((len(rows) - 1, 3))
    for i, row in enumerate(rows[1:]):
        try:
            values[i] = [float(cell) for cell in row[:3]]
        except ValueError:
            raise UnusableInput(f"{path}: frame {i}: {','.join(row)!r}; expected three numbers") from None
        if not np.isfinite(values[i]).all():
            raise UnusableInput(f"{path}: frame {i}: {','.join(row)!r}; expected finite numbers")
        if values[i, 0] != i:
            raise UnusableInput(f"{path}: frame {row[0]} stands where frame {i} is expected")
    for side, times in zip(VIEW_NAMES, values[:, 1:].T, strict=True):
        if not (np.diff(times) > 0).any():
            raise UnusableInput(f"{path}: {side}_s: the times do not increase")
    interval = float(np.median(np.diff(values[:, 1]))) if len(values) > 1 else 0.0
    if interval > MAX_INTERVAL_S:
        unit = next((name for name, size in TIME_UNITS.items() if interval * size <= MAX_INTERVAL_S), "another unit")
        raise UnusableInput(
            f"{path}: two frames are {interval:g} apart; expected seconds, {MAX_INTERVAL_S:g} at the most "
            f"(are these {unit}?)"
        )
    return values[:, 1].copy(), values[:, 2].copy()


def _frame_counters(left: list[int] | None, right: list[int] | None) -> tuple[Indices, Indices] | None:
    """The numbers in units of their common step, or None if they are no counters.

    Counters rise by multiples of their smallest step; clock readings in file names do not.
    """
    if left is None or right is None:
        return None
    steps = [b - a for side in (left, right) for a, b in zip(side, side[1:], strict=False)]
    step = min(steps)
    if any(s % step for s in steps):
        return None
    a, b = (np.array([n // step for n in side], np.int64) for side in (left, right))
    return a, b


def _nearest(times: Array, among: Array) -> Indices:
    """Indices (N,) of the nearest of ``among`` (M ≥ 2,) for each of ``times`` (N,); both increase."""
    after = np.clip(np.searchsorted(among, times), 1, len(among) - 1)
    return np.asarray(after - (times - among[after - 1] < among[after] - times), np.int64)


def _gap_notices(pairing: Pairing) -> list[Message]:
    """One notice of all gaps between the pairs."""
    steps, interval = np.diff(pairing.times), pairing.interval
    gaps = np.flatnonzero(steps > MIN_GAP_RATIO * interval)
    if not len(gaps):
        return []
    dropped = int(np.sum(np.round(steps[gaps] / interval) - 1))
    k = gaps[np.argmax(steps[gaps])]
    places = f"in {len(gaps)} places, most " if len(gaps) > 1 else ""
    gap = (
        f"{dropped} dropped {places}between frames {pairing.left[k]} and {pairing.left[k + 1]}: {steps[k]:.3f} s lie "
        "between them"
    )
    return [message("frames_missing", gap=gap, usual_s=interval)]


def _start_notices(left: ImageSource, right: ImageSource, interval: float) -> list[Message]:
    """That the time stamps of the two views begin more than an ``interval`` (s) apart, if so."""
    assert left.times is not None and right.times is not None
    delay = float(right.times[0] - left.times[0])
    if abs(delay) <= MIN_GAP_RATIO * interval:
        return []
    delay_text = f"{abs(delay):.3f} s {'after' if delay > 0 else 'before'}"
    return [message("views_start_apart", right=right.name, delay=delay_text, left=left.name)]


def _restamped(side: str, times: Array, ordered: Indices) -> list[Message]:
    unordered = np.setdiff1d(np.arange(len(times)), ordered)
    return [message("frames_restamped", video=side, frames=_format_frames(unordered))] if len(unordered) else []


def _unmatched(side: str, frames: Indices, matched: Indices, criterion: str) -> list[Message]:
    unmatched = np.setdiff1d(frames, matched)
    other = "right" if side == "left" else "left"
    if not len(unmatched):
        return []
    return [message("frames_unmatched", view=side, frames=counted_frames(unmatched), other=other, match=criterion)]


def _format_frames(frames: set[int] | Indices) -> str:
    numbers = sorted(int(f) for f in frames)
    listed = ", ".join(map(str, numbers[:MAX_LISTED_FRAMES]))
    more = f" and {len(numbers) - MAX_LISTED_FRAMES} more" if len(numbers) > MAX_LISTED_FRAMES else ""
    return f"frame{'s' * (len(numbers) > 1)} {listed}{more}"


def counted_frames(frames: set[int] | Indices) -> str:
    """The subject and the verb of a sentence about ``frames``."""
    return f"{_format_frames(frames)} {'is' if len(frames) == 1 else 'are'}"


def _is_copy(image: Image, previous: Image | None) -> bool:
    return previous is not None and np.array_equal(image, previous)
