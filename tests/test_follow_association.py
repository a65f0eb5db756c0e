"""Association of edge points against the rules (8)-(11), written out in plain Python."""

import numpy as np

from paceline.follow.association import NOBODY, associate


def plainly(points, upright, vertical, places, spans, gates, brighter):
    owners = []
    for x, y, sign in points:
        p, q = (x, y) if upright else (y, x)
        reached = [
            (abs(places[j] - p), j)
            for j in range(len(places))
            if vertical[j] == upright
            and spans[j][0] < q < spans[j][1]
            and abs(places[j] - p) < gates[j]
            and (brighter[j] == 0 or brighter[j] * sign > 0)
        ]
        owners.append(min(reached)[1] if reached else NOBODY)
    return owners


def test_nearest_feature_in_reach_wins():
    rng = np.random.default_rng(0)
    n = 8
    vertical = rng.random(n) < 0.5
    places = rng.uniform(10, 90, n)
    begins = rng.uniform(0, 50, n)
    spans = np.column_stack([begins, begins + rng.uniform(5, 50, n)])
    gates = rng.uniform(2, 15, n)
    brighter = rng.integers(-1, 2, n)
    points = np.column_stack([rng.uniform(0, 100, (3000, 2)), rng.normal(0, 20, 3000)]).astype(np.float32)
    for upright in (True, False):
        owners = np.empty(4000, np.int64)
        associate(points, upright, vertical, places, spans, gates, brighter, owners)
        expected = plainly(points.astype(float), upright, vertical, places, spans, gates, brighter)
        assert owners[:3000].tolist() == expected
        assert len(set(expected)) > 2


def test_an_edge_of_the_wrong_polarity_is_left_alone():
    points = np.array([[10.2, 20, 15.0], [10.2, 21, -15.0]], np.float32)
    owners = np.empty(2, np.int64)
    one = np.array([True]), np.array([10.0]), np.array([[0.0, 40.0]]), np.array([3.0])
    associate(points, True, *one, np.array([-1]), owners)
    assert owners.tolist() == [NOBODY, 0]
    associate(points, True, *one, np.array([0]), owners)
    assert owners.tolist() == [0, 0]
