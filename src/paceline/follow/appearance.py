"""What the target looks like, learned while it is tracked: its picture, and how clear each of its features is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.follow import picture_cpu
from paceline.follow.search_cpu import TOLD
from paceline.follow.target import Target

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

BORDER = 4  # samples of the picture that lie outside of the model, where the background moves by itself
STEPS = 4  # of an alignment
CELL = 8  # samples along the side of a square that is correlated by itself
SHAPE = (32, 40)  # samples of the picture, down and across
MARGIN = 0.1  # of the model's size that the picture takes in around it, with the outline in the midst of its squares
PLAIN = 1.5  # grey levels of standard deviation below which a square of the picture says nothing
BEST = 0.67  # share of the squares, the most alike, that are asked: a shadow's edge or an occluder spoils the others
NEUTRAL = 0.5  # likeness where the picture shows nothing that could be compared
UNKNOWN = 0.5  # evidence that a feature is expected to show before anything is learned
PICTURE_RATE = 0.02  # of learning, per frame
FEATURE_RATE = 0.1
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
        self.lengths: Array = target.spans[:, 1] - target.spans[:, 0]
        self.known = False
        grown = MARGIN * target.size
        self._box = target.box + np.concatenate([-grown, grown])
        self._picture = np.zeros(SHAPE, np.float32)
        self._seen = np.zeros(SHAPE, np.float32)
        self._correlations = np.zeros((SHAPE[0] // CELL) * (SHAPE[1] // CELL))

    def look(self, image: Bytes, center: Array, magnification: Array) -> float:
        """Sample ``image`` where the target would be centred at ``center`` (2,) px with ``magnification`` (2,) px per
        metre; returns the share of the samples inside the image."""
        x0, y0, x1, y1 = self._box
        dx, dy = (x1 - x0) * magnification[0] / SHAPE[1], (y1 - y0) * magnification[1] / SHAPE[0]
        left, top = center[0] + x0 * magnification[0] + 0.5 * dx, center[1] + y0 * magnification[1] + 0.5 * dy
        inside = picture_cpu.sample(image, left, top, dx, dy, self._seen)
        return inside / self._seen.size

    def likeness(self) -> float:
        """How alike what was looked at last and the learned picture are, −1 to 1; 1 where nothing is known yet."""
        if not self.known:
            return 1.0
        n = picture_cpu.cell_correlations(self._seen, self._picture, CELL, PLAIN, self._correlations)
        if n == 0:
            return NEUTRAL
        best = np.sort(self._correlations[:n])[n - max(1, round(BEST * n)) :]
        return float(best.mean())

    def align(self, image: Bytes, location: Array, magnification: Array, steady: float) -> Array | None:
        """Move ``location`` (3,) until ``image`` shows the learned picture there; its covariance (3, 3), or None where
        nothing of the picture is found. ``magnification`` (2,) is in px per metre at scale 1, ``steady`` the relative
        standard deviation of the scale given."""
        covariance = np.zeros((3, 3))
        good = picture_cpu.align(
            image,
            self._picture,
            self._box,
            location,
            magnification,
            steady,
            STEPS,
            CELL,
            PLAIN,
            BORDER,
            self._seen,
            covariance,
        )
        return covariance if good and np.all(np.diag(covariance) > 0.0) else None

    def learn(self, evidence: Array, inside: float) -> None:
        """Take in what was looked at last, and the ``evidence`` (S,) along the features there."""
        rate = FEATURE_RATE if self.known else 1.0
        self.signed += rate * (evidence - self.signed)
        self.strength += (FEATURE_RATE if self.known else 0.5) * (np.abs(evidence) - self.strength)
        if inside >= INSIDE:
            rate = PICTURE_RATE if self.known else 1.0
            self._picture += np.float32(rate) * (self._seen - self._picture)
            self.known = True

    def brighter(self) -> Indices:
        """(S,): 1 or −1 for features whose step in brightness has had this sign of late, 0 for the others."""
        sure = np.abs(self.signed) > TOLD * self.strength
        return np.where(sure, np.sign(self.signed), 0.0).astype(np.int64)
