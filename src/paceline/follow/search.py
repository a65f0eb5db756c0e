"""A search for the whole model in each image, ahead of [NIST]'s stages.

The motion models cannot foresee a bump in the road, which moves the whole image by more than the distance between two
features. So all locations within reach are tried: running sums over the evidence of edges give each feature's support
in two look-ups, and what the features usually show, and the picture of the target, choose between the best of them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from paceline.arrays import Array, Bytes
from paceline.follow import search_cpu
from paceline.follow.appearance import Appearance
from paceline.follow.edges import Window, window_around
from paceline.targets.line_model import Target

DETAIL = 32  # px: the smaller side of the target in the image that is searched
VERTICAL = 0.045  # rad: a bump's pitch between two images
LATERAL = 0.03  # rad
ROUGH = 2.0  # times as far where the predictions have been that bad
SCALES, MOST = 0.08, 0.5  # relative change of scale, and the most that is tried
FAR = 2.0  # times as far as usual beyond which the grid of places is too coarse to be searched alone
WORK = 12_000  # locations tried at most for one image
ROOM = 0.65  # sizes of the target from its centre that must be seen of it
FINER = 3  # times as fine is the second look
NEAR = 0.6  # px of the second look, to which it is right
ALIGNED = 0.25  # px of the searched image to which an alignment of pictures may be trusted
STEADY = 0.03  # relative scale to which it may be
FIRM = 0.01  # the same where a lock had slid, so that it does not slide again
RIVALS = 3  # locations whose pictures are compared
HOPELESS = 0.4  # likeness by which a rival may be behind the best one before the pictures are compared
MODESTY = 0.01  # likeness that a location one standard deviation from the predicted one must have more
HAND = 0.05  # the same at the operator's start
PICTURE = 1.0  # weight of the picture's likeness against the features'
SPREAD = 0.55, 1.8  # times the scale given between which a survey looks
APART = 0.04  # sizes of the target, and relative change of scale, that two places of a survey differ by
STRIDE = 2.0  # px of the searched image between the places of a survey
WIDER = 3.0  # the same of a patrol, which has to be quick
SKIP = 2  # rungs from one scale of a patrol to the next


@dataclass(frozen=True, eq=False)
class Sighting:
    """The best location (3,) found, to within ``doubt`` (3,), the ``window`` that was searched, how alike the
    ``picture`` there is, −1 to 1, where it was compared, and the ``others`` (3,) it was compared with."""

    location: Array
    doubt: Array
    window: Window
    picture: float = 0.0
    others: tuple[Array, ...] = ()


class Search:
    """Looks for the target in images of one size."""

    def __init__(self, target: Target, magnification: Array, image_size: tuple[int, int], softness: float) -> None:
        width, height = image_size
        self._target, self._magnification, self._size = target, magnification, image_size
        self._softness = softness
        self._lengths = target.spans[:, 1] - target.spans[:, 0]
        self._extents = target.size * magnification  # (2,) px at scale 1
        self._extent = float(self._extents.max())
        #: (2,) px by which a bump moves the target from one image to the next
        self.usual = np.array([LATERAL, VERTICAL]) * magnification * target.nominal_range
        self._scratch = np.zeros((2, 3, width), np.float32)
        self._pooled = np.zeros(width * height, np.uint8)
        self._vertical = np.zeros((height + 1) * width, np.float32)
        self._horizontal = np.zeros(height * (width + 1), np.float32)
        self._scores = np.zeros(8 * WORK)
        self._best = np.zeros((RIVALS, 4))
        self._near = np.zeros((1, 4))
        self._evidence = np.zeros(len(target.segments))

    def find(
        self,
        image: Bytes,
        expected: Array,
        doubt: Array,
        shifts: Array,
        width: float,
        appearance: Appearance,
        compare: bool,
    ) -> Sighting | None:
        """The target in ``image`` (H, W), ``expected`` (3,) in recorded pixels with standard deviations ``doubt`` (3,).

        ``shifts`` (S,) px is what the lens does to each feature beyond what it does to the centre. ``width`` is how
        many times as far as usual to look; 0 stands for the operator's start, where nothing moves and only the hand may
        be wrong. ``compare``: whether the picture has a say. None where no edge of the target is in the image.
        """
        size = self._extents * expected[2]
        reach = 3.0 * doubt[:2]
        if width > 0:
            reach = np.maximum(width * self.usual, np.minimum(reach, ROUGH * self.usual))
        modesty = MODESTY if width > 0 else HAND
        side = max(1, int(min(size) / (DETAIL if width <= FAR else DETAIL / 2)))
        share = min(max(SCALES * max(width - 1.0, 0.0), 3.0 * doubt[2] / expected[2]), MOST)
        ladder = self._ladder(expected[2], share, side)
        steps, step = _grid(reach / side, 2.0, len(ladder), WORK)
        window = window_around(expected[:2], ROOM * size + reach, self._size)
        if not self._open(image, window, side):
            return None
        coarse = self._scan(expected, doubt, expected, steps, step, ladder, shifts, modesty, appearance, self._best)
        known = compare and appearance.known
        if known and width > FAR:
            coarse = self._with_swept(coarse, expected, doubt, reach, share, shifts, appearance)
        if not len(coarse):
            return None
        if known:
            return self._closest(coarse, doubt, window, appearance)
        place, pitch = coarse[0], step * side
        fine = max(1, side // FINER)
        if not self._open(image, window_around(place[:2], ROOM * size + pitch, self._size), fine):
            return None
        ladder = self._ladder(place[2], 0.5 * self._rung(place[2], side), fine)
        steps, step = _grid(np.full(2, 0.75 * pitch / fine), 1.0, len(ladder), WORK)
        closer = self._scan(expected, doubt, place[:3], steps, step, ladder, shifts, modesty, appearance, self._near)
        if not len(closer) or not self._open(image, window, side):
            return None
        found = closer[0]
        blur = NEAR * fine
        near = np.array([blur, blur, min(found[2] * self._rung(found[2], fine), doubt[2])])
        return Sighting(found[:3], near, window)

    def survey(self, image: Bytes, location: Array, shifts: Array, reach: float, count: int) -> list[Sighting]:
        """The up to ``count`` places that show most of the model about ``location`` (3,), recorded pixels, the most
        first: up to ``reach`` sizes of the target away, with scales within `SPREAD`. What was learned has no say."""
        size = self._extents * location[2]
        side = max(1, int(SPREAD[0] * min(size) / DETAIL))
        window = window_around(location[:2], (ROOM * SPREAD[1] + reach) * size, self._size)
        if not self._open(image, window, side):
            return []
        return self._surveyed(location, shifts, reach, self._spread(location[2]), STRIDE, count, window, 0.0)

    def patrol(self, location: Array, shifts: Array, reach: float, turn: int) -> list[Sighting]:
        """Of a survey only one scale, in the part of the image searched last, and of that only places that show at
        least as much of the model as ``location``; in every ``turn`` it is the turn of another scale."""
        scales = self._spread(location[2])
        self._respond(location, shifts)
        least = float(np.minimum(np.abs(self._evidence), search_cpu.FULL).mean())
        x0, y0 = self._origin.astype(int).tolist()
        h, w = self._pooled_view.shape
        window = (x0, y0, x0 + w * self._side, y0 + h * self._side)
        scale = scales[SKIP * turn % len(scales) :][:1]
        return self._surveyed(location, shifts, reach, scale, WIDER, 2, window, least)

    def _surveyed(
        self,
        location: Array,
        shifts: Array,
        reach: float,
        scales: Array,
        step: float,
        count: int,
        window: Window,
        least: float,
    ) -> list[Sighting]:
        side, size = self._side, self._extent * location[2]
        steps, step = _grid(np.full(2, reach * size / side), step, len(scales), len(self._scores))
        best = np.zeros((count, 4))
        n = search_cpu.survey(
            self._vertical_view,
            self._horizontal_view,
            (location[:2] - self._origin) / side,
            steps.astype(np.int64),
            step,
            scales,
            np.log1p(self._rung(location[2], side)),
            self._magnification / side,
            self._target.vertical,
            self._target.places,
            self._target.spans,
            shifts / side,
            np.array([APART * size / side, APART]),
            self._scores,
            best,
        )
        best[:, :2] = best[:, :2] * side + self._origin
        blur = step * side
        return [
            Sighting(place[:3], np.array([blur, blur, place[2] * self._rung(place[2], side)]), window)
            for place in best[:n]
            if place[3] >= least
        ]

    def _with_swept(
        self,
        rivals: Array,
        expected: Array,
        doubt: Array,
        reach: Array,
        share: float,
        shifts: Array,
        appearance: Appearance,
    ) -> Array:
        """The ``rivals`` (B, 4) and the places within ``reach`` (2,) px that the learned picture tells by itself, the
        highest first."""
        units, origin, m = self._units, self._zero, self._magnification / self._side
        found = []
        for place in appearance.sweep(self._pooled_view, m, (expected - origin) / units, share, RIVALS):
            appearance.align(self._pooled_view, place, m, float(doubt[2] / expected[2]))
            location = place * units + origin
            if (np.abs(location[:2] - expected[:2]) > reach).any():
                continue
            self._respond(location, shifts)
            score = search_cpu.likeness(self._evidence, appearance.signed, appearance.strength, self._lengths)
            x, y, s = ((location - expected) / np.maximum(doubt, 1e-6)).tolist()
            found.append([*location, score - search_cpu.loss(MODESTY, x * x + y * y, s * s)])
        together = np.vstack([rivals, np.array(found).reshape(-1, 4)])
        return together[np.argsort(-together[:, 3], kind="stable")]

    def _closest(self, rivals: Array, doubt: Array, window: Window, appearance: Appearance) -> Sighting:
        """Of the ``rivals`` (B, 4) the one whose picture is most like the learned one, aligned with that."""
        best, best_score, chosen = None, -np.inf, -1
        units, origin = self._units, self._zero
        m = self._magnification / self._side
        rivals = rivals[rivals[:, 3] > rivals[0, 3] - HOPELESS]
        for k, rival in enumerate(rivals):
            if rival[3] + PICTURE <= best_score:  # the highest come first: no picture can be as alike as it would need
                break
            place = (rival[:3] - origin) / units
            steady = float(doubt[2] / rival[2])
            covariance = appearance.align(self._pooled_view, place, m, steady)
            inside = appearance.look(self._pooled_view, place[:2], place[2] * m)
            picture = appearance.likeness() if inside > 0.5 else 0.0
            if rival[3] + PICTURE * picture > best_score:
                best_score, chosen = rival[3] + PICTURE * picture, k
                floor = np.array([ALIGNED * self._side, ALIGNED * self._side, STEADY * rival[2]])
                near = NEAR * units * np.array([1.0, 1.0, self._rung(rival[2], self._side) * rival[2]])
                if covariance is not None:
                    near = np.minimum(near, np.hypot(floor, np.sqrt(covariance.diagonal()) * units))
                    best = Sighting(place * units + origin, near, window, picture)
                else:
                    best = Sighting(rival[:3], near, window)
        assert best is not None
        return replace(best, others=tuple(rival[:3] for k, rival in enumerate(rivals) if k != chosen))

    def evidence_at(self, location: Array, shifts: Array, appearance: Appearance) -> tuple[float, Array]:
        """Look at the target at ``location`` (3,), recorded pixels, in the part of the image searched last, for
        ``appearance`` to compare or to learn: the share of its picture inside, and the evidence (S,) along its
        features."""
        center, m = self._respond(location, shifts)
        return appearance.look(self._pooled_view, center, m), self._evidence.copy()

    def scale_at(self, center: Array, guess: float, appearance: Appearance, stretch: float = 0.0) -> float | None:
        """`Appearance.scale_at` in the part of the image searched last, for a ``center`` (2,) in recorded pixels.
        By ``stretch``, relative, the readout has made heights larger."""
        place = np.array([*(center - self._origin) / self._side, guess])
        magnification = self._magnification * np.array([1.0, 1.0 + stretch])
        return appearance.scale_at(self._pooled_view, place, magnification / self._side)

    def went_from(self, location: Array, appearance: Appearance) -> Sighting | None:
        """`Appearance.went_from` in the part of the image searched last, for a ``location`` (3,) in recorded pixels."""
        units, origin = self._units, self._zero
        place = appearance.went_from(self._pooled_view, (location - origin) / units, self._magnification / self._side)
        if place is None:
            return None
        near = np.array([ALIGNED * self._side, ALIGNED * self._side, FIRM * place[2]])
        return Sighting(place * units + origin, near, (0, 0, 0, 0))

    def _respond(self, location: Array, shifts: Array) -> tuple[Array, Array]:
        """The evidence along the features for ``location`` (3,); its centre and px per metre in the searched image."""
        m = location[2] * self._magnification / self._side
        center = (location[:2] - self._origin) / self._side
        search_cpu.responses(
            self._vertical_view,
            self._horizontal_view,
            center[0],
            center[1],
            m[0],
            m[1],
            self._target.vertical,
            self._target.places,
            self._target.spans,
            shifts / self._side,
            self._evidence,
        )
        return center, m

    def open_at(self, image: Bytes, location: Array) -> bool:
        """Make the image about ``location`` (3,), recorded pixels, ready for a look at the target there."""
        size = self._extents * location[2]
        side = max(1, int(min(size) / DETAIL))
        return self._open(image, window_around(location[:2], ROOM * size, self._size), side)

    def _open(self, image: Bytes, window: Window, side: int) -> bool:
        """Sum the evidence inside ``window``, over means of ``side`` × ``side`` pixels; False where there is too
        little of it in the image."""
        x0, y0, x1, y1 = window
        h, w = max(y1 - y0, 0) // side, max(x1 - x0, 0) // side
        if min(h, w) < 5:
            return False
        self._side = side
        self._origin = np.array([x0, y0]) + 0.5 * (side - 1)
        self._units, self._zero = np.array([side, side, 1.0]), np.array([*self._origin, 0.0])  # of locations in it
        self._pooled_view = self._pooled[: h * w].reshape(h, w)
        self._vertical_view = self._vertical[: (h + 1) * w].reshape(h + 1, w)
        self._horizontal_view = self._horizontal[: h * (w + 1)].reshape(h, w + 1)
        search_cpu.pool(image, x0, y0, side, self._pooled_view)
        gx, gy = self._scratch
        search_cpu.evidence(self._pooled_view, self._softness, gx, gy, self._vertical_view, self._horizontal_view)
        return True

    def _scan(
        self,
        expected: Array,
        doubt: Array,
        start: Array,
        steps: Array,
        step: float,
        ladder: Array,
        shifts: Array,
        modesty: float,
        appearance: Appearance,
        best: Array,
    ) -> Array:
        """The best locations about ``start`` with their scores (B, 4), in recorded pixels, the highest first."""
        units, origin = self._units, self._zero
        n = search_cpu.scan(
            self._vertical_view,
            self._horizontal_view,
            (start - origin) / units,
            (expected - origin) / units,
            steps.astype(np.int64),
            step,
            ladder,
            self._magnification / self._side,
            self._target.vertical,
            self._target.places,
            self._target.spans,
            shifts / self._side,
            appearance.signed,
            appearance.strength,
            self._lengths,
            np.maximum(doubt, 1e-6) / units,
            modesty,
            self._scores,
            best,
        )
        found = best[:n].copy()
        found[:, :3] = found[:, :3] * units + origin
        return found

    def _rung(self, scale: float, side: int) -> float:
        """The relative change of scale that moves the target's outline by one pixel of the searched image."""
        return float(side / (0.5 * self._extent * scale))

    def _spread(self, scale: float) -> Array:
        """The scales of a survey, by `SPREAD` smaller and greater than ``scale``."""
        step = np.log1p(self._rung(scale, self._side))
        low, high = (int(np.ceil(abs(np.log(s)) / step)) for s in SPREAD)
        return np.asarray(scale * np.exp(step * np.arange(-low, high + 1)), float)

    def _ladder(self, scale: float, share: float, side: int) -> Array:
        """The scales to try, up to a ``share`` smaller and greater than ``scale``."""
        rung = self._rung(scale, side)
        n = max(1, int(np.ceil(share / rung)))
        return np.asarray(scale * (1.0 + rung) ** np.arange(-n, n + 1), float)


def _grid(reach: Array, step: float, scales: int, most: int) -> tuple[Array, float]:
    """How many steps (2,) to either side a grid takes that goes as far as ``reach`` (2,), and how long they are:
    ``step``, or longer, so that at so many ``scales`` it has no more than ``most`` places."""
    steps = np.ceil(reach / step)
    while scales * np.prod(2 * steps + 1) > most:
        step *= 1.25
        steps = np.ceil(reach / step)
    return steps, step
