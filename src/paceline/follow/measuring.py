"""Stages 1 to 4 of [NIST] in one image: from where the target is expected to where its features show it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import hypot

import numpy as np
from numpy.typing import NDArray

from paceline.follow import association, candidates, fitting
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.edges import EdgeExtractor, EdgeLists, Window, window_around
from paceline.follow.features import Features, Projection
from paceline.follow.fitting import Fit
from paceline.follow.ranging import recorded

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Indices = NDArray[np.int64]

FINEST = 0.8  # px: how far an edge point may be from its line, and at a close look
FINE = 0.008  # the same as a share of the target's size
SAMPLING = 0.2  # px: what the grid of pixels leaves uncertain of a line
CREDIBLE = 3.0  # times as large or as small as expected, it is something else


@dataclass(frozen=True, eq=False)
class Measurement:
    """A ``fit``, the edge ``points`` (M, 2) px that were believed and their ``owners`` (M,), what each feature may be
    off, with the model's own errors: ``allowed`` (S,) px, and how much of its length is found: ``shares`` (S,)."""

    fit: Fit
    points: Array
    owners: Indices
    allowed: Array
    shares: Array

    @property
    def residual(self) -> float:
        """px rms of the features' places about the fitted ones."""
        return float(np.sqrt((self.fit.offsets[self.fit.used] ** 2).mean()))

    @cached_property
    def discord(self) -> float:
        """The same, relative to what is allowed."""
        return float(np.sqrt(((self.fit.offsets / self.allowed)[self.fit.used] ** 2).mean()))

    @cached_property
    def match(self) -> float:
        """How much of the model shows, 0 to 1: the mean of all features' shares, each the less the more it is off.

        A long line counts as a short one: what only looks like the target has the long lines in common with it.
        """
        off = np.where(self.fit.used, self.fit.offsets, np.inf) / self.allowed
        return float(self.shares @ np.exp(-0.5 * off * off)) / len(off)

    @cached_property
    def agreeing(self) -> NDArray[np.bool_]:
        """(S,): the features that lie where the model has them."""
        return self.fit.used & (np.abs(self.fit.offsets) < 1.5 * self.allowed)


