"""The parts above the band of a hull: bonnet, windscreen, side panes, roof, rear pane and boot."""

from __future__ import annotations

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import NamedMesh
from paceline.simulation.raytraced.vehicles.hull import HullShape, Point
from paceline.simulation.raytraced.vehicles.sheet_metal import BodyBand, interpolate, loft_surface

# Rows: belt, foot of the side panes, their head, border of windscreen and roof, half-way, middle.
_ROW_ROUNDING = [0.0, 0.08, 0.1, 0.12, 0.5, 0.0]
_DECK_ROW_OFFSETS = np.array([1.0, 0.985, 0.95, 0.86, 0.45, 0.0])  # share of the half width, over bonnet and boot
_DECK_ROW_DROPS = np.array([1.0, 0.6, 0.34, 0.17, 0.04, 0.0])  # share of the middle's height above the belt


def loft_cabin(form: HullShape, band: BodyBand) -> list[NamedMesh]:
    """The left half of all above the band."""
    loft = _Loft(form, band)
    _bonnet(form, band, loft)
    loft.foot(form.cowl, 1.0, "windscreen")
    _panes(form, loft)
    loft.foot(form.rear_base, -1.0, "deck")
    _boot(form, band, loft)
    return loft.surface()


def _bonnet(f: HullShape, b: BodyBand, loft: _Loft) -> None:
    lip = float(b.points(0.0, b.high)[0])
    corner = f.front - f.bow
    length, rise = corner - f.cowl[0], f.cowl[1] - f.lip
    loft.deck(b.across(0.9 * f.half, "front"), (lip, f.lip), 0.0, "deck")
    if length > 0.25:
        loft.deck(b.at(corner - 0.18 * length), (lip - 0.1 * length, f.lip + 0.3 * rise), 0.5, "deck")
        loft.deck(b.at(corner - 0.55 * length), (lip - 0.55 * length, f.lip + 0.72 * rise), 0.5, "deck")
    loft.deck(b.at(f.cowl[0] - f.wrap + 0.09), (f.cowl[0] + 0.09, f.cowl[1] - 0.012), 0.1, "cowl")


def _panes(f: HullShape, loft: _Loft) -> None:
    """Stations from the windscreen's head to that of the rear pane."""
    bend = 0.4 * f.wrap
    middle = (f.header[0] + f.rear_header[0]) / 2
    ridge = interpolate([f.rear_header, (middle, f.header[1] + 0.025), f.header])

    def roof(x: float) -> Point:
        return x, float(ridge(np.array(x)))

    loft.post(f.header[0] - bend, f.header, bend, 0.16, "pane")
    borders = [x for pane in f.panes for x in pane][1:]
    for k, x in enumerate(borders[:-1]):
        loft.post(x, roof(x), 0.0, 0.05, "pillar" if k % 2 == 0 else "pane")
    loft.post(borders[-1], roof(max(borders[-1], f.rear_header[0] + 0.12)), 0.0, 0.05, "panel")
    loft.post(f.rear_header[0], f.rear_header, -0.3 * f.wrap, 0.12, "rear pane" if f.rear_pane else "panel")


def _boot(f: HullShape, b: BodyBand, loft: _Loft) -> None:
    end = b.points(b.length, b.high)
    if f.rear_base[0] - end[0] > 0.25:
        x = (f.rear_base[0] + f.rear) / 2
        loft.deck(b.at(x), (x, f.deck + 0.6 * (f.rear_base[1] - f.deck)), 0.5, "deck")
    loft.deck(b.across(0.9 * f.half, "rear"), (float(end[0]), float(end[2])), 0.0, "deck")


_SEGMENT_MATERIALS = {  # of the five strips between the rows, by the kind of the stations' segment
    "deck": ("paint",) * 5,
    "cowl": ("plastic",) * 5,
    "windscreen": ("plastic", "glass", "paint", "glass", "glass"),
    "pane": ("plastic", "glass", "paint", "paint", "paint"),
    "pillar": ("plastic", "plastic", "paint", "paint", "paint"),
    "panel": ("paint",) * 5,
    "rear pane": ("paint", "paint", "paint", "glass", "glass"),
}


class _Loft:
    """Stations across the left half, from front to rear; ``kind`` is that of the segment behind a station."""

    def __init__(self, form: HullShape, band: BodyBand) -> None:
        self.form, self.band = form, band
        self.net: list[Array] = []
        self.q: list[float] = []  # of the stations' feet on the band
        self.soft: list[float] = []
        self.kinds: list[str] = []

    def _add(self, q: float, rows: Array, soft: float, kind: str) -> None:
        self.net.append(rows)
        self.q.append(q)
        self.soft.append(soft)
        self.kinds.append(kind)

    def deck(self, q: float, middle: Point, soft: float, kind: str) -> None:
        """A station over bonnet or boot, whose ``middle`` is (x, z)."""
        foot, (x, z) = self.band.points(q, self.band.high), middle
        along = foot[0] + (x - foot[0]) * (1 - _DECK_ROW_OFFSETS**2)
        self._add(
            q, np.column_stack([along, _DECK_ROW_OFFSETS * foot[1], z - (z - foot[2]) * _DECK_ROW_DROPS]), soft, kind
        )

    def post(self, x: float, middle: Point, bend: float, soft: float, kind: str) -> None:
        """A station over side panes and roof from x at the belt; the roof's border is ``distort`` behind its middle."""
        f, q = self.form, self.band.at(x)
        foot, (roof_x, roof) = self.band.points(q, self.band.high), middle
        edge, gap = roof_x - bend, 0.32 * (f.header[1] - f.belt)
        rows = [
            foot,
            foot + [0.0, -0.02, 0.012],
            (edge - 0.02, f.half_roof + 0.02, roof - 0.35 * gap),
            (edge, f.half_roof - 0.055, roof - 0.1 * gap),
            (roof_x - 0.3 * bend, 0.5 * f.half_roof, roof - 0.012),
            (roof_x, 0.0, roof),
        ]
        self._add(q, np.array(rows), soft, kind)

    def foot(self, middle: Point, sign: float, kind: str) -> None:
        """The foot of the windscreen (sign 1) or of the rear pane (-1), wrapped round to the sides."""
        f, (x, z) = self.form, middle
        wrap = sign * f.wrap * (1.0 if sign > 0 else 0.6)
        q = self.band.at(x - wrap)
        foot = self.band.points(q, self.band.high)
        rows = [
            foot,
            foot + [0.0, -0.02, 0.012],
            foot + [0.1 * wrap, -0.045, 0.03],
            (foot[0] + 0.3 * wrap, foot[1] - 0.045 - f.pillar, z - 0.012),
            (x - 0.2 * wrap, 0.45 * foot[1], z - 0.003),
            (x, 0.0, z),
        ]
        self._add(q, np.array(rows), 0.06, kind)

    def surface(self) -> list[NamedMesh]:
        ends = [[self.band.across(float(y), end) for y in self.net[k][:, 1]] for k, end in ((0, "front"), (-1, "rear"))]

        def names(u: int, v: int) -> str:
            return _SEGMENT_MATERIALS[self.kinds[u]][v]

        return loft_surface(self.band, np.array(self.net), (self.q, *ends), (self.soft, _ROW_ROUNDING), names)
