"""Stages 1 to 4 of [NIST] in one image: from where the target is expected to where its features show it."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot

import numpy as np

from paceline.arrays import Array, Bytes, Indices, Mask
from paceline.follow import fitting, measuring_cpu
from paceline.follow.aspect import Aspect
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.edges import EdgeExtractor, EdgeLists, Window, window_around
from paceline.follow.features import Features, Projection
from paceline.follow.fitting import Fit
from paceline.follow.readout import stretch_deviation

FINEST = 0.8  # px: how far an edge point may be from its line, and at a close look
FINE = 0.008  # the same as a share of the target's size
UNKNOWN_ASPECT = Aspect()
CREDIBLE = 3.0  # times as large or as small as expected, it is something else


@dataclass(frozen=True, eq=False)
class Measurement:
    """A ``fit``, the edge ``points`` (M, 2) px that were believed and their ``owners`` (M,), and what is told of how
    well the features agree with it; see `measuring_cpu.agreement`."""

    fit: Fit
    points: Array
    owners: Indices
    residual: float  # px rms of the features' places about the fitted ones
    discord: float  # the same, relative to what each may be off
    match: float  # how much of the model shows, 0 to 1, of what the image can show
    support: float  # share of the length of its lines that agree, as well
    agreeing: Mask  # (S,): the features that lie where the model has them
    stretch: float = 0.0  # of its height by the image's readout, relative
    aspect: Aspect = UNKNOWN_ASPECT  # with what the image has told of it


class Measurer:
    """Measures one target in images of one size."""

    def __init__(self, projection: Projection, configuration: FollowConfiguration) -> None:
        self._projection, self._c = projection, configuration
        self._vertical = projection.target.vertical
        self._magnification = float(projection.magnification.mean())
        self._stretch_deviation = stretch_deviation(projection.camera) if configuration.rolling_shutter else 0.0
        self._edges = EdgeExtractor(projection.camera.image_size, configuration)
        self._owners = np.empty((2, self._edges.capacity), np.int64)

    def measure(
        self, image: Bytes, start: Array, doubt: Array, brighter: Indices, aspect: Aspect = UNKNOWN_ASPECT
    ) -> tuple[Measurement | None, Window]:
        """The target in ``image`` (H, W) about ``start`` (3,), known to within ``doubt`` (3,), and the window that was
        looked at; None where its features do not tell where it is.

        A feature whose ``brighter`` (S,) is 1 or −1 takes only edges with a step of this sign. By its ``aspect`` it is
        told how the readout has stretched the image.
        """
        c, projection = self._c, self._projection
        size = projection.size(start[2])
        breadth = max(FINEST, FINE * size)
        gate = c.gate
        if c.predicted_gates:
            gate = 3.0 * max(hypot(doubt[0], 0.5 * size * doubt[2] / start[2]), doubt[1]) + breadth
            gate = min(gate, 0.25 * size + breadth)
        half = 0.5 * projection.target.size * projection.magnification * start[2] + gate + 2.0
        window = window_around(projection.camera.distort_points(start[:2]), half, projection.camera.image_size)
        edges = self._edges.extract(image, window)  # stage 1
        x, fit, start_doubt, stretch, learned = start, None, doubt, 0.0, aspect
        for reach in (gate, min(gate, 3.0 * breadth)) if c.competing_lines else (gate,):
            features = projection.features(x)  # stage 7
            tolerance = self._tolerance(x)
            places, weights = self._places(  # stages 2 and 3
                image, edges, features, x, doubt, reach, breadth, brighter, tolerance
            )
            turned = fitting.TURNED if c.foreshortening else 0.0
            center = np.column_stack([start, start_doubt])[:2] if c.competing_lines else fitting.UNKNOWN
            straight = places - features.shifts
            ratio = fitting.height_over_width(straight, weights, self._vertical, projection.offsets)
            stretch, learned = aspect.learned(*ratio, self._stretch_deviation)
            offsets = np.where(self._vertical, 1.0, 1.0 + stretch) * projection.offsets
            fit = fitting.locate(straight, weights, self._vertical, offsets, x[2], turned, center)  # stage 4
            if fit is None or not 1 / CREDIBLE < fit.location[2] / start[2] < CREDIBLE:
                return None, window
            x, doubt = fit.location, np.minimum(doubt, 0.5 * breadth)
        assert fit is not None
        lists = edges.near_vertical, edges.near_horizontal, self._owners
        shares = measuring_cpu.shares_found(*lists, places, features.lengths, breadth)
        points, owners = measuring_cpu.believed(*lists, fit.used)
        allowed = np.sqrt(breadth**2 + tolerance)
        shown = measuring_cpu.in_view(self._vertical, features.places, features.spans, *projection.camera.image_size)
        told = measuring_cpu.agreement(fit.offsets, fit.used, allowed, shares, features.lengths, shown)
        return Measurement(fit, points, owners, *told, stretch, learned), window

    def _places(
        self,
        image: Bytes,
        edges: EdgeLists,
        features: Features,
        start: Array,
        doubt: Array,
        reach: float,
        breadth: float,
        brighter: Indices,
        tolerance: Array,
    ) -> tuple[Array, Array]:
        """The place and the confidence (S,) of each feature, by the edge points that belong to it."""
        c = self._c
        if not c.competing_lines:
            return measuring_cpu.mean_places(
                edges.near_vertical,
                edges.near_horizontal,
                self._owners,
                self._vertical,
                features.places,
                features.spans,
                features.lengths,
                brighter,
                reach,
                c.minimum_share,
                c.variance_floor,
            )
        return measuring_cpu.competing_places(
            image,
            edges.near_vertical,
            edges.near_horizontal,
            self._owners,
            self._vertical,
            features.places,
            features.spans,
            features.lengths,
            features.shifts,
            brighter,
            reach,
            c.minimum_share,
            c.variance_floor,
            c.edge_threshold,
            c.faint_lines,
            start,
            doubt,
            self._projection.offsets,
            tolerance,
            breadth,
        )

    def _tolerance(self, location: Array) -> Array:
        c, projection = self._c, self._projection
        return measuring_cpu.tolerances(
            location,
            self._vertical,
            projection.offsets,
            projection.horizon,
            self._magnification,
            projection.target.nominal_range,
            c.model_tolerance,
            c.relief_tolerance,
        )
