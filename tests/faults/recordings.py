"""Recordings in memory, and what may be wrong with their pictures, their order, their times and their files."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from paceline.simulation.video import write_h264

from .cases import Fault, Visibility

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]
IDENTITY: Array = np.eye(3)[:2]
STEREO = ("speed", "vehicles", "lanes", "live")
MOVING = ("speed", "vehicles", "live", "follow")  # areas whose results depend on time
ALL = (*STEREO, "follow", "calibrate")

FAULTS: list[Fault] = []


@dataclass
class Recording:
    """One or two views of a scene as a recorder leaves them, before they are written.

    ``shown[view][k]`` is the picture of the scene that picture ``k`` of a view shows, and ``transform[view][k]`` (2, 3)
    what has become of its pixels. ``draw`` gives the documents of what a user sees who draws on these pictures.
    """

    names: list[str]  # of the views
    views: list[list[Picture]]
    rate: float  # frames/s
    draw: Callable[[Recording], dict[str, Any]]  # documents by the names of their files
    kept: int = 0  # the picture on which outlines are drawn: it is never dropped
    coding: str = "png"  # png | jpeg | h264 | ffv1
    quality: int = 100  # of JPEG, 0 to 100, or the rate factor of H.264
    stated_rate: float = 0.0  # frames/s, in the documents
    stamps: list[list[float]] | None = None  # s, by view, in times.csv
    exchanged: bool = False  # left is right
    files: list[Callable[[Path], None]] = field(default_factory=list)  # what happens to the written files
    shown: list[list[int]] = field(default_factory=list)
    transform: list[list[Array]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.stated_rate = self.stated_rate or self.rate
        self.shown = self.shown or [list(range(len(view))) for view in self.views]
        self.transform = self.transform or [[IDENTITY] * len(view) for view in self.views]

    def reorder(self, order: list[int], view: int) -> None:
        """Makes picture ``order[k]`` of a ``view`` its picture k."""
        for values in (self.views, self.shown, self.transform):
            values[view] = [values[view][k] for k in order]  # type: ignore[index, assignment]
        if self.stamps is not None:
            self.stamps[view] = [self.stamps[view][min(k, len(self.stamps[view]) - 1)] for k in range(len(order))]

    def warp(self, view: int, matrix: Array, start: int = 0) -> None:
        """Moves the pixels of a ``view`` by a ``matrix`` (2, 3) from picture ``start`` on."""
        whole = np.vstack([matrix, [0, 0, 1]])
        for k in range(start, len(self.views[view])):
            self.transform[view][k] = whole[:2] @ np.vstack([self.transform[view][k], [0, 0, 1]])
            size = self.views[view][k].shape[1::-1]
            self.views[view][k] = cv2.warpAffine(self.views[view][k], matrix, size, borderMode=cv2.BORDER_REFLECT)

    def moved(self, view: int, k: int, points: Any) -> Array:
        """Where ``points`` (N, 2) of the scene's picture are in picture ``k`` of a ``view``."""
        matrix = self.transform[view][k]
        return np.asarray(points) @ matrix[:, :2].T + matrix[:, 2]

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True)
        documents = self.draw(self)
        for name, view in zip(self.names, self.views, strict=True):
            self._write_view(folder, name, view)
        video = self.coding in ("h264", "ffv1")
        for file, document in documents.items():
            main = file in ("clip.yaml", "follow.yaml")
            if main and video:
                keys = ["video"] if file == "follow.yaml" else self.names
                document = {
                    **document,
                    **dict(zip(keys, (f"{name}{self._suffix}" for name in self.names), strict=True)),
                }
                document = {key: value for key, value in document.items() if key != "rate"}
            if main and self.stamps is not None and len(self.names) == 2 and not video:
                document = {key: value for key, value in document.items() if key != "rate"} | {"times": "times.csv"}
                self._write_times(folder)
            if main and self.exchanged:
                document["left"], document["right"] = document["right"], document["left"]
            (folder / file).write_text(yaml.safe_dump(document, sort_keys=False))
        for change in self.files:
            change(folder)

    @property
    def _suffix(self) -> str:
        return {"h264": ".mp4", "ffv1": ".mkv"}[self.coding]

    def _write_view(self, folder: Path, name: str, view: list[Picture]) -> None:
        if self.coding == "h264":
            write_h264(folder / f"{name}.mp4", view, self._times(len(view)), self.quality, streamed=True)
        elif self.coding == "ffv1":
            _write_ffv1(folder / f"{name}.mkv", view, self._times(len(view)))
        else:
            suffix, option = ("png", [cv2.IMWRITE_PNG_COMPRESSION, 1])
            if self.coding == "jpeg":
                suffix, option = ("jpg", [cv2.IMWRITE_JPEG_QUALITY, self.quality])
            (folder / name).mkdir()
            for k, picture in enumerate(view):
                cv2.imwrite(str(folder / name / f"{k:04d}.{suffix}"), picture, option)

    def _times(self, count: int) -> list[float]:
        return [k / self.stated_rate for k in range(count)]

    def _write_times(self, folder: Path) -> None:
        assert self.stamps is not None
        with (folder / "times.csv").open("w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow(["frame", "left_s", "right_s"])
            for k, (left, right) in enumerate(zip(*self.stamps, strict=False)):
                writer.writerow([k, f"{left:.6f}", f"{right:.6f}"])


def _write_ffv1(path: Path, pictures: list[Picture], times: list[float]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "gray"
        for picture, time in zip(pictures, times, strict=True):
            frame = av.VideoFrame.from_ndarray(cv2.resize(picture, (stream.width, stream.height)), format="gray")
            frame.pts = round(time * 30)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


Apply = Callable[[Recording, np.random.Generator], None]


def fault(name: str, visibility: Visibility, areas: tuple[str, ...] = ALL) -> Callable[[Apply], Apply]:
    """Adds a function to the faults of recordings."""

    def add(apply: Apply) -> Apply:
        FAULTS.append(Fault(name, visibility, areas, apply))
        return apply

    return add


HARMLESS, REPAIRABLE, VISIBLE, NOT_VISIBLE = Visibility


# --- the order of the pictures -------------------------------------------------------------------------------------


def _place(r: Recording, rng: np.random.Generator, margin: int = 2) -> int:
    """The index of a picture that is neither one of the first nor one of the last, nor drawn on."""
    count = min(map(len, r.views))
    places = [k for k in range(margin, count - margin) if r.shown[0][k] != r.kept]
    return int(rng.choice(places)) if places else count - 1


def _all_views(r: Recording, order: list[int]) -> None:
    for view in range(len(r.views)):
        r.reorder(order, view)


def _order(r: Recording, view: int = 0) -> list[int]:
    return list(range(len(r.views[view])))


@fault("pictures missing", REPAIRABLE)
def missing(r: Recording, rng: np.random.Generator) -> None:
    first, count = _place(r, rng), int(rng.integers(1, 3))
    _all_views(r, [k for k in _order(r) if not first <= k < first + count or r.shown[0][k] == r.kept])


@fault("a picture repeated", REPAIRABLE)
def repeated(r: Recording, rng: np.random.Generator) -> None:
    place, order = _place(r, rng), _order(r)
    order[place:place] = [place] * int(rng.integers(1, 4))
    _all_views(r, order)


@fault("the first picture repeated", REPAIRABLE)
def first_repeated(r: Recording, rng: np.random.Generator) -> None:
    _all_views(r, [0] * int(rng.integers(1, 4)) + _order(r))


@fault("two pictures swapped", REPAIRABLE)
def swapped(r: Recording, rng: np.random.Generator) -> None:
    place, order = _place(r, rng), _order(r)
    order[place - 1], order[place] = order[place], order[place - 1]
    _all_views(r, order)


@fault("the last pictures missing", HARMLESS, ("follow", "lanes"))
def end_missing(r: Recording, rng: np.random.Generator) -> None:
    _all_views(r, _order(r)[: -int(rng.integers(1, 3))])


@fault("every picture twice", REPAIRABLE, MOVING)
def doubled(r: Recording, rng: np.random.Generator) -> None:
    _all_views(r, [k for k in _order(r) for _ in range(2)])
    r.stated_rate *= 2
    r.stamps = None


@fault("pictures in reverse", VISIBLE, ("speed", "vehicles", "follow"))
def reverse(r: Recording, rng: np.random.Generator) -> None:
    _all_views(r, _order(r)[::-1])


@fault("a picture missing in one view", VISIBLE, (*STEREO, "calibrate"))
def missing_in_one(r: Recording, rng: np.random.Generator) -> None:
    view, place = int(rng.integers(2)), _place(r, rng)
    r.reorder([k for k in _order(r, view) if k != place], view)
    if rng.random() < 0.5:  # the other view ends earlier
        r.reorder(_order(r, 1 - view)[:-1], 1 - view)


@fault("a picture repeated in one view", VISIBLE, (*STEREO, "calibrate"))
def repeated_in_one(r: Recording, rng: np.random.Generator) -> None:
    view, place = int(rng.integers(2)), _place(r, rng)
    order = _order(r, view)
    order[place:place] = [place]
    r.reorder(order[:-1] if rng.random() < 0.5 else order, view)


@fault("pictures swapped in one view", VISIBLE, (*STEREO, "calibrate"))
def swapped_in_one(r: Recording, rng: np.random.Generator) -> None:
    view, place = int(rng.integers(2)), _place(r, rng)
    order = _order(r, view)
    order[place - 1], order[place] = order[place], order[place - 1]
    r.reorder(order, view)


@fault("one view shifted by whole frames", VISIBLE, (*STEREO, "calibrate"))
def shifted(r: Recording, rng: np.random.Generator) -> None:
    view, count = int(rng.integers(2)), int(rng.integers(1, 3))
    r.reorder(_order(r, view)[count:], view)
    r.reorder(_order(r, 1 - view)[:-count], 1 - view)


# --- times ---------------------------------------------------------------------------------------------------------


def _stamps(r: Recording) -> list[list[float]]:
    """Stamps of all pictures, as they are stated without a fault of their own."""
    if r.stamps is None:
        r.stamps = [[k / r.stated_rate for k in range(len(view))] for view in r.views]
    return r.stamps


@fault("a wrong rate", NOT_VISIBLE, MOVING)
def wrong_rate(r: Recording, rng: np.random.Generator) -> None:
    r.stated_rate *= float(rng.choice([0.5, 0.8, 0.96, 1.04, 1.25, 2.0]))


@fault("times that count from another moment", HARMLESS, ("speed", "vehicles"))
def shifted_times(r: Recording, rng: np.random.Generator) -> None:
    start = float(rng.choice([1.0, 3600.0, 1.7e9]))
    r.stamps = [[start + t for t in times] for times in _stamps(r)]


@fault("stamps that jitter", VISIBLE, ("speed", "vehicles"))
def jitter(r: Recording, rng: np.random.Generator) -> None:
    std = float(rng.uniform(0.02, 0.2)) / r.stated_rate
    shifts = rng.normal(0.0, std, max(map(len, r.views)))
    r.stamps = [[t + shifts[k] for k, t in enumerate(times)] for times in _stamps(r)]


@fault("a wrong stamp", VISIBLE, ("speed", "vehicles"))
def wrong_stamp(r: Recording, rng: np.random.Generator) -> None:
    place, shift = _place(r, rng), float(rng.uniform(-1.5, 1.5)) / r.stated_rate
    for times in _stamps(r):
        if place < len(times):
            times[place] += shift


@fault("a stamp repeated", VISIBLE, ("speed", "vehicles"))
def repeated_stamp(r: Recording, rng: np.random.Generator) -> None:
    place = _place(r, rng)
    for times in _stamps(r):
        if place < len(times):
            times[place] = times[place - 1]


@fault("views stated apart", VISIBLE, ("speed", "vehicles"))
def views_apart(r: Recording, rng: np.random.Generator) -> None:
    times, shift = _stamps(r), float(rng.uniform(-0.6, 0.6)) / r.stated_rate
    times[1] = [t + shift for t in times[1]]


# --- pixels --------------------------------------------------------------------------------------------------------


def _each(r: Recording, view: int, change: Callable[[NDArray[np.float32]], Any], start: int = 0) -> None:
    for k in range(start, len(r.views[view])):
        changed = change(r.views[view][k].astype(np.float32))
        r.views[view][k] = np.clip(np.rint(changed), 0, 255).astype(np.uint8)


@fault("an exposure step", HARMLESS)
def exposure_step(r: Recording, rng: np.random.Generator) -> None:
    start, gain, offset = _place(r, rng), float(rng.uniform(0.7, 1.2)), float(rng.uniform(0, 12))
    for view in range(len(r.views)):
        _each(r, view, lambda image: gain * image + offset, start)


@fault("views of other exposure", HARMLESS, (*STEREO, "calibrate"))
def exposure_of_view(r: Recording, rng: np.random.Generator) -> None:
    gain = float(rng.uniform(0.6, 1.1))
    _each(r, int(rng.integers(2)), lambda image: gain * image + 5)


@fault("overexposed", VISIBLE)
def overexposed(r: Recording, rng: np.random.Generator) -> None:
    gain = float(rng.uniform(1.5, 4.0))
    for view in range(len(r.views)):
        _each(r, view, lambda image: gain * image)


@fault("blank pictures", VISIBLE)
def blank(r: Recording, rng: np.random.Generator) -> None:
    place, level = _place(r, rng), int(rng.choice([0, 90, 255]))
    for view in range(len(r.views)):
        for k in range(place, min(place + int(rng.integers(1, 3)), len(r.views[view]))):
            r.views[view][k] = np.full_like(r.views[view][k], level)


@fault("dirt on one lens", VISIBLE)
def dirt(r: Recording, rng: np.random.Generator) -> None:
    view = int(rng.integers(len(r.views)))
    height, width = r.views[view][0].shape
    spots = np.zeros((height, width), np.float32)
    for _ in range(int(rng.integers(1, 6))):
        centre = int(rng.integers(width)), int(rng.integers(height))
        cv2.circle(spots, centre, int(rng.integers(6, 60)), float(rng.uniform(0.3, 1.0)), -1)
    spots = cv2.GaussianBlur(spots, (0, 0), 6)
    grey = float(rng.uniform(0, 120))
    _each(r, view, lambda image: image * (1 - spots) + grey * spots)


@fault("a black bar", VISIBLE)
def black_bar(r: Recording, rng: np.random.Generator) -> None:
    view = int(rng.integers(len(r.views)))
    height, width = r.views[view][0].shape
    first, thick = int(rng.integers(0, height - 20)), int(rng.integers(10, height // 4))
    across = bool(rng.random() < 0.7)
    for picture in r.views[view]:
        part = picture[first : first + thick] if across else picture[:, first : first + thick]
        part[:] = 0


@fault("noise", VISIBLE)
def noise(r: Recording, rng: np.random.Generator) -> None:
    std = float(rng.uniform(3, 25))
    for view in range(len(r.views)):
        _each(r, view, lambda image: image + rng.normal(0, std, image.shape))


# --- geometry ------------------------------------------------------------------------------------------------------


def _about_centre(r: Recording, view: int, scale: float, angle: float = 0.0) -> Array:
    height, width = r.views[view][0].shape
    return np.asarray(cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, scale))


def _mirror(r: Recording, view: int) -> None:
    r.warp(view, np.array([[-1.0, 0.0, r.views[view][0].shape[1] - 1.0], [0.0, 1.0, 0.0]]))


@fault("both views mirrored", VISIBLE, (*STEREO, "calibrate"))
def mirrored(r: Recording, rng: np.random.Generator) -> None:
    for view in range(len(r.views)):
        _mirror(r, view)


@fault("the view mirrored", NOT_VISIBLE, ("follow",))
def mirrored_alone(r: Recording, rng: np.random.Generator) -> None:
    _mirror(r, 0)


@fault("one view mirrored", VISIBLE, (*STEREO, "calibrate"))
def one_mirrored(r: Recording, rng: np.random.Generator) -> None:
    _mirror(r, int(rng.integers(2)))


@fault("mirrored and exchanged", NOT_VISIBLE, STEREO)
def mirrored_exchanged(r: Recording, rng: np.random.Generator) -> None:
    mirrored(r, rng)
    r.exchanged = True


@fault("upside down", VISIBLE)
def upside_down(r: Recording, rng: np.random.Generator) -> None:
    for view in range(len(r.views)):
        r.warp(view, _about_centre(r, view, 1.0, 180.0))


@fault("views exchanged", VISIBLE, (*STEREO, "calibrate"))
def exchanged(r: Recording, rng: np.random.Generator) -> None:
    if "clip.yaml" in r.draw(r):
        r.exchanged = True
    else:
        r.views.reverse()


@fault("one camera turned", VISIBLE, (*STEREO, "calibrate"))
def turned(r: Recording, rng: np.random.Generator) -> None:
    shift = rng.uniform(1.5, 8.0, 2) * rng.choice([-1, 1], 2)
    r.warp(int(rng.integers(2)), np.array([[1, 0, shift[0]], [0, 1, shift[1]]]))


@fault("one camera knocked", VISIBLE, (*STEREO, "calibrate"))
def knocked(r: Recording, rng: np.random.Generator) -> None:
    shift = rng.uniform(1.0, 8.0, 2) * rng.choice([-1, 1], 2)
    r.warp(int(rng.integers(2)), np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), _place(r, rng))


@fault("the camera knocked", VISIBLE, ("follow",))
def knocked_alone(r: Recording, rng: np.random.Generator) -> None:
    shift = rng.uniform(-12, 12, 2)
    r.warp(0, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), _place(r, rng))


@fault("one view zoomed", VISIBLE, STEREO)
def zoomed(r: Recording, rng: np.random.Generator) -> None:
    view = int(rng.integers(2))
    r.warp(view, _about_centre(r, view, float(rng.uniform(1.02, 1.15))))


@fault("all views zoomed", NOT_VISIBLE, (*STEREO, "follow"))
def all_zoomed(r: Recording, rng: np.random.Generator) -> None:
    """As a wrong baseline for stereo, and a nearer vehicle for one camera."""
    scale = float(rng.uniform(1.03, 1.15))
    for view in range(len(r.views)):
        r.warp(view, _about_centre(r, view, scale))


@fault("a wrong baseline", NOT_VISIBLE, STEREO)
def wrong_baseline(r: Recording, rng: np.random.Generator) -> None:
    scale = float(rng.choice([0.01, 0.5, 0.93, 1.08, 2.0, 1000.0]))

    def change(folder: Path) -> None:
        document = yaml.safe_load((folder / "rig.yaml").read_text())
        document["translation"] = [scale * t for t in document["translation"]]
        (folder / "rig.yaml").write_text(yaml.safe_dump(document))

    r.files.append(change)


# --- files ---------------------------------------------------------------------------------------------------------


@fault("JPEG", HARMLESS)
def jpeg(r: Recording, rng: np.random.Generator) -> None:
    r.coding, r.quality = "jpeg", int(rng.integers(75, 100))


@fault("poor JPEG", VISIBLE)
def poor_jpeg(r: Recording, rng: np.random.Generator) -> None:
    r.coding, r.quality = "jpeg", int(rng.integers(5, 60))


@fault("H.264", HARMLESS, ("speed", "vehicles", "lanes", "follow"))
def h264(r: Recording, rng: np.random.Generator) -> None:
    r.coding, r.quality = "h264", int(rng.integers(12, 26))


@fault("poor H.264", VISIBLE, ("speed", "vehicles", "lanes", "follow"))
def poor_h264(r: Recording, rng: np.random.Generator) -> None:
    r.coding, r.quality = "h264", int(rng.integers(28, 46))


def _pictures(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.suffix in (".png", ".jpg", ".mp4", ".mkv"))


@fault("a file cut short", VISIBLE)
def cut_short(r: Recording, rng: np.random.Generator) -> None:
    share, which = float(rng.uniform(0, 0.98)), float(rng.random())

    def change(folder: Path) -> None:
        files = _pictures(folder)
        file = files[int(which * len(files))]
        content = file.read_bytes()
        file.write_bytes(content[: int(share * len(content))])

    r.files.append(change)


@fault("bytes of a file changed", VISIBLE)
def bytes_changed(r: Recording, rng: np.random.Generator) -> None:
    which, places, values = float(rng.random()), rng.random(20), rng.integers(0, 256, 20)

    def change(folder: Path) -> None:
        files = _pictures(folder)
        file = files[int(which * len(files))]
        content = bytearray(file.read_bytes())
        for place, value in zip(places, values, strict=True):
            if content:
                content[int(place * len(content))] = int(value)
        file.write_bytes(bytes(content))

    r.files.append(change)


@fault("a picture of another size", VISIBLE)
def other_size(r: Recording, rng: np.random.Generator) -> None:
    view, whole = int(rng.integers(len(r.views))), bool(rng.random() < 0.5 and r.draw(r))  # a document states the size
    place, scale = _place(r, rng), float(rng.choice([0.5, 0.75, 1.5]))
    for k in range(len(r.views[view])):
        if whole or k == place:
            r.views[view][k] = np.asarray(cv2.resize(r.views[view][k], None, fx=scale, fy=scale), np.uint8)
    if r.coding == "h264":
        r.coding = "png"


@fault("colour pictures", HARMLESS)
def colour(r: Recording, rng: np.random.Generator) -> None:
    if r.coding == "png":
        for view in r.views:
            view[:] = [np.asarray(cv2.cvtColor(p, cv2.COLOR_GRAY2BGR)) if p.ndim == 2 else p for p in view]


@fault("16 bits", HARMLESS, ("speed", "lanes", "vehicles"))
def deep(r: Recording, rng: np.random.Generator) -> None:
    if r.coding == "png":
        for view in r.views:
            view[:] = [p.astype(np.uint16) * 257 if p.ndim == 2 else p for p in view]  # type: ignore[misc]
