"""What the target looks like, learned while it is tracked: its picture, and how clear each of its features is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array, Bytes, Floats, Indices
from paceline.follow import picture_cpu
from paceline.follow.search_cpu import TOLD
from paceline.follow.sweep import sweep
from paceline.targets.line_model import Target

BORDER = 4  # samples of the picture that lie outside of the model, where the background moves by itself
OUTLINE = 2  # the same where the scale is asked: the outline tells most of it
STEPS, FEW = 4, 2  # of an alignment, and of one from where the target is to a fraction of a sample
CELL = 8  # samples along the side of a square that is correlated by itself
SHAPE = (32, 40)  # samples of the picture, down and across
MARGIN = 0.1  # of the model's size that the picture takes in around it, with the outline in the midst of its squares
PLAIN = 1.5  # grey levels of standard deviation below which a square of the picture says nothing
BEST = 0.67  # share of the squares, the most alike, that are asked: a shadow's edge or an occluder spoils the others
NEUTRAL = 0.5  # likeness where the picture shows nothing that could be compared
UNKNOWN = 0.5  # evidence that a feature is expected to show before anything is learned
PICTURE_RATE = 0.02  # of learning, per frame
FEATURE_RATE = 0.1
MATCH_RISES, MATCH_FALLS = 0.05, 0.03  # what hides a part of the target for long is not usual
KEEPSAKE_RATE = 0.002  # of the picture that is kept for long
OLD = 30  # pictures of which it is the mean at first
DRIFTED = 0.04  # sizes of the target, or relative scale, by which the two pictures may disagree
GAIN = 0.04  # likeness by which the place of the old one must be the better
FREE, PATIENT = 0.3, 8  # relative deviation of the scale where only the picture says it; steps of the old one
INSIDE = 0.9  # share of the samples that must lie in the image


@dataclass(frozen=True, eq=False)
class Sight:
    """What is seen at one location: the ``picture``, how many of its samples are ``inside`` the image, and each
    feature's ``evidence`` (S,)."""

    picture: Floats
    inside: float
    evidence: Array


