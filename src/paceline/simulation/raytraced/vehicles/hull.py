"""The hull of cars, vans, buses and cabs: its dimensions, and the band with wheel arches, doors and ends."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from paceline.arrays import Array
from paceline.simulation.raytraced.mesh_builders import NamedMesh, box
from paceline.simulation.raytraced.vehicles.parts import wheel_arch_liner
from paceline.simulation.raytraced.vehicles.sheet_metal import BandRows, BodyBand, PanelFeature, interpolate

Point = tuple[float, float]


@dataclass(frozen=True)
class HullShape:
    """Measures of a hull in body axes, metres. x falls from ``front`` over the points of the roof line — the
    windscreen's foot ``cowl``, ``header``, ``rear_header``, the rear pane's foot ``rear_base``, each (x, z) — to
    ``rear``.

    The band reaches from ``low`` to the heights ``lip`` at the front, ``belt`` beside the cabin and ``deck`` at the
    rear; above ``knee`` its rows follow that border. ``section`` holds (z, share of the width) of its sides, ``bumps``
    and ``tail`` (z, x) of the front's and the rear's profile, outwards positive; ``bow`` and ``rear_bow`` are how far
    the corners lie behind the middles. ``panes`` are the x of the side windows' borders, in pairs from the front;
    ``wrap`` is how far the windscreen's corners lie behind its middle, ``half_roof`` half the roof's width.
    """

    front: float
    rear: float
    half: float
    low: float
    lip: float
    belt: float
    deck: float
    cowl: Point
    header: Point
    rear_header: Point
    rear_base: Point
    half_roof: float
    panes: tuple[Point, ...]
    bumps: tuple[Point, ...]
    tail: tuple[Point, ...]
    section: tuple[Point, ...]
    axles: tuple[float, ...]
    knee: float
    arch: float = 0.36
    axle_height: float = 0.31
    bow: float = 0.2
    rear_bow: float = 0.16
    wrap: float = 0.24
    pillar: float = 0.11
    doors: tuple[float, ...] = ()
    rear_pane: bool = True
    side: tuple[PanelFeature, ...] = field(default=())


def hull_band(form: HullShape) -> BodyBand:
    """The hull's walls below its panes."""
    f, w = form, form.half
    middle = (f.front + f.rear) / 2
    plan = [
        (f.front, 0.0),
        (f.front, 0.3 * w),
        (f.front - 0.3 * f.bow, 0.72 * w),
        (f.front - f.bow, 0.985 * w),
        (f.front - f.bow - 0.55, w),
        (middle, w),
        (f.rear + f.rear_bow + 0.5, w),
        (f.rear + f.rear_bow, 0.985 * w),
        (f.rear + 0.25 * f.rear_bow, 0.7 * w),
        (f.rear, 0.3 * w),
        (f.rear, 0.0),
    ]
    upper = interpolate(
        [
            (f.rear, f.deck),
            (f.rear + f.rear_bow, f.deck),
            (max(f.rear_header[0], f.rear + f.rear_bow + 0.4), f.belt),
            (f.cowl[0] - f.wrap, f.belt),
            (f.front - f.bow, f.lip),
            (f.front, f.lip),
        ]
    )

    def lower(x: Array) -> Array:
        distance = np.min([np.abs(x - axle) for axle in f.axles], axis=0)
        round_wheel = f.axle_height + np.sqrt(np.maximum(f.arch**2 - distance**2, 0))
        return np.where(distance < f.arch, round_wheel, f.low)

    rows = BandRows(f.low, f.lip, (min(f.axle_height + f.arch + 0.05, f.lip), f.knee), lower, upper)
    section = interpolate([(rows.nominal(z, f.belt), wide) for z, wide in f.section])
    tail = interpolate([(rows.nominal(z, f.deck), out) for z, out in f.tail])
    return BodyBand(plan, rows, section, interpolate(f.bumps), tail)


def hull_walls(
    form: HullShape, b: BodyBand, front: Iterable[PanelFeature], rear: Iterable[PanelFeature]
) -> list[NamedMesh]:
    """The left half of a hull below its panes; its ends carry these features."""
    f = form
    corner, tail = b.at(f.front - f.bow - 0.1), b.at(f.rear + f.rear_bow + 0.1)
    arches, lines = _wheel_arches(f, b)
    seams = [PanelFeature("seam", (b.at(x) - 0.004, b.at(x) + 0.004), (f.low + 0.06, f.lip)) for x in f.doors]
    parts = b.wall((0.0, corner), (f.low, f.lip), front, "bumper")
    parts += b.wall(
        (corner, tail), (f.low, f.lip), [*seams, *f.side], "paint", (0.035 * (f.front - f.rear), 0.1), lines
    )
    parts += b.wall((tail, b.length), (f.low, f.lip), rear, "bumper")
    inner = f.half - 0.3
    block = box(
        [f.front - f.rear - 0.5, inner, f.lip - 0.05 - f.low], [(f.front + f.rear) / 2, inner / 2, (f.lip + f.low) / 2]
    )
    return [
        *parts,
        *arches,
        ("dark", block),
    ]


def _wheel_arches(f: HullShape, b: BodyBand) -> tuple[list[NamedMesh], list[float]]:
    """Linings of the wheel arches, and the q at which the wall follows them."""
    parts: list[NamedMesh] = []
    lines: list[float] = []
    for axle in f.axles:
        around = axle + (f.arch - 1e-4) * np.cos(np.linspace(0, np.pi, 15))
        q = np.array([b.at(float(x)) for x in around])
        ends = [b.at(axle + f.arch + 0.004), b.at(axle - f.arch - 0.004)]
        lines += [*q.tolist(), *ends]
        edge = b.points(q, f.low)
        feet = edge[[0, -1]] * [1, 1, 0] + [0, 0, f.low]
        edge = np.concatenate([feet[:1], edge, feet[1:]])
        parts.append(("dark", wheel_arch_liner(edge, 0.3)))
        lip = edge + [0, 0.006, 0]
        parts.append(("plastic", wheel_arch_liner(lip, 0.03)))
    return parts, lines