class Measurer:
    """Measures one target in images of one size."""

    def __init__(self, projection: Projection, configuration: FollowConfiguration) -> None:
        self._projection, self._c = projection, configuration
        self._vertical = projection.target.vertical
        self._magnification = float(projection.magnification.mean())
        self._edges = EdgeExtractor(projection.camera.image_size, configuration)
        self._owners = np.empty((2, self._edges.capacity), np.int64)

    def measure(self, image: Bytes, start: Array, doubt: Array, brighter: Indices) -> tuple[Measurement | None, Window]:
        """The target in ``image`` (H, W) about ``start`` (3,), known to within ``doubt`` (3,), and the window that was
        looked at; None where its features do not tell where it is.

        A feature whose ``brighter`` (S,) is 1 or −1 takes only edges with a step of this sign.
        """
        c, projection = self._c, self._projection
        size = projection.size(start[2])
        breadth = max(FINEST, FINE * size)
        gate = c.gate
        if c.predicted_gates:
            gate = 3.0 * max(hypot(doubt[0], 0.5 * size * doubt[2] / start[2]), doubt[1]) + breadth
            gate = min(gate, 0.25 * size + breadth)
        half = 0.5 * projection.target.size * projection.magnification * start[2] + gate + 2.0
        window = window_around(recorded(projection.camera, start[:2]), half, projection.camera.image_size)
        edges = self._edges.extract(image, window)  # stage 1
        x, fit = start, None
        for reach in (gate, min(gate, 3.0 * breadth)) if c.competing_lines else (gate,):
            features = projection.features(x)  # stage 7
            self._associate(edges, features, reach, brighter)  # stage 2
            places, weights = self._locate_features(image, edges, features, x, doubt, reach, breadth, brighter)  # 3
            turned = fitting.TURNED if c.foreshortening else 0.0
            fit = fitting.locate(
                places - features.shifts, weights, self._vertical, projection.offsets, x[2], turned
            )  # stage 4
            if fit is None or not 1 / CREDIBLE < fit.location[2] / start[2] < CREDIBLE:
                return None, window
            x, doubt = fit.location, np.minimum(doubt, 0.5 * breadth)
        assert fit is not None
        allowed = np.sqrt(breadth**2 + self._tolerance(fit.location))
        shares = np.zeros(len(places))
        for points, upright, owners in zip(edges, (True, False), self._owners, strict=True):
            candidates.add_shares(points, owners, upright, places, features.lengths, breadth, shares)
        return Measurement(fit, *self._believed(edges, fit), allowed, np.minimum(shares, 1.0)), window

    def _associate(self, edges: EdgeLists, features: Features, reach: float, brighter: Indices) -> None:
        gates = np.full(len(features.places), reach)
        for points, upright, owners in zip(edges, (True, False), self._owners, strict=True):
            association.associate(
                points, upright, self._vertical, features.places, features.spans, gates, brighter, owners
            )

    def _locate_features(
        self,
        image: Bytes,
        edges: EdgeLists,
        features: Features,
        start: Array,
        doubt: Array,
        reach: float,
        breadth: float,
        brighter: Indices,
    ) -> tuple[Array, Array]:
        """The place and the confidence (S,) of each feature."""
        c, vertical, n = self._c, self._vertical, len(features.places)
        lists = list(zip(edges, (True, False), self._owners, strict=True))
        if not c.competing_lines:
            places, weights = np.empty(n), np.empty(n)
            for points, upright, owners in lists:
                fitting.locate_features(
                    points,
                    owners,
                    upright,
                    features.lengths,
                    c.minimum_share,
                    c.variance_floor,
                    places,
                    weights,
                    vertical,
                )
            return places, weights
        lines, gates = np.zeros((n, candidates.CANDIDATES, 3)), np.full(n, reach)
        for points, upright, owners in lists:
            candidates.candidate_lines(points, owners, upright, features.places, gates, breadth, vertical, lines)
        if c.faint_lines:
            candidates.faint_lines(
                image,
                features.places,
                features.spans,
                reach,
                vertical,
                brighter,
                c.minimum_share,
                c.edge_threshold,
                lines,
            )
        lines[:, :, 0] -= features.shifts[:, None]
        tolerance = self._tolerance(start)
        places, weights = fitting.robust_lines(
            lines,
            start,
            doubt,
            vertical,
            self._projection.offsets,
            features.lengths,
            c.minimum_share,
            c.variance_floor,
            tolerance,
            breadth,
        )
        return places + features.shifts, weights

    def _tolerance(self, location: Array) -> Array:
        """(S,) px²: the variance of each feature's true place about the model's.

        The model is drawn as it looks from its nominal range z0. A horizontal line Y below the camera's axis that
        stands δ nearer than the rear plane appears lower by Y·δ·(1/z − 1/z0) at the range z.
        """
        c, projection = self._c, self._projection
        z0 = projection.target.nominal_range
        per_metre = self._magnification * location[2]
        below = (location[1] + location[2] * projection.offsets - projection.camera.K[1, 2]) / per_metre
        relief = np.where(self._vertical, 0.0, c.relief_tolerance * below * (location[2] - 1.0) / z0)
        return np.asarray((c.model_tolerance**2 + relief**2) * per_metre**2 + SAMPLING**2)

    def _believed(self, edges: EdgeLists, fit: Fit) -> tuple[Array, Indices]:
        chosen, owned = [], []
        for points, owners in zip(edges, self._owners, strict=True):
            mine = owners[: len(points)]
            keep = np.flatnonzero(mine >= 0)
            keep = keep[fit.used[mine[keep]]]
            chosen.append(points[keep, :2])
            owned.append(mine[keep])
        return np.concatenate(chosen).astype(float), np.concatenate(owned)
