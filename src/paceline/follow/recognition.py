"""Finding the target in an image: it is searched as a whole, measured by its features, and held by what it looks like
where those do not show."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, replace
from math import hypot

import numpy as np

from paceline.arrays import Array, Bytes, Indices
from paceline.follow import fitting
from paceline.follow.appearance import INSIDE, PICTURE_RATE, Appearance
from paceline.follow.aspect import Aspect
from paceline.follow.carrying import Carried
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.edges import Window
from paceline.follow.features import Projection, Shown
from paceline.follow.fitting import Fit
from paceline.follow.gauge import Gauge
from paceline.follow.judgement import (
    ALIKE,
    APART,
    ASIDE,
    FEW,
    GONE,
    HELD,
    MOSTLY,
    UNLIKE,
    UNSIZED,
    Foreseen,
    Found,
    judged,
)
from paceline.follow.measuring import Measurement, Measurer
from paceline.follow.memory import Memory
from paceline.follow.search import Search, Sighting

ALONE_FOR = 15  # frames in a row for which the picture of late alone is believed, where it is as alike as HELD
WELL = 0.7  # likeness with which a search has seen it well
PROVEN = 10  # frames in which its features must have shown the target before
ELSEWHERE = 0.08  # sizes of the target from its place, and relative change of scale, at which it is another
ABOUT = 0.01  # sizes, and relative scale, within which a place is looked at by itself
LESS, WIDER = 0.85, 4.0  # share of the usual match below which lines are looked for so many times as far away,
MORE = 0.08  # and match that these must add
SHOWING = 0.7  # share of the usual match below which other places that the search saw are looked at,
OTHERS = 3.0  # as far about as that many times the best one's doubt, for they are a grid's;
AS_ALIKE = 0.05  # likeness that they may have less
SMALLER = 0.9  # of the scale foreseen, below which no picture alone finds it again: what hides the lower half of it may
# look, with the upper one, as all of it does farther off
NEARLY_ALL = 0.85  # share of the length of its lines that must show where what they look like is not known
BY_CHANCE = 0.5  # match of the model below which it may be one by chance
STILL = 0.9  # share of the match that there must be where a lock had slid from
WATCH = 3  # images of which in one it is asked whether the lock has slid
WIDEST = 8.0  # times as far as usual a target is looked for that was lost

NOTHING = "nothing like the target is in reach"
OUTSIDE = "too little of it is in the image"
SLID = "its lock had slid along other edges: back to where it looks as it did"
ASTRAY = "its features are found elsewhere"


@dataclass(frozen=True, eq=False)
class Look:
    """What one image shows of the target, and the ``complaint`` that keeps it from being believed."""

    complaint: str
    window: Window = (0, 0, 0, 0)
    fit: Fit | None = None
    measurement: Measurement | None = None  # None where only the picture holds it
    inside: float = 0.0  # share of the picture that lies in the image
    evidence: Array | None = None  # (S,)
    clear: bool = False  # enough to learn the picture from
    note: str = ""
    sure: bool = False  # no doubt that it is the target
    gauge: Gauge | None = None  # of its picture, where that told the scale
    sighting: Sighting | None = None  # what the search saw
    slid: bool = False  # it is where it looks as it did long ago, not where it was followed to


class Recogniser:
    """Looks for a target in images of one size, and learns what it looks like."""

    def __init__(self, projection: Projection, configuration: FollowConfiguration) -> None:
        c, target = configuration, projection.target
        self.projection, self._c = projection, c
        self._search = Search(target, projection.magnification, projection.camera.image_size, c.edge_threshold)
        self._measurer = Measurer(projection, c)
        self._proven = 0
        self._held_for = 0  # frames, in a row, by a picture alone
        self._looked: tuple[Bytes, Foreseen] | None = None  # at an image, and where the target was expected there
        self._turn = 0
        self._either = np.zeros(len(self.projection.offsets), np.int64)  # which side is brighter is not known
        self.appearance = Appearance(target)
        self.gauge, self.aspect = Gauge(), Aspect()
        self._memory = Memory(projection, self._search.usual)

    def look(self, image: Bytes, expected: Array, doubt: Array, tau: float, lost: bool) -> Look:
        """The target in ``image`` (H, W), where it is ``expected`` (3,) to within ``doubt`` (3,), ``tau`` cycles after
        it was seen last; ``lost``: it may be anywhere."""
        foreseen = Foreseen(expected, doubt, tau, lost)
        self._looked = image, foreseen
        if not self._c.wide_search:
            return self._measured(image, expected, doubt, foreseen)
        width = 0.0
        if self.appearance.known:
            width = WIDEST if lost else min(max(1.0, tau) ** 0.7, WIDEST)
        look = self._found(image, foreseen, width)
        return look if lost else self._remembered(look, image, foreseen)

    def _remembered(self, look: Look, image: Bytes, foreseen: Foreseen) -> Look:
        """The ``look`` with what is remembered of the target, or that alone where the two gainsay each other or there
        is a complaint. As it is where nothing is told, the search saw the target well elsewhere, or a target that was
        gone for a while would be found again by that alone, and smaller."""
        fit = None if look.complaint else look.fit
        told = self._memory.told(image, fit, foreseen, self._is_sure(look))
        if told is None or self._conflicts(look, told.place):
            return look
        if fit is None and foreseen.tau >= GONE and told.place[2] < SMALLER * foreseen.location[2]:
            return look
        if fit is None or told.apart:
            if look.sighting is None and not self._search.open_at(image, self.projection.shown(told.place).location):
                return look
            return self._held(told.place, np.hypot(told.doubt, told.lasting), look.window, look.complaint or ASTRAY)
        fit = fitting.combined(fit, told.place, told.doubt, told.lasting)
        inside, evidence = self._evidence_at(fit.location)
        return replace(look, fit=fit, inside=inside, evidence=evidence)

    def _is_sure(self, look: Look) -> bool:
        """Whether there is no doubt that a ``look`` shows the target, and it shows so much of the model as hardly ever
        is there by chance."""
        return look.sure and look.measurement is not None and look.measurement.match >= BY_CHANCE

    def _conflicts(self, look: Look, place: Array) -> bool:
        """Whether the search saw the picture of late well, and not at the ``place`` (3,) that is remembered."""
        if look.sighting is None or look.sighting.picture < WELL:
            return False
        off = np.abs(self.projection.ideal(look.sighting.location) - place)
        return bool((off > ELSEWHERE * self.projection.sizes(place[2])).any())

    def look_at(self, image: Bytes, location: Array, doubt: Array) -> Look:
        """The target in ``image`` (H, W) at ``location`` (3,), known to within ``doubt`` (3,): nothing is searched."""
        foreseen = Foreseen(location, doubt)
        self._looked = image, foreseen
        if not self._search.open_at(image, self.projection.shown(location).location):
            return Look(OUTSIDE)
        return self._measured(image, location, doubt, foreseen)

    def afresh(self) -> Recogniser:
        """Another one that has not learned anything but where a hand has put the target; the two work with the same
        scratch."""
        other = copy(self)
        other._proven, other._held_for = 0, 0
        other.appearance, other.gauge, other.aspect = Appearance(self.projection.target), Gauge(), Aspect()
        other._memory = self._memory.afresh()
        return other

    def carry(self, image: Bytes, location: Array) -> Carried:
        """What carries ``location`` (3,) on from ``image`` by what it looks like there."""
        return Carried(image, self.projection, location, self._search.usual, evened=True)

    def survey(self, image: Bytes, location: Array, reach: float, count: int) -> list[Array]:
        """Up to ``count`` places (3,) about ``location`` (3,) where the model may lie, the best match first; whatever
        was learned has no say. Centres are up to ``reach`` sizes of the target away."""
        shown = self.projection.shown(location)
        sightings = self._search.survey(image, shown.location, shown.shifts, reach, count)
        return [place for place, _ in sorted(self._matches(image, sightings), key=lambda found: -found[1])]

    def patrol(self, image: Bytes, location: Array, reach: float, turn: int) -> tuple[Array, float] | None:
        """As `survey`, in the image looked at last: the best place of one other size, in every ``turn`` another, that
        shows as much of the model as the target at ``location`` (3,)."""
        shown = self.projection.shown(location)
        sightings = self._search.patrol(shown.location, shown.shifts, reach, turn)
        size = self.projection.size(location[2])
        elsewhere = [
            s
            for s in sightings
            if hypot(*(s.location[:2] - shown.location[:2])) > ELSEWHERE * size
            or abs(s.location[2] / location[2] - 1.0) > ELSEWHERE
        ]
        return max(self._matches(image, elsewhere), key=lambda found: found[1], default=None)

    def measured_at(self, image: Bytes, location: Array) -> tuple[Array, float] | None:
        """Where the model fits in ``image`` (H, W) at ``location`` (3,), and how it matches there; None where it does
        not. Whatever was learned has no say."""
        return self._match(image, location, ABOUT * self.projection.sizes(location[2]))

    def _matches(self, image: Bytes, sightings: list[Sighting]) -> Iterator[tuple[Array, float]]:
        for sighting in sightings:
            found = self._match(image, self.projection.ideal(sighting.location), sighting.doubt)
            if found is not None:
                yield found

    def _match(self, image: Bytes, place: Array, doubt: Array) -> tuple[Array, float] | None:
        measurement, _ = self._measurer.measure(image, place, doubt, self._either)
        return None if measurement is None else (measurement.fit.location, measurement.match)

    def learn(self, look: Look) -> None:
        """Take in what a look that was believed has shown."""
        self._held_for = self._held_for + 1 if look.measurement is None else 0
        if look.gauge is not None:
            self.gauge = look.gauge
        if look.measurement is not None:
            self.aspect = look.measurement.aspect
        self._proven += look.measurement is not None
        if look.slid:
            self.appearance.restore()
        if look.evidence is not None:
            match = None if look.measurement is None else look.measurement.match
            inside = look.inside if look.clear or not self.appearance.known else 0.0
            self.appearance.learn(look.evidence, match, inside)
            self.gauge = self.gauge.learned(PICTURE_RATE)
        if self._c.snapshot and look.fit is not None and look.measurement is not None and not look.slid:
            assert self._looked is not None, "it was seen"
            image, foreseen = self._looked
            self._memory.remember(image, look.fit, foreseen, look.clear, self._is_proven)

    def _found(self, image: Bytes, foreseen: Foreseen, width: float) -> Look:
        """Search for the whole model, then measure its features there."""
        shown, c = self.projection.shown(foreseen.location), self._c
        sighting = self._search.find(
            image, shown.location, foreseen.doubt, shown.shifts, width, self.appearance, c.appearance
        )
        if sighting is None:
            return Look(NOTHING)
        start = self.projection.ideal(sighting.location)
        look = self._measured(image, start, sighting.doubt, foreseen, sighting.window)
        look = replace(self._or_elsewhere(look, sighting, image, foreseen), sighting=sighting)
        self._turn += 1
        due = c.appearance and c.keepsake and self._turn % WATCH == 0
        if due and not look.complaint and look.fit is not None:
            old = self._search.went_from(self.projection.shown(look.fit.location).location, self.appearance)
            if old is not None:
                place = self.projection.ideal(old.location)
                back = self._measured(image, place, old.doubt, foreseen._replace(location=place))
                if self._as_good(back, look):
                    return replace(back, window=sighting.window, slid=True, note=SLID)
                self._evidence_at(look.fit.location)  # what is learned is the picture looked at last
        proven = self._is_proven and self._held_for < ALONE_FOR and not foreseen.lost
        if look.complaint in (FEW, APART, UNSIZED) and proven and sighting.picture > HELD:
            return self._by_picture(start, sighting, look.complaint)
        return look

    def _or_elsewhere(self, look: Look, sighting: Sighting, image: Bytes, foreseen: Foreseen) -> Look:
        """The ``look`` where the search saw the target best, or one where it saw it less well and more of the model's
        lines are, whichever side of them is brighter: lamps that were switched on are no longer as they look. It has
        to look like it as well as here, or what stands before half of it would be taken for it."""
        m = look.measurement
        if m is None or look.fit is None or look.inside < INSIDE or self._usual_share(m) >= SHOWING:
            return look
        least = max(ALIKE, self.appearance.likeness() - AS_ALIKE)
        near = sighting.doubt * np.array([OTHERS, OTHERS, 1.0])
        for place in sighting.others:
            start = self.projection.ideal(place)
            far = np.abs(start - look.fit.location)[:2].max() / self.projection.size(start[2])
            if foreseen.tau >= GONE and far > ASIDE:
                continue
            more, searched = self._measure(image, start, near, self._either, foreseen)
            found = self._better(look, more, image, start, near, foreseen, sighting.window or searched, least)
            if found is not None:
                return found
        return look

    def _better(
        self,
        look: Look,
        more: Measurement | None,
        image: Bytes,
        start: Array,
        near: Array,
        foreseen: Foreseen,
        window: Window,
        least: float,
    ) -> Look | None:
        """The look by ``more``, measured about ``start`` (3,), known to within ``near`` (3,), if that shows clearly
        more of the model than this one, nothing is to be complained of, and it is as alike as ``least`` or more."""
        assert look.measurement is not None
        if more is None or more.match <= look.measurement.match + MORE:
            return None
        found = self._thought_of(more, image, start, near, foreseen, window)
        if not found.complaint and found.inside >= INSIDE and self.appearance.likeness() >= least:
            return found
        if look.fit is not None:
            self._evidence_at(look.fit.location)  # what is learned is the picture looked at last
        return None

    def _by_picture(self, location: Array, sighting: Sighting, why: str) -> Look:
        """The target by its picture of late alone, and ``why``."""
        if self._c.steady_scale:
            center = self.projection.shown(location).location[:2]
            picture = self._search.scale_at(center, float(location[2]), self.appearance)
            location = location if picture is None else np.array([*location[:2], self.gauge.scale(picture)])
        doubt = sighting.doubt * np.array([1.0, 1.0, 1.0 + self._held_for / PROVEN])  # a picture's size drifts
        return self._held(location, doubt, sighting.window, why)

    def _held(self, location: Array, doubt: Array, window: Window, why: str) -> Look:
        """The target where its picture is, to within ``doubt`` (3,); ``why`` its features do not tell it."""
        n = len(self.projection.offsets)
        fit = Fit(location, np.diag(doubt**2), np.zeros(3), 0.0, np.full(n, np.nan), np.zeros(n, bool))
        inside, evidence = self._evidence_at(location)
        return Look("", window, fit, None, inside, evidence, note=f"held by its picture: {why}")

    def _evidence_at(self, location: Array) -> tuple[float, Array]:
        """`Search.evidence_at` a ``location`` (3,) of the model, in the part of the image searched last."""
        shown = self.projection.shown(location)
        return self._search.evidence_at(shown.location, shown.shifts, self.appearance)

    def put_by_hand(self, image: Bytes, near: Array) -> Array | None:
        """Where (3,) in ``image`` a hand would have put the target; None where it is not seen; see `Memory.as_put`."""
        return self._memory.as_put(image, near)

    def anchor(self, image: Bytes, place: Array) -> None:
        """Tell it that the target was at a ``place`` (3,) in ``image`` (H, W), which a hand has set, as what it looks
        like there."""
        if self._c.snapshot:
            self._memory.anchor(image, place)

    def _measured(
        self, image: Bytes, start: Array, near: Array, foreseen: Foreseen, searched: Window | None = None
    ) -> Look:
        """Stages 1 to 4 about ``start`` (3,), known to within ``near`` (3,), and what is to be thought of it. The
        look's window is the one ``searched``, if any."""
        brighter = self.appearance.brighter() if self._c.polarity else self._either
        look = self._measured_with(brighter, image, start, near, foreseen, searched)
        m = look.measurement
        if m is not None and look.inside >= INSIDE and self._usual_share(m) < LESS:
            # A size that is off puts the lines of one side out of reach, and those of the other agree with it. But
            # where some are hidden others farther away may fit, say a lorry's ribs, at a size at which it looks
            # otherwise.
            least = self.appearance.likeness() if self._c.appearance else -1.0
            more, window = self._measure(image, start, WIDER * near, brighter, foreseen)
            look = self._better(look, more, image, start, WIDER * near, foreseen, searched or window, least) or look
        # Lamps that are switched on or off are brighter than what is about them, or darker, from one image to the next,
        # and so are light sides before the sky where a shadow falls on them. Where the image cuts off the outline a
        # line inside, of the other sign, is mostly something else.
        if look.complaint == FEW and brighter.any():
            other = self._measured_with(self._either, image, start, near, foreseen, searched)
            return look if other.complaint or other.inside < INSIDE else other
        if look.complaint in (APART, UNLIKE) and brighter.any() and look.inside >= INSIDE:
            more, window = self._measure(image, start, near, self._either, foreseen)
            if more is not None and more.support >= NEARLY_ALL:
                least = self.appearance.likeness() - AS_ALIKE
                return self._better(look, more, image, start, near, foreseen, searched or window, least) or look
        return look

    def _measure(
        self, image: Bytes, start: Array, near: Array, brighter: Indices, foreseen: Foreseen
    ) -> tuple[Measurement | None, Window]:
        """`Measurer.measure` with what is known of the target's aspect."""
        return self._measurer.measure(image, start, near, brighter, self.aspect.aged(foreseen.tau))

    def _measured_with(
        self, brighter: Indices, image: Bytes, start: Array, near: Array, foreseen: Foreseen, searched: Window | None
    ) -> Look:
        """The same with only such edges of a feature as have the sign ``brighter`` (S,), where that is not 0."""
        measurement, window = self._measure(image, start, near, brighter, foreseen)
        if measurement is None:
            return Look(FEW, searched or window)
        return self._thought_of(measurement, image, start, near, foreseen, searched or window)

    def _thought_of(
        self, measurement: Measurement, image: Bytes, start: Array, near: Array, foreseen: Foreseen, window: Window
    ) -> Look:
        """What is to be thought of a ``measurement`` about ``start`` (3,), known to within ``near`` (3,)."""
        c, fit = self._c, measurement.fit
        if c.wide_search and c.appearance:
            fit = fitting.fused(fit, start, near)
        if not (c.wide_search or c.appearance or c.polarity or c.probation):
            return Look("", window, fit, measurement)
        shown = self.projection.shown(fit.location)
        if not c.wide_search and not self._search.open_at(image, shown.location):
            return Look(OUTSIDE, window, fit, measurement)
        steadied, gauge = self._steadied(
            fit, shown, float(start[2]), foreseen.tau + self._held_for, measurement.stretch
        )
        inside, evidence = self._evidence_at(steadied.location)
        picture = self.appearance.likeness() if c.appearance and inside > 0.5 else 0.0
        found = Found(measurement, fit, picture, self._usual_share(measurement), self._is_proven)
        complaint, clear, sure = judged(found, foreseen, self.projection, c)
        fit = fit if complaint else steadied
        return Look(complaint, window, fit, measurement, inside, evidence, clear, sure=sure, gauge=gauge)

    def _steadied(self, fit: Fit, shown: Shown, guess: float, tau: float, stretch: float) -> tuple[Fit, Gauge | None]:
        """The ``fit`` with its scale by the picture, and what that is worth now; as it is where the picture is not
        known or not found."""
        if not (self._c.steady_scale and self._c.appearance and self.appearance.known):
            return fit, None
        picture = self._search.scale_at(shown.location[:2], guess, self.appearance, stretch)
        if picture is None:
            return fit, None
        scale, gauge = self.gauge.set(float(fit.location[2]), picture, tau)
        return fitting.scaled(fit, scale), gauge

    def _as_good(self, back: Look, look: Look) -> bool:
        """Whether the model's edges are ``back`` there too, almost as many: a shadow that has just passed changes the
        picture, not the edges. Where much is hidden, part of the target looks as the whole farther off."""
        if back.measurement is None or look.measurement is None:
            return False
        return back.measurement.match > STILL * look.measurement.match and self._usual_share(back.measurement) > MOSTLY

    @property
    def _is_proven(self) -> bool:
        return self._proven >= PROVEN

    def _usual_share(self, measurement: Measurement) -> float:
        """How much of the model shows, as a share of what usually does, up to 1."""
        usual = self.appearance.match
        return min(measurement.match / usual, 1.0) if usual else 1.0
