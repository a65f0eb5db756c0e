"""Sightings joined over time: what moves along a way as vehicles do is one."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from paceline.arrays import Array
from paceline.detection.detector import GRID, Sighting
from paceline.detection.lane_paths import Way
from paceline.speed.configuration import DEFAULT_LIMITS

ALIKE = 0.5  # correlation of the faces of one vehicle in two frames,
SETTLED = 3, 1.0  # sightings from which on, and seconds since the last up to which, where it must be tells more:
# something may have hidden part of it
ASIDE = 1.3  # m across the way that a vehicle moves at most from one sighting to the next,
GAP = 0.5  # or that may lie between what is seen of it on either side of a pole
ERROR = 2.5, 1.5  # m along the way, and px of disparity, by which a sighting is off at most
LEAST_TRAVEL = 1.5, 1.5  # m along the way, and px of disparity: what moves less stands
CHANGING = 8.0  # m/s², by which a vehicle gathers or loses speed at most
LOW = 1.3  # m, up to where faces are compared: windscreens mirror what is around
SHIFT = 0.35  # m that a face may have moved on its card
PATIENCE = 3, 0.7  # frames, and seconds, without a sighting after which a vehicle has gone,
GONE = 1.5  # s after which it has in any case: frames may be missing, and where it would be is not known any more
BODY = 6.0, 2.5  # m along and across, within which there is no second vehicle
ABREAST = 3.0  # m across, from which on there may be one in any case
RECENT, LATEST = 8, 4  # sightings that say how fast a vehicle is, and from where on it is next
TOGETHER = 0.8  # of their errors, by which sightings of one vehicle are off its course at most, in the median
BENT = 1.0  # m/s², of a course: as unlikely as to be off by one error
REFITTED, EXACT = 10, 0.05  # times, and parts of an error, of a fit by the sum of what is off
KEPT = 12  # sightings of a vehicle that are kept, evenly spread


@dataclass(eq=False)
class Track:
    """Sightings of one vehicle, in order of time; ``kept`` are evenly spread ones from the first to about the last."""

    way_s: list[float] = field(default_factory=list)  # m along the first sighting's way
    times: list[float] = field(default_factory=list)
    areas: list[float] = field(default_factory=list)
    upright: list[float] = field(default_factory=list)  # times better that it is seen than if it lay on the road
    places: list[Array] = field(default_factory=list)  # (3,) m each, in the world
    errors: list[float] = field(default_factory=list)  # m along the way, by which one is off at most
    kept: list[Sighting] = field(default_factory=list)
    last: Sighting | None = None
    unseen: int = 0  # frames since it was seen last,
    missed: int = 0  # and before that, since it was seen first
    _stride: int = 1

    def add(self, sighting: Sighting) -> None:
        if len(self.times) % self._stride == 0:
            self.kept.append(sighting)
            if len(self.kept) > KEPT:
                self.kept, self._stride = self.kept[::2], 2 * self._stride
        self.way_s.append(self.along(sighting))
        self.times.append(sighting.time)
        self.areas.append(sighting.area)
        self.upright.append(sighting.upright)
        self.places.append(sighting.place)
        self.errors.append(sighting.error(*ERROR))
        self.missed += self.unseen
        self.last, self.unseen = sighting, 0

    @property
    def first(self) -> Sighting:
        return self.kept[0]

    @property
    def width(self) -> float:
        """Metres across, in the median, of what is seen of it."""
        return float(np.median([s.x[1] - s.x[0] for s in self.kept]))

    def along(self, sighting: Sighting) -> float:
        """Arc length of a sighting on this track's way, m."""
        if not self.kept or sighting.way is self.first.way:
            return sighting.s
        return self.first.way.path.nearest(sighting.place)

    @property
    def speed(self) -> float:
        """Metres per second along the way, over all of it; NaN for a single sighting."""
        return slope(np.array(self.times), np.array(self.way_s))

    @property
    def travel(self) -> float:
        """Metres along the way that it has moved, by the medians of the first and of the last third."""
        third = -(-len(self.way_s) // 3)
        early, late = np.median(self.way_s[:third]), np.median(self.way_s[-third:])
        return float(late - early) * (len(self.way_s) - 1) / max(len(self.way_s) - third, 1)

    @property
    def moves(self) -> bool:
        """Whether it has moved by more than an error."""
        return len(self.times) > 1 and abs(self.travel) >= self.kept[len(self.kept) // 2].error(*LEAST_TRAVEL)

    @property
    def unsteadiness(self) -> float:
        """How badly a constant acceleration fits where it was, beside two places where it stood, with one jump from
        one to the other (metres by metres): near 0 for what drives, above 1 for what sways here and then there."""
        s = np.array(self.way_s)
        jumping = min(_scatter(s[:k]) + _scatter(s[k:]) for k in range(1, len(s)))
        return float(np.abs(self._off_smooth).sum()) / max(jumping, 1e-9)

    @property
    def roughness(self) -> float:
        """How far it was, rms, from where a constant acceleration fits best, px of disparity."""
        return float(np.sqrt(np.mean(self._off_smooth**2))) / self.kept[len(self.kept) // 2].error(0.0, 1.0)

    @property
    def _off_smooth(self) -> Array:
        t, s = np.array(self.times) - self.times[0], np.array(self.way_s)
        return np.asarray(s - np.polyval(np.polyfit(t, s, 2), t))

    def is_of(self, other: Track) -> bool:
        """Whether it saw the vehicle of another track: then one course leads through what both saw about the time of
        both."""
        begun, ended = max(self.times[0], other.times[0]), min(self.times[-1], other.times[-1])
        if begun - ended > GONE:
            return False
        way, shared = self.first.way, (min(begun, ended) - GONE, max(begun, ended) + GONE)
        mine, others = self._on(way, *shared), other._on(way, *shared)
        apart = abs(np.median(mine[3]) - np.median(others[3]))
        if apart > max(BODY[1], min(0.5 * (self.width + other.width), ABREAST)):
            return False
        off = np.abs(off_course(*np.hstack([mine, others])[:3]))
        count = mine.shape[1]
        return bool(max(np.median(off[:count]), np.median(off[count:])) <= TOGETHER)

    def _on(self, way: Way, start: float, end: float) -> Array:
        """Times, arc lengths on a ``way``, errors, and metres aside (4, N), of what was seen from ``start`` to
        ``end``."""
        found = []
        for time, place, error in zip(self.times, self.places, self.errors, strict=True):
            if start <= time <= end:
                s, aside, _ = way.on_card(place)
                found.append((time, s, error, aside))
        return np.array(found).T

    def settled(self, time: float) -> bool:
        """Whether at ``time`` it is known well where the vehicle must be."""
        return len(self.times) >= SETTLED[0] and time - self.times[-1] <= SETTLED[1]

    def fits(self, sighting: Sighting) -> bool:
        """Whether a vehicle seen so far may be where ``sighting`` is."""
        assert self.last is not None, "a track begins with a sighting"
        dt = sighting.time - self.times[-1]
        if dt > GONE:
            return False
        s, way = self.along(sighting), self.first.way
        aside = (sighting.place - self.last.place) @ way.axes(s)[1]
        half_widths = 0.5 * (sighting.x[1] - sighting.x[0] + self.last.x[1] - self.last.x[0])
        if abs(aside) > max(ASIDE, half_widths + GAP):
            return False
        error = sighting.error(*ERROR)
        if len(self.times) == 1:
            return bool(abs(s - self.way_s[-1]) <= DEFAULT_LIMITS.max_speed * dt + error)
        recent = slice(-RECENT, None)
        t, places = np.array(self.times[recent]) - sighting.time, np.array(self.way_s[recent])
        v = slope(t, places)
        there = float(np.median((places - v * t)[-LATEST:]))
        doubt = error + self.errors[-1] * dt / (t[-1] - t[0]) + 0.5 * CHANGING * dt**2
        return bool(abs(s - there) <= doubt)


def _scatter(s: Array) -> float:
    return float(np.abs(s - np.median(s)).sum())


def slope(t: Array, s: Array) -> float:
    """The median of the slopes of all pairs (Theil and Sen); NaN where there is none."""
    i, j = np.triu_indices(len(t), 1)
    return float(np.median((s[j] - s[i]) / (t[j] - t[i]))) if len(i) else float("nan")


def off_course(t: Array, s: Array, error: Array) -> Array:
    """How far, in parts of its ``error``, each place ``s`` at a time ``t`` (N,) is off the course that they are
    off least in sum: a line, bent as little as they are worth."""
    powers, places = np.vander(t - t.mean(), 3) / error[:, None], s / error
    bend = np.array([[2.0 / BENT, 0.0, 0.0]])
    weight = np.ones(len(t) + 1)
    for _ in range(REFITTED):
        A, b = weight[:, None] * np.concatenate([powers, bend]), weight * np.append(places, 0.0)
        course = np.linalg.lstsq(A, b, rcond=None)[0]
        off = np.append(places - powers @ course, bend @ course)
        weight = 1.0 / np.sqrt(np.maximum(np.abs(off), EXACT))
    return np.asarray(off[:-1])


def likeness(a: Sighting, b: Sighting) -> float:
    """The best correlation of the lower part of the narrower face with the card of the other, shifted a little, and
    anywhere within a wider one, which may show more than the vehicle."""
    if b.x[1] - b.x[0] < a.x[1] - a.x[0]:
        a, b = b, a
    template, card = (s.cards(s.s, GRID, np.array([s.middle, 0.0]))[0] for s in (a, b))
    width, wider = a.x[1] - a.x[0], b.x[1] - b.x[0]
    columns = np.flatnonzero(np.abs(GRID.x) <= 0.5 * width)
    rows = np.flatnonzero(GRID.y <= max(LOW, a.y[0] + 0.4))
    down, across = round(SHIFT / GRID.cell), round((SHIFT + 0.5 * (wider - width)) / GRID.cell)
    pad = cv2.copyMakeBorder(card, down, down, across, across, cv2.BORDER_REPLICATE)
    window = pad[rows[0] : rows[-1] + 1 + 2 * down, columns[0] : columns[-1] + 1 + 2 * across].copy()
    face = template[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].copy()
    scores = cv2.matchTemplate(window, face, cv2.TM_CCOEFF_NORMED)
    return float(np.nan_to_num(scores, nan=-1.0, posinf=-1.0).max())


def is_one(a: Sighting, b: Sighting) -> bool:
    """Whether two sightings in one frame are so near each other that they are parts of one vehicle."""
    apart = a.place - b.place
    forward, right, _ = b.way.path.frames(np.array(b.s)).T
    return bool(abs(apart @ forward) < BODY[0] and abs(apart @ right) < BODY[1])


class Linker:
    """Takes the sightings of frame after frame; gives each vehicle's track when it has gone."""

    def __init__(self) -> None:
        self.tracks: list[Track] = []

    def link(self, time: float, sightings: list[Sighting]) -> list[Track]:
        """The tracks that have ended by now; ``sightings`` at ``time`` go to those that go on, or begin new ones."""
        pairs = [  # what has moved goes first: what stands, as a bush does, is hidden by it, and will be seen again
            (track.moves, likeness(track.last, sighting), i, j)
            for i, track in enumerate(self.tracks)
            for j, sighting in enumerate(sightings)
            if track.last is not None and track.fits(sighting)
        ]
        taken_tracks: set[int] = set()
        taken: set[int] = set()
        for _, score, i, j in sorted(pairs, reverse=True):
            known = score >= ALIKE or self.tracks[i].settled(time)
            if known and i not in taken_tracks and j not in taken:
                self.tracks[i].add(sightings[j])
                taken_tracks.add(i)
                taken.add(j)
        ended = []
        for i, track in enumerate(self.tracks):
            if i not in taken_tracks:
                track.unseen += 1
                unseen = time - track.times[-1]
                if unseen > GONE or (track.unseen > PATIENCE[0] and unseen > PATIENCE[1]):
                    ended.append(track)
        self.tracks = [track for track in self.tracks if track not in ended]
        seen = [sightings[j] for j in taken]
        for j, sighting in enumerate(sightings):
            if j not in taken and not any(is_one(sighting, other) for other in seen):
                self.tracks.append(Track())
                self.tracks[-1].add(sighting)
        return ended
