"""The recordings beside the repository, real ones and independently rendered ones, where they are at hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from selection import slow_after

from paceline.documents.loading import load_clip
from paceline.speed.measurement import measure_clip

DATA = Path(__file__).parents[2] / "shared" / "data"
MPH = 0.44704  # m/s
CROSSING = {"minivan": 14.9, "estate": 14.1, "red": 14.9, "hatchback": 12.1}  # m/s, good to 2 % (its README)


def recording(name: str) -> Path:
    clip = DATA / name / "clip.yaml"
    if not clip.exists():
        pytest.skip(f"the recording {name} is not at ../shared/data")
    return clip


@pytest.mark.parametrize("name", slow_after(0, ["curve", "straight"]))
def test_a_physically_rendered_clip(name: str) -> None:
    clip = recording(f"rendered/{name}")
    (m,) = measure_clip(clip).measurements
    truth = {row["frame"]: row for row in json.loads((clip.parent / "truth.json").read_text())}
    rows = [truth[int(k)] for k in m.track.frame]
    true = float(np.mean([row["speed_mps"] for row in rows]))
    assert (m.verdict, m.frames) == ("measured", len(rows))
    assert abs(m.speed - true) < 0.15 * MPH
    assert m.speed_lo <= true <= m.speed_hi
    np.testing.assert_allclose(m.track.refined_speed, [row["speed_mps"] for row in rows], atol=0.3)
    depth = np.array([row["position"][2] for row in rows])
    np.testing.assert_allclose(m.track.position[:, 2], depth, rtol=0.02)


@pytest.mark.parametrize("names", slow_after(0, [(("minivan",),), (tuple(CROSSING),)]), ids=len)
def test_a_real_crossing(names: tuple[str, ...]) -> None:
    """Poles and signs pass before the cars, and light and shadow over them."""
    clip = load_clip(recording("kitti_crossing"))
    result = measure_clip(replace(clip, vehicles=[v for v in clip.vehicles if v.id in names]))
    found = {m.vehicle: m for m in result.measurements}
    assert {name for name, m in found.items() if m.verdict == "measured"} == {*names}
    for name in names:
        assert found[name].speed == pytest.approx(CROSSING[name], rel=0.04), name
        to_the_right = np.diff(found[name].track.position[:, 0])
        assert (to_the_right > 0).all(), name