class Appearance:
    """The target's picture inside its model's box, and the evidence that each feature usually shows, by its sign.

    The picture is compared square by square, each free of brightness and contrast, so that neither exposure nor a
    shadow over a part of the target makes it look like something else.
    """

    def __init__(self, target: Target) -> None:
        self.signed = np.zeros(len(target.segments))
        self.strength = np.full(len(target.segments), UNKNOWN)
        self.match = 0.0  # how much of the model usually shows
        self.known = False
        grown = MARGIN * target.size
        self._box = target.box + np.concatenate([-grown, grown])
        self._picture = np.zeros(SHAPE, np.float32)
        self._keepsake = np.zeros(SHAPE, np.float32)
        self._learned = 0
        self._seen, self._there = np.zeros(SHAPE, np.float32), np.zeros(SHAPE, np.float32)
        self._correlations = np.zeros((SHAPE[0] // CELL) * (SHAPE[1] // CELL))

    def look(self, image: Bytes, center: Array, magnification: Array) -> float:
        """Sample ``image`` where the target would be centred at ``center`` (2,) px with ``magnification`` (2,) px per
        metre; returns the share of the samples inside the image."""
        return self._sample(image, center, magnification, self._seen) / self._seen.size

    def _sample(self, image: Bytes, center: Array, magnification: Array, out: Floats) -> int:
        x0, y0, x1, y1 = self._box
        dx, dy = (x1 - x0) * magnification[0] / SHAPE[1], (y1 - y0) * magnification[1] / SHAPE[0]
        left, top = center[0] + x0 * magnification[0] + 0.5 * dx, center[1] + y0 * magnification[1] + 0.5 * dy
        return picture_cpu.sample(image, left, top, dx, dy, out)

    def likeness(self) -> float:
        """How alike what was looked at last and the learned picture are, −1 to 1; 1 where nothing is known yet."""
        if not self.known:
            return 1.0
        return self._alike(self._seen, self._picture)

    def _alike(self, seen: Floats, picture: Floats) -> float:
        return float(picture_cpu.likeness(seen, picture, CELL, PLAIN, BEST, NEUTRAL, self._correlations))

    def align(self, image: Bytes, location: Array, magnification: Array, steady: float) -> Array | None:
        """Move ``location`` (3,) until ``image`` shows the learned picture there; its covariance (3, 3), or None where
        nothing of the picture is found. ``magnification`` (2,) is in px per metre at scale 1, ``steady`` the relative
        standard deviation of the scale given."""
        return self._align(image, self._picture, location, magnification, steady, STEPS, self._seen)

    def sweep(self, image: Bytes, magnification: Array, place: Array, share: float, count: int) -> Array:
        """Up to ``count`` places (N, 3) in ``image`` that look like the learned picture, see `sweep.sweep`."""
        return sweep(image, self._picture, self._box, magnification, place, share, count)

    def scale_at(self, image: Bytes, place: Array, magnification: Array) -> float | None:
        """The scale at which ``image`` shows the learned picture about ``place`` (3,), which is moved there, by nothing
        but the picture; None where it does not. ``magnification`` as in `align`."""
        found = self._align(image, self._picture, place, magnification, FREE, FEW, self._there, OUTLINE)
        return None if found is None else float(place[2])

    def went_from(self, image: Bytes, location: Array, magnification: Array) -> Array | None:
        """Where, at the size it had then, the target lies that was looked at last at ``location`` (3,), by the picture
        that was learned long ago; None where that agrees or cannot tell. The picture of late goes wherever a lock
        slides, say from a pole to the next; ``magnification`` as in `align`."""
        if self._learned < OLD:
            return None
        place, size = location.copy(), max(self._box[2:] - self._box[:2]) * magnification[0] * location[2]
        if self._align(image, self._keepsake, place, magnification, FREE, PATIENT, self._there) is None:
            return None
        if max(np.abs(place[:2] - location[:2]).max() / size, abs(np.log(place[2] / location[2]))) < DRIFTED:
            return None
        here = self._alike(self._seen, self._keepsake)
        self._sample(image, place[:2], magnification * place[2], self._there)
        return place if self._alike(self._there, self._keepsake) > here + GAIN else None

    def restore(self) -> None:
        """Take the picture that was learned long ago for the one of late."""
        self._picture[:] = self._keepsake

    def _align(
        self,
        image: Bytes,
        picture: Floats,
        location: Array,
        magnification: Array,
        steady: float,
        steps: int,
        scratch: Floats,
        border: int = BORDER,
    ) -> Array | None:
        covariance = np.zeros((3, 3))
        good = picture_cpu.align(
            image,
            picture,
            self._box,
            location,
            magnification,
            steady,
            steps,
            CELL,
            PLAIN,
            border,
            scratch,
            covariance,
        )
        return covariance if good else None

    def learn(self, evidence: Array, match: float | None, inside: float) -> None:
        """Take in what was looked at last, the ``evidence`` (S,) along the features there, and what ``match`` the model
        had where that was measured; its picture, where nearly all of that is ``inside`` the image."""
        if match is not None:
            rate = (MATCH_RISES if match > self.match else MATCH_FALLS) if self.match else 1.0
            self.match += rate * (match - self.match)
        rate = FEATURE_RATE if self.known else 1.0
        self.signed += rate * (evidence - self.signed)
        self.strength += (FEATURE_RATE if self.known else 0.5) * (np.abs(evidence) - self.strength)
        if inside >= INSIDE:
            rate = PICTURE_RATE if self.known else 1.0
            self._picture += np.float32(rate) * (self._seen - self._picture)
            self._learned += 1
            old = KEEPSAKE_RATE if self._learned > OLD else 1.0 / self._learned
            self._keepsake += np.float32(old) * (self._seen - self._keepsake)
            self.known = True

    def brighter(self) -> Indices:
        """(S,): 1 or −1 for features whose step in brightness has had this sign of late, 0 for the others."""
        sure = np.abs(self.signed) > TOLD * self.strength
        return np.where(sure, np.sign(self.signed), 0.0).astype(np.int64)
