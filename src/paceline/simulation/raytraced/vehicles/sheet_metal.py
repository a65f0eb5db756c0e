"""The sheet metal of a vehicle: a band all round it that carries relief, and a top of bonnet, cabin and boot.

Both are built for the left half, seen from outside, and mirrored. A band is addressed by ``q``, metres along its plan
outline from the middle of the front over the left side to the middle of the rear, and by the height ``z``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from paceline.arrays import Array, Indices
from paceline.simulation.raytraced.mesh_builders import Mesh, NamedMesh, sheet

Curve = Callable[[Array], Array]


def interpolate(points: Sequence[tuple[float, float]]) -> Curve:
    """A curve through points whose first coordinate grows, without overshoot; its ends' values hold beyond them."""
    x, y = np.array(points, float).T
    curve = PchipInterpolator(x, y)
    return lambda at: np.asarray(curve(np.clip(at, x[0], x[-1])))


def smoothing_weights(reach: ArrayLike, straight: int = 2, corner: int = 2) -> tuple[Array, Indices]:
    """Weights (M, N) that turn N control points into a smooth line, and the control segment (M - 1,) of each piece.

    The line is a quadratic B-spline with tightened corners: around control point k a parabola takes the place of the
    corner over the fraction ``reach[k]``, at most one half, of both its segments; 0 leaves it sharp. The first and the
    last point stay.
    """
    r = np.asarray(reach, float)
    n = len(r)
    rows: list[Array] = []
    segments: list[int] = []

    def arc(k: int, t: float) -> Array:
        w = np.zeros(n)
        if 0 < k < n - 1:
            w[k - 1], w[k + 1] = r[k] * (1 - t) ** 2, r[k] * t**2
        w[k] += 1 - w.sum()
        return w

    for k in range(n - 1):
        leave = [arc(k, t) for t in np.linspace(0.5, 1, corner + 1)] if k > 0 and r[k] > 0 else [arc(k, 1.0)]
        arrive = [arc(k + 1, t) for t in np.linspace(0, 0.5, corner + 1)]
        if k + 1 == n - 1 or r[k + 1] == 0:
            arrive = arrive[:1]
        between = [leave[-1] + u * (arrive[0] - leave[-1]) for u in np.linspace(0, 1, straight + 1)[1:-1]]
        piece = [*leave, *between, *arrive]
        rows += piece if not rows else piece[1:]
        segments += [k] * (len(piece) - 1)
    return np.array(rows), np.array(segments)


@dataclass(frozen=True)
class PanelFeature:
    """A rectangle of a band made of ``name``, ``depth`` m out of it (negative: recessed), ``bevel`` m wide sides."""

    name: str
    q: tuple[float, float]
    z: tuple[float, float]
    depth: float = 0.0
    bevel: float = 0.006

    def lines(self, span: tuple[float, float]) -> list[float]:
        low, high = span
        return [low, high] if self.depth == 0 else [low, low + self.bevel, high - self.bevel, high]


@dataclass(frozen=True)
class BandRows:
    """The heights of a band's rows: nominal ones, from ``low`` to ``high``, become true ones as its borders ask.

    ``bottom`` and ``top`` are the borders' true heights over x. Rows above the second of the ``knees`` follow the upper
    border, rows below the first the lower one.
    """

    low: float
    high: float
    knees: tuple[float, float]
    bottom: Curve
    top: Curve

    def true(self, x: Array, z: Array) -> Array:
        """True heights of nominal heights z at x."""
        lower, upper = self.knees
        up = np.clip((z - upper) / (self.high - upper), 0, 1) * (self.top(x) - self.high)
        down = np.clip((lower - z) / (lower - self.low), 0, 1) * (self.bottom(x) - self.low)
        return np.asarray(z + up + down)

    def nominal(self, z: float, top: float) -> float:
        """Nominal height of true height z where the upper border is at ``top``, away from wheel arches."""
        upper = self.knees[1]
        return z if z <= upper else upper + (z - upper) * (self.high - upper) / (top - upper)


