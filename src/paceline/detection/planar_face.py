"""The part of a vehicle's face that is measured: what stays the same on one plane, in both views and over time.

A number plate, lamps and a bumper lie in one card and keep their picture there while the vehicle drives; a windscreen
slopes away and mirrors what is around, a bonnet moves against the bumper as the view on it changes. So the sightings of
a vehicle are laid on each other, and the rectangle is taken in which they agree most.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.detection.detector import GRID, Sighting
from paceline.detection.lane_paths import Grid, Way
from paceline.detection.photo_consistency import FLAT, Texture, agreement, correlation
from paceline.detection.tracks import Track
from paceline.speed.geometry.paths import Path
from paceline.subpixel import parabola_peak_at

Span = tuple[float, float]

FINE = Grid(left=-2.4, top=1.6, bottom=0.15, cell=0.025)
WINDOW = 9  # cells over which pictures are compared
REACH, STEPS = (3.0, 1.0), 25  # m at least, or px of disparity: so far about its sighting a face is looked for, at so
# many places
UNUSUAL = 0.06  # correlation that it costs if it lies farther from its sighting, by the reach, than in the reference
SHARPER = 0.5, 0.7  # of the largest area that agrees, and times the misfit of the views where it does: a place at which
# more than that agrees, and which fits better than that, is taken before it
SHIFT = 0.4  # m that the face may lie off where it was in another frame, on the card
RAISED = 0.5  # correlation that it costs if it lies as much higher or lower: on a card at a wrong place it does
CONTRAST = 1.0  # grey levels of a texture
SAME = 0.85  # correlation with what was there before the vehicle, above which that is what a view shows;
SELDOM = 0.3  # of the views: where only so few show something else, there is no vehicle
AGREED = 0.78, 0.66, 0.54  # correlation that speaks for a place as much as against it; less where noise leaves none
NARROWEST, LOWEST = 0.4, 0.3  # m of a rectangle
INSET = 0.075  # m: a correlation sees half its window beyond the place where it stands
MOST_OF = 0.7  # of a face's width that a rectangle takes at least
WIDEST = 1.8, 2.3  # m, of a rectangle on a car, and on what is taller than `TALLER`, or wider, or narrower than
PART = 1.0  # m: it may be one lamp of a lorry. A rail beside the road agrees in all frames as well as a face does
HIGHEST = 1.1, 1.6  # m, of a rectangle on a car, and on what is taller than `TALLER`
BEGUN = 1.0, 0.57  # of the height, up to where all is first laid on each other: a bonnet or a windscreen may mislead it
TALLER = 2.2  # m
FOOT = 1.5  # m above the road, below which a sighting begins that shows a face: so high up are the lamps of lorries
COST = 0.02  # of a place without texture
COARSE = 2  # cells of the map on which rectangles are tried
UNLIKE = 0.7, 1.5  # of the usual area that is seen of it, outside which a face is not the reference: part of it is
# hidden, or something else was seen with it
MATCHED = 0.55  # correlation with the reference of a frame that counts


@dataclass(frozen=True, eq=False)
class Aligned:
    """A sighting whose face was found at arc length ``s``, with the reference's origin at ``origin`` (2,) m on the
    card; ``score`` is the mean correlation of both views with the reference."""

    sighting: Sighting
    s: float
    origin: Array
    score: float

    def along(self, path: Path) -> float:
        """The arc length of a ``path`` at which its face stands, m."""
        return path.nearest(self.sighting.way.place(self.s, self.sighting.middle, 0.0))

    def on(self, way: Way) -> Array:
        """Its origin on the cards of another ``way``."""
        if way is self.sighting.way:
            return self.origin
        _, x, y = way.on_card(self.sighting.way.place(self.s, *self.origin))
        return np.array([x, y])

    def cards(self) -> tuple[Image, Image]:
        return self.sighting.cards(self.s, FINE, self.origin)

    def cards_before(self) -> tuple[Image, Image]:
        return self.sighting.cards_before(self.s, FINE, self.origin)


@dataclass(frozen=True, eq=False)
class Face:
    """The rectangle to track: ``x`` and ``y`` (2,) m from the reference's origin; ``aligned`` where each sighting has
    it. ``votes`` are those of its cells (`_votes`), at the least correlation that may speak for a place."""

    x: Span
    y: Span
    aligned: list[Aligned]
    votes: float

    def corners(self, at: Aligned) -> Array:
        """Card coordinates (4, 2) of its corners in a frame: tl, tr, br, bl."""
        (x0, x1), (y0, y1) = self.x, self.y
        return np.array([[x0, y1], [x1, y1], [x1, y0], [x0, y0]]) + at.origin


def face_of(shown: list[Sighting]) -> Face | None:
    """The rectangle on a vehicle's face that all sightings in which it is ``shown`` agree on; None where they agree on
    none."""
    if not shown:
        return None
    uncut = [sighting for sighting in shown if _is_uncut(sighting)] or shown
    usual = float(np.quantile([sighting.area for sighting in uncut], 0.5, method="higher"))  # that of one of them
    reference = max((s for s in uncut if UNLIKE[0] * usual <= s.area <= UNLIKE[1] * usual), key=_size)
    half = float(np.clip(0.5 * (reference.x[1] - reference.x[0]), FINE.cell, -FINE.left))
    top = HIGHEST[reference.y[1] > TALLER]
    faces = [_face_within((-half, half), (FINE.bottom, share * top), shown, reference) for share in BEGUN]
    found = [face for face in faces if face is not None]
    return max(found, key=lambda face: face.votes * len(face.aligned), default=None)


def _face_within(x: Span, y: Span, shown: list[Sighting], reference: Sighting) -> Face | None:
    """The rectangle that all that is ``shown`` agrees on if it is first laid on each other by what lies between these
    ``x`` and ``y`` of the ``reference``, and then by that rectangle."""
    face: Face | None = None
    for _ in range(2):
        aligned = _lay_on_each_other(shown, reference, x, y)
        if len(aligned) < 2:
            return None
        face = _rectangle(aligned, reference)
        if face is None:
            return None
        x, y = face.x, face.y
    return face


def showing_face(track: Track) -> list[Sighting]:
    """The sightings that reach down to a face: what hangs higher is a roof behind another vehicle, or none."""
    return [sighting for sighting in track.kept if sighting.y[0] < FOOT]


def nearer_half(sightings: list[Sighting]) -> list[Sighting]:
    """The half of some ``sightings`` in which the vehicle is larger."""
    usual = np.median([_size(sighting) for sighting in sightings])
    return [sighting for sighting in sightings if _size(sighting) >= usual]


def course(aligned: list[Aligned]) -> tuple[Array, Array]:
    """When, s, and at which arc lengths of the first one's way, m, each of the frames ``aligned`` has the face: (N,)
    each."""
    path = aligned[0].sighting.way.path
    return np.array([a.sighting.time for a in aligned]), np.array([a.along(path) for a in aligned])


def likeness(face: Face, aligned: list[Aligned]) -> Array:
    """How much each of the frames ``aligned`` (N,) looks like most of them inside the rectangle of a ``face``: the
    correlation with the median of their pictures, in the view that shows it worse."""
    rows, columns = _window(face.x, face.y)
    pictures = np.array([[card[rows, columns] for card in at.cards()] for at in aligned], float)
    pictures -= pictures.mean((2, 3), keepdims=True)
    pictures /= np.maximum(pictures.std((2, 3), keepdims=True), 1e-6)
    usual = np.median(pictures, axis=(0, 1))
    return np.asarray((pictures * usual).mean((2, 3)).min(1) / max(float(usual.std()), 1e-6))


def _is_uncut(sighting: Sighting) -> bool:
    """Whether neither its card nor a picture ends at a face: beyond its edge a picture repeats itself in both views."""
    (left, right), (bottom, top) = sighting.x, sighting.y
    if min(left - GRID.left, -GRID.left - right) <= 0.5 * GRID.cell:
        return False
    corners = np.array([[x, y] for x in (left, right) for y in (bottom, min(top, HIGHEST[top > TALLER]))])
    views = zip(sighting.way.pixels(sighting.s, corners), sighting.way.rig.cameras, strict=True)
    return all(((quad >= 0) & (quad <= np.array(camera.image_size) - 1)).all() for quad, camera in views)


def _size(sighting: Sighting) -> float:
    """Pixels per metre."""
    left = sighting.way.pixels(sighting.s, sighting.middle + np.array([[-0.5, 0.5], [0.5, 0.5]]))[0]
    return float(np.linalg.norm(left[1] - left[0]))


def _window(x: Span, y: Span) -> tuple[slice, slice]:
    """Rows and columns of the fine grid within a rectangle."""
    columns, rows = (
        np.flatnonzero((FINE.x >= x[0]) & (FINE.x <= x[1])),
        np.flatnonzero((FINE.y >= y[0]) & (FINE.y <= y[1])),
    )
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _lay_on_each_other(sightings: list[Sighting], reference: Sighting, x: Span, y: Span) -> list[Aligned]:
    """Where each sighting has what the ``reference`` shows inside a rectangle: from one frame to the next."""
    rows, columns = _window(x, y)
    s = _where_views_agree(reference, rows, columns)
    if s is None:
        return []
    usual = float(np.clip(s - reference.s, -REACH[0], REACH[0]))
    first = Aligned(reference, s, np.array([reference.middle, 0.0]), 1.0)
    template = first.cards()[0][rows, columns]
    start, found = sightings.index(reference), [first]
    for others in (sightings[start + 1 :], sightings[:start][::-1]):
        near = first
        for sighting in others:
            at = _searched(sighting, template, rows, columns, near.on(sighting.way), usual)
            if at.score >= MATCHED:
                found.append(at)
                near = at
    return sorted(found, key=lambda at: at.sighting.frame)


def _where_views_agree(sighting: Sighting, rows: slice, columns: slice) -> float | None:
    """The arc length at which the two views of a face agree over the largest part of a window; or, of those at which
    they do over much of it, that at which they fit each other far more sharply: the wide light about lamps agrees
    anywhere. None where that is the end of what is looked at."""
    origin, reach = np.array([sighting.middle, 0.0]), sighting.error(*REACH)
    ahead, found = np.linspace(-reach, reach, STEPS), []
    for s in sighting.s + ahead:
        left, right = (Texture(card, WINDOW) for card in sighting.cards(float(s), FINE, origin))
        area = (agreement(left, right) * _textured(left))[rows, columns].sum()
        found.append((area, _fit(left.image[rows, columns], right.image[rows, columns])))
    areas, fits = np.array(found, float).T
    best, heights = int(np.argmax(areas)), areas
    fitting = np.where(areas >= SHARPER[0] * areas[best], fits, -1.0)
    sharp = int(np.argmax(fitting))
    if 1.0 - fits[sharp] < SHARPER[1] * (1.0 - fits[best]):
        best, heights = sharp, fits
    if not areas[best] > 0.0 or not 0 < best < STEPS - 1:
        return None
    return float(sighting.s + ahead[best] + parabola_peak_at(heights, best) * (ahead[1] - ahead[0]))


def _fit(left: Image, right: Image) -> float:
    """The correlation of two pictures (H, W) as a whole; 0 where either has no contrast."""
    a, b = left - left.mean(), right - right.mean()
    contrast = float(np.sqrt((a * a).mean() * (b * b).mean()))
    return float((a * b).mean()) / contrast if contrast > FLAT else 0.0


def _textured(texture: Texture) -> Image:
    """How much each place has to say, 0 to 1: strong edges count no more than clear ones."""
    return np.asarray(np.clip(texture.std / (4 * CONTRAST), 0.0, 1.0) * (texture.std > CONTRAST), np.float32)


def _searched(sighting: Sighting, template: Image, rows: slice, columns: slice, origin: Array, usual: float) -> Aligned:
    """Where both views of a sighting look most like the ``template``: about the ``origin`` that it has in a frame near
    by, at its height rather than not, and about the ``usual`` metres past where the sighting is."""
    along, reach = sighting.error(*REACH), round(SHIFT / FINE.cell)
    off, found, moves = np.linspace(-1.0, 1.0, STEPS), [], []
    ahead = usual + along * off
    raised = RAISED * np.linspace(-1.0, 1.0, 2 * reach + 1, dtype=np.float32)[:, None] ** 2
    for s in sighting.s + ahead:
        cards = sighting.cards(float(s), FINE, origin)
        left, right = (_match(card, template, rows, columns, reach) for card in cards)
        alike = 0.5 * (left + right)
        likely = alike - raised
        peak = np.unravel_index(int(np.argmax(likely)), likely.shape)
        found.append((alike[peak], likely[peak]))
        moves.append(_subpixel(likely, peak) - reach)
    scores, preferred = np.array(found, float).T
    preferred -= UNUSUAL * off**2
    best = int(np.argmax(preferred))
    s = sighting.s + ahead[best] + parabola_peak_at(preferred, best) * (ahead[1] - ahead[0])
    down, across = moves[best]
    return Aligned(sighting, float(s), origin + np.array([across, -down]) * FINE.cell, float(scores[best]))


def _match(card: Image, template: Image, rows: slice, columns: slice, reach: int) -> Image:
    pad = cv2.copyMakeBorder(card, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    window = np.ascontiguousarray(pad[rows.start : rows.stop + 2 * reach, columns.start : columns.stop + 2 * reach])
    scores = cv2.matchTemplate(window, np.ascontiguousarray(template), cv2.TM_CCOEFF_NORMED)
    return np.asarray(np.nan_to_num(scores, nan=-1.0, posinf=-1.0, neginf=-1.0), np.float32)


def _subpixel(scores: Image, peak: tuple[np.intp, ...]) -> Array:
    row, column = int(peak[0]), int(peak[1])
    return np.array(
        [
            row + parabola_peak_at(scores[:, column].astype(float), row),
            column + parabola_peak_at(scores[row].astype(float), column),
        ]
    )


def _rectangle(aligned: list[Aligned], reference: Sighting) -> Face | None:
    """The rectangle in which all that is aligned agrees with the reference most."""
    first = next(a for a in aligned if a.sighting is reference)
    template = Texture(first.cards()[0], WINDOW)
    correlations, changes = [], []
    for a in aligned:
        views, before = ([Texture(card, WINDOW) for card in cards] for cards in (a.cards(), a.cards_before()))
        correlations += [correlation(template, view) for view in views[a is first :]]
        changes += [correlation(view, scene) <= SAME for view, scene in zip(views, before, strict=True)]
    agreement = np.median(correlations, axis=0)  # a shadow that passes over a face is there in few frames
    changed = np.mean(changes, axis=0)
    beside = np.abs(FINE.x) > 0.5 * (reference.x[1] - reference.x[0])
    agreement[(changed < SELDOM) & beside] = 0.0  # what was there before looks the same in all frames as well
    weight = _textured(template)
    highest, widest = HIGHEST[reference.y[1] > TALLER], _widest(reference)
    narrowest = max(NARROWEST, MOST_OF * min(reference.x[1] - reference.x[0], widest))
    cell = COARSE * FINE.cell
    widths = round((narrowest + 2 * INSET) / cell), round((widest + 2 * INSET) / cell)
    middle = len(FINE.x[::COARSE]) // 2
    for agreed in AGREED:
        votes = _votes(agreement, weight, agreed)
        votes[FINE.y > highest] = -1.0
        found = best_rectangle(votes[::COARSE, ::COARSE], round((LOWEST + 2 * INSET) / cell), widths, middle)
        if found is not None:
            break
    else:
        return None
    top, bottom, left, right = (COARSE * k for k in found)
    x, y = FINE.x[[left, min(right, len(FINE.x)) - 1]], FINE.y[[min(bottom, len(FINE.y)) - 1, top]]
    part = np.s_[top:bottom, left:right]
    return Face(_inset(x), _inset(y), aligned, float(_votes(agreement[part], weight[part], AGREED[-1]).sum()))


def _widest(reference: Sighting) -> float:
    """How wide a rectangle may be on what is as large as the ``reference``, m."""
    width = reference.x[1] - reference.x[0]
    return WIDEST[1] if reference.y[1] > TALLER or width < PART else float(np.clip(width, *WIDEST))


def _votes(agreement: Image, weight: Image, agreed: float) -> Array:
    """What each place (rows, columns) says for a rectangle that holds it, if it takes ``agreed`` to speak for it."""
    return np.asarray((np.maximum(agreement, 0.0) - agreed) * weight - COST, float)


def _inset(span: Array) -> Span:
    return float(span[0]) + INSET, float(span[1]) - INSET


def best_rectangle(votes: Array, height: int, widths: tuple[int, int], column: int) -> tuple[int, int, int, int] | None:
    """The rows and columns, from where and to before where, of the rectangle of ``votes`` (H, W) with the largest sum,
    at least ``height`` high and between ``widths`` wide, that holds a ``column``; None where no sum is positive."""
    H, W = votes.shape
    narrowest, widest = widths
    sums = np.zeros((H + 1, W + 1))
    sums[1:, 1:] = votes.cumsum(0).cumsum(1)
    best, where = 0.0, None
    for top in range(H - height + 1):
        rows = sums[top + height :] - sums[top]  # (bottoms, W + 1): sums from the left
        for width in range(narrowest, min(widest, W) + 1):
            first, last = max(column + 1 - width, 0), min(column, W - width)
            gains = rows[:, first + width : last + width + 1] - rows[:, first : last + 1]
            bottom, left = np.unravel_index(int(np.argmax(gains)), gains.shape)
            if gains[bottom, left] > best:
                best = float(gains[bottom, left])
                where = (top, top + height + int(bottom), first + int(left), first + int(left) + width)
    return where
