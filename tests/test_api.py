"""The Python API: estimates frame by frame, tables, and what is said where a package is missing."""

from __future__ import annotations

import json
import sys
from itertools import islice
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import paceline
from paceline.speed.results import ClipResult, Measurement, Track

ROOT = Path(__file__).parents[1]
STRAIGHT, CHASE = ROOT / "examples" / "straight" / "clip.yaml", ROOT / "examples" / "chase" / "follow.yaml"


@pytest.fixture
def result() -> ClipResult:
    empty = np.empty(0)
    tracks = [Track(n, *[empty] * 9, [], *[empty] * 5) for n in ("v0", "v1")]  # type: ignore[arg-type]
    measured = [
        Measurement(t.vehicle, t, 20.0, 19.0, 21.0, 0.5, 0.1, 9, "measured", "", "constant speed", notices=["a", "b"])
        for t in tracks
    ]
    return ClipResult("clip.yaml", measured, [], {}, {}, [])


def test_all_vehicles_of_a_clip_are_tracked_frame_by_frame() -> None:
    configuration = paceline.SpeedConfiguration(particles=20)
    both = list(islice(paceline.track(STRAIGHT, configuration), 8))
    assert [e.vehicle for e in both] == ["v0", "v1"] * 4 and [e.frame for e in both] == [0, 0, 1, 1, 2, 2, 3, 3]
    clip = paceline.load_clip(STRAIGHT)
    frames = list(islice(paceline.open_recording(clip).frames(), 3))
    both = list(paceline.track(clip, configuration, frames=frames))
    one = list(paceline.track(clip, configuration, vehicle="v1", frames=frames))
    assert [e.speed for e in one[1:]] == [e.speed for e in both[3:6:2]]  # a vehicle's random numbers are its own


def test_an_unknown_vehicle_is_refused() -> None:
    with pytest.raises(paceline.UnusableInput, match="none is called 'v9'; expected one of v0, v1"):
        paceline.track(STRAIGHT, vehicle="v9")


def test_the_vehicle_ahead_is_followed_frame_by_frame() -> None:
    first = list(islice(paceline.follow(CHASE), 2))
    assert [e.frame for e in first] == [0, 1] and first[0].status == "tracking"
    assert paceline.follow.__name__ == "paceline.follow"  # type: ignore[attr-defined]


def test_a_simulated_clip_can_be_drawn_and_written(tmp_path: Path) -> None:
    scene = paceline.random_stereo_scene(3, image_size=(320, 240), focal=700.0)
    clip = paceline.load_clip(paceline.write_stereo_clip(paceline.render_stereo_clip(scene), tmp_path))
    assert clip.vehicles and json.loads((tmp_path / "truth.json").read_text())


def test_the_closed_loop_steps() -> None:
    step = next(iter(paceline.ClosedLoop(paceline.load_drive("turns", 2), seed=2).steps()))
    assert step.frame == 0 and step.lead_present


def test_a_result_is_a_table(result: ClipResult, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither package is a dependency: stand-ins get what they would."""
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    monkeypatch.setitem(sys.modules, "pyarrow", SimpleNamespace(table=dict))
    table = result.to_pandas()
    assert table == result.to_arrow()
    assert (table["vehicle"], table["speed_mps"], table["reason"]) == (["v0", "v1"], [20.0, 20.0], ["", ""])
    assert list(table) == [key for key in result.measurements[0].summary() if key != "notices"]


@pytest.mark.parametrize(("method", "package"), [("to_pandas", "pandas"), ("to_arrow", "pyarrow")])
def test_a_missing_package_is_named(
    result: ClipResult, monkeypatch: pytest.MonkeyPatch, method: str, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(paceline.UnusableInput, match=f"{method} needs {package} .*pip install {package}$"):
        getattr(result, method)()