class BodyBand:
    """The walls of a body below its belt.

    ``plan`` (N, 2) are control points of x and y of the left half's outline, from the front; ``section`` widens it by a
    factor over nominal z, ``front`` and ``rear`` move its ends outwards (m over nominal z).
    """

    def __init__(self, plan: ArrayLike, rows: BandRows, section: Curve, front: Curve, rear: Curve) -> None:
        control = np.asarray(plan, float)
        self.outline = smoothing_weights(np.full(len(control), 0.5), 12, 12)[0] @ control
        self.q = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.outline, axis=0), axis=1))])
        self.length = float(self.q[-1])
        self.rows, self.section, self.front, self.rear = rows, section, front, rear

    @property
    def high(self) -> float:
        return self.rows.high

    def nominal(self, z: float, top: float) -> float:
        return self.rows.nominal(z, top)

    def at(self, x: float) -> float:
        """q of the place on the side whose outline has this x."""
        return float(np.interp(-x, -self.outline[:, 0], self.q))

    def across(self, y: float, end: str) -> float:
        """q of the place on an end whose outline has this y."""
        half = len(self.q) // 2
        if end == "front":
            return float(np.interp(y, self.outline[:half, 1], self.q[:half]))
        return float(np.interp(y, self.outline[:half:-1, 1], self.q[:half:-1]))

    def points(self, q: ArrayLike, z: ArrayLike, out: ArrayLike = 0.0) -> Array:
        """Points (..., 3) at q and nominal height z, ``out`` m outside the wall."""
        q, z, out = np.broadcast_arrays(np.asarray(q, float), np.asarray(z, float), np.asarray(out, float))
        e = 0.02  # m to both sides, for the direction of the outline
        before, position, after = (
            np.stack([np.interp(q + d, self.q, self.outline[:, k]) for k in (0, 1)]) for d in (-e, 0, e)
        )
        dx, dy = after - before
        ends = (q < e) | (q > self.length - e)  # where the outline crosses the middle, straight across
        normal_x = np.where(ends, np.sign(dy), dy / np.hypot(dx, dy))
        normal_y = np.where(ends, 0.0, -dx / np.hypot(dx, dy))
        x, y = position
        ahead, behind = ((x - self.outline[0, 0]) / 0.5 + 1.5, (self.outline[-1, 0] - x) / 0.5 + 1.5)
        end_offset = _smoothstep(ahead) * self.front(z) - _smoothstep(behind) * self.rear(z)
        return np.stack(
            [x + end_offset + out * normal_x, y * self.section(z) + out * normal_y, self.rows.true(x, z)], -1
        )

    def wall(
        self,
        q: tuple[float, float],
        z: tuple[float, float],
        features: Iterable[PanelFeature],
        name: str = "paint",
        step: tuple[float, float] = (0.09, 0.08),
        more: Sequence[float] = (),
    ) -> list[NamedMesh]:
        """The wall over the ranges ``q`` and ``z`` with its features, later ones over earlier ones, and ``name``
        elsewhere. The grid has lines at all borders of features and at ``more`` (q), none farther apart than ``step``.
        """
        features = list(features)
        columns = _grid_lines([*q, *more, *(v for f in features for v in f.lines(f.q))], q, step[0])
        rows = _grid_lines([*z, *(v for f in features for v in f.lines(f.z))], z, step[1])[::-1]
        Q, Z = np.meshgrid(columns, rows)
        depth = np.zeros_like(Q)
        kind = np.zeros((len(rows) - 1, len(columns) - 1), int)
        mid_q, mid_z = (columns[1:] + columns[:-1]) / 2, ((rows[1:] + rows[:-1]) / 2)[:, None]
        for k, f in enumerate(features, 1):
            inset = f.bevel - 1e-6 if f.depth else -1e-6
            within = (f.q[0] + inset <= Q) & (f.q[1] - inset >= Q) & (f.z[0] + inset <= Z) & (f.z[1] - inset >= Z)
            depth[within] = f.depth
            kind[(f.q[0] < mid_q) & (mid_q < f.q[1]) & (f.z[0] < mid_z) & (mid_z < f.z[1])] = k
        wall_mesh = sheet(self.points(Q, Z, depth))
        return split_by_kind(wall_mesh, kind, [name, *(f.name for f in features)])


def split_by_kind(mesh: Mesh, kind: Indices, names: Sequence[str]) -> list[NamedMesh]:
    """A sheet's cells (H - 1, W - 1) parted by their ``kind``, an index into ``names``; names of "" are left out."""
    per_triangle = np.repeat(kind.reshape(-1), 2)
    return [
        (names[k], Mesh(mesh.vertices, mesh.triangles[per_triangle == k], mesh.uv)) for k in np.unique(kind) if names[k]
    ]


def loft_surface(
    band: BodyBand,
    net: ArrayLike,
    borders: Sequence[ArrayLike],
    reach: tuple[ArrayLike, ArrayLike],
    names: Callable[[int, int], str],
) -> list[NamedMesh]:
    """The surface over a net of control points (U, V, 3), stations from front to rear by rows from the left border to
    the middle.

    Its side, front and rear ``borders`` are drawn to the band's upper edge at the q (U,), (V,), (V,) of their control
    points; ``reach`` is as in `smoothing_weights`, ``names(u, v)`` what the control cells are made of.
    """
    (wu, su), (wv, sv) = smoothing_weights(reach[0], 3, 2), smoothing_weights(reach[1], 3, 2)
    points = np.einsum("mu,uvc,nv->mnc", wu, np.asarray(net, float), wv)
    side, front, rear = (
        band.points(w @ np.asarray(q, float), band.high) for w, q in zip((wu, wv, wv), borders, strict=True)
    )
    points += (wu[:, 0] + 0.5 * wu[:, 1])[:, None, None] * (front - points[0])
    points += (wu[:, -1] + 0.5 * wu[:, -2])[:, None, None] * (rear - points[-1])
    points += (wv[:, 0] + 0.5 * wv[:, 1])[:, None] * (side - points[:, 0])[:, None]
    tags = [[names(int(a), int(b)) for b in sv] for a in su]
    known = sorted({t for row in tags for t in row})
    kind = np.array([[known.index(t) for t in row] for row in tags])
    return split_by_kind(sheet(points), kind, known)


def _grid_lines(lines: Iterable[float], span: tuple[float, float], step: float) -> Array:
    """All ``lines`` within ``span`` and as many between them that none are farther apart than ``step``; ascending."""
    x = np.unique(np.round([v for v in lines if span[0] - 1e-9 <= v <= span[1] + 1e-9], 5))
    pieces = [np.linspace(a, b, int(np.ceil((b - a) / step)) + 1)[:-1] for a, b in zip(x[:-1], x[1:], strict=True)]
    return np.concatenate([*pieces, x[-1:]])


def _smoothstep(u: Array) -> Array:
    u = np.clip(u, 0, 1)
    return np.asarray(u * u * (3 - 2 * u))
