"""What is to be thought of features that were found: whether they can be the target's, by their geometry, its picture
and where it was foreseen."""

from __future__ import annotations

from math import hypot
from typing import NamedTuple

import numpy as np

from paceline.arrays import Array
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.continuity import veers
from paceline.follow.features import Projection
from paceline.follow.fitting import Fit
from paceline.follow.measuring import Measurement

SUPPORT = 0.35  # share of the model's lines that must be found
CLEAR = 0.5  # the same for a target that was lost, and for one that shows well
FEATURES = 4  # that must agree
CLOSELY = 0.6  # discord with which its features agree well
SHARP = 0.012  # relative deviation of the scale with which the picture may still be learned
VAGUE = 0.1  # relative standard deviation of the scale with which it is not told
JUMP = 6.0  # standard deviations that the scale may be off the predicted one
RELATED = 1.1  # likeness of the picture and share of the usual match, together, below which it is something else
STRAYED = 1.4  # the same where its size is not the one foreseen, to within AS_FORESEEN; after a gap, NEARLY
AS_FORESEEN, NEARLY = 0.02, 0.15
ASIDE = 0.75  # sizes of the target
AGAIN = 1.5  # the same for a target that was not seen for as many cycles as GONE
REGAINED = 1.8  # the same for one that was lost, veered, or is ASIDE of where it was, as among many places some look
# alike; and where there is no doubt
GONE = 3.0
LOOSE, MOSTLY = 1.3, 0.7  # discord of its features with which a target that looks as it did may be believed, where this
# share of the usual match shows: a half hidden one looks as it did as well
ALIKE = 0.7  # likeness of the picture with which its size may jump, and it looks as it did
HELD = 0.85  # likeness at which nothing else has to show

FEW = "too few of its features are found"
APART = "what is found does not fit together"
UNSIZED = "its size cannot be told"
JUMPS = "its size jumps"
UNLIKE = "what is found does not look like it"


class Foreseen(NamedTuple):
    """Where the target is expected: at ``location`` (3,) to within ``doubt`` (3,), ``tau`` cycles after it was seen
    last; ``lost``: it may be anywhere."""

    location: Array
    doubt: Array
    tau: float = 0.0
    lost: bool = False


class Found(NamedTuple):
    """What was found: the ``measurement``, its ``fit`` with what was known before, the likeness of the ``picture``
    there, −1 to 1 and 0 where most of it is outside, how much of the model ``shows``, as a share of what usually does,
    up to 1, and whether features have shown the target often enough for that to be ``proven``."""

    measurement: Measurement
    fit: Fit
    picture: float
    shows: float
    proven: bool

    @property
    def related(self) -> float:
        """How much it looks like the target, up to 2."""
        return self.picture + self.shows

    @property
    def spread(self) -> float:
        """Relative standard deviation of its scale."""
        return float(np.sqrt(self.fit.covariance[2, 2])) / float(self.fit.location[2])

    @property
    def sharp(self) -> bool:
        """Whether most of its features show, and agree on a size."""
        return self.measurement.support >= CLEAR and self.measurement.discord < CLOSELY and self.spread < SHARP

    def grown(self, foreseen: Foreseen) -> float:
        """How many times the size foreseen it has."""
        return float(self.fit.location[2] / foreseen.location[2])


class Verdict(NamedTuple):
    """What there is to complain of, and whether what was found is ``clear`` enough to learn the picture from, and
    without doubt, ``sure``, the target."""

    complaint: str
    clear: bool
    sure: bool


def judged(found: Found, foreseen: Foreseen, projection: Projection, configuration: FollowConfiguration) -> Verdict:
    """Its features must be there, fit together and look like the target. Where ``configuration`` has no appearance
    nothing is complained of."""
    clear = found.sharp and abs(found.grown(foreseen) - 1.0) < SHARP
    if not configuration.appearance:
        return Verdict("", clear, False)
    complaint = _misfit(found, foreseen)
    if not complaint and found.related < _needed(found, foreseen, projection, configuration.continuity):
        complaint = UNLIKE
    return Verdict(complaint, clear, not complaint and found.related >= REGAINED)


def _misfit(found: Found, foreseen: Foreseen) -> str:
    """What there is to complain of in its features alone."""
    measurement, fit = found.measurement, found.fit
    if measurement.support < (CLEAR if foreseen.lost else SUPPORT) or measurement.agreeing.sum() < FEATURES:
        return FEW
    astray = np.isfinite(measurement.fit.offsets).sum() - measurement.agreeing.sum()
    as_ever = found.proven and found.picture > ALIKE and found.shows > MOSTLY
    # a single edge that is another's tells nothing against all the others
    if measurement.discord > (LOOSE if as_ever else 1.0) and astray > 1:
        return APART
    if found.spread > VAGUE:
        return UNSIZED
    jump = abs(fit.location[2] - foreseen.location[2]) / hypot(foreseen.doubt[2], found.spread * fit.location[2])
    return JUMPS if jump > JUMP and not (found.sharp and found.picture > ALIKE) else ""


def _needed(found: Found, foreseen: Foreseen, projection: Projection, continuous: bool) -> float:
    """How closely what was ``found`` must be related to the target, where it is and at the size it has there."""
    (x, _, scale), tau = foreseen.location, foreseen.tau
    moved, grown = abs(found.fit.location[0] - x), found.grown(foreseen)
    aside = moved / projection.size(scale)
    veered = continuous and veers(projection, moved, scale, tau)
    if foreseen.lost or veered or (tau >= GONE and max(abs(grown - 1.0) / NEARLY, aside / ASIDE) > 1.0):
        return REGAINED
    if found.picture > HELD and abs(grown - 1.0) < NEARLY:
        return 0.0
    if tau >= GONE:
        return AGAIN
    return RELATED if abs(grown - 1.0) < AS_FORESEEN else STRAYED
