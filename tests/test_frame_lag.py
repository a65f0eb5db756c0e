"""Two videos whose cameras were started by hand: which frames belong together, and where the outlines are in these."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from selection import slow_after

from paceline.cameras import Quantity
from paceline.documents.loading import Clip, load_clip
from paceline.imaging.frame_lag import LaggedMatches, estimate_lag
from paceline.imaging.outline_motion import followed
from paceline.imaging.recorded_cameras import estimate_cameras, with_outlines_in_pairs
from paceline.recordings.stereo import open_recording
from paceline.simulation.camera_errors import StereoErrors
from paceline.simulation.stereo.clip import RenderedClip, render, write
from paceline.simulation.stereo.scene import Scene, Vehicle
from paceline.speed.measurement import measure_clip

SCENE = Scene(
    5, (Vehicle("v0", 15.0, start_distance=45.0),), camera_height=3.0, tilt=0.06, road_depth=35.0, rate=10.0, frames=16
)


@pytest.fixture(scope="module", params=slow_after(1, [0.42, -0.3]))
def lagging(request, tmp_path_factory) -> tuple[RenderedClip, Path]:
    """A clip whose right camera exposes later than its time stamps say, or earlier."""
    rendered = render(replace(SCENE, errors=StereoErrors(offset=request.param, crf=14)))
    return rendered, write(rendered, tmp_path_factory.mktemp("lagging") / "clip")


@pytest.fixture(scope="module")
def lag(lagging: tuple[RenderedClip, Path]) -> float:
    return estimate_lag(open_recording(load_clip(lagging[1])))


def clip_and_truth(lagging: tuple[RenderedClip, Path]) -> tuple[Clip, dict[int, dict[str, np.ndarray]]]:
    """The clip, and its vehicle's corners (4, 2) px by frame and view."""
    rendered, path = lagging
    corners = {row["frame"]: {side: np.array(row[side]) for side in ("left", "right")} for row in rendered.truth}
    return load_clip(path), corners


def test_the_lag_is_found_to_the_nearest_frame(lagging, lag):
    assert lag == pytest.approx(0.1 * round(lagging[0].errors.offset / 0.1))


@pytest.mark.slow
def test_videos_at_the_same_time_do_not_lag(tmp_path):
    path = write(render(replace(SCENE, errors=StereoErrors(crf=14))), tmp_path / "clip")
    assert estimate_lag(open_recording(load_clip(path))) == 0.0


def test_matches_count_where_their_motion_would_show_a_lag():
    rng = np.random.default_rng(1)
    velocity = np.r_[rng.uniform(30, 60, 40), np.zeros(60)]
    matches = LaggedMatches(0.02 * velocity + rng.normal(0, 0.1, 100), velocity)
    count, offset = matches.agreement(0.1)
    assert count == 40 and offset == pytest.approx(0.02, abs=0.006)
    assert LaggedMatches(matches.distance + 4.0, velocity).agreement(0.1)[0] == 0


def test_outlines_are_followed_into_the_frames_that_belong_together(lagging, lag):
    """The truth of a pair in the files is that of the left and the right picture of the same number."""
    clip, corners = clip_and_truth(lagging)
    recorded = open_recording(clip)
    paired = recorded.with_lag(lag)
    (before,), (after,) = clip.vehicles, with_outlines_in_pairs(clip, recorded, paired).vehicles
    n = int(np.searchsorted(paired.indices, after.frame))
    assert paired.indices[n] == after.frame >= before.frame
    partner = int(paired.pairing.right[n])
    for frame, side in ((after.frame, "left"), (partner, "right")):
        error = getattr(after, side) - corners[frame][side]
        drawn = getattr(before, side) - corners[before.frame][side]  # by the operator's hand
        growth = np.ptp(corners[frame][side], axis=0) / np.ptp(corners[before.frame][side], axis=0)
        assert np.abs(error - growth * drawn).max() < 1.0


@pytest.mark.slow
def test_a_vehicle_is_measured_by_videos_that_were_started_by_hand(lagging):
    rendered, path = lagging
    result = measure_clip(path)
    offset, measurement = result.cameras["offset_s"], result.measurements[0]
    assert abs(offset["value"] - rendered.errors.offset) < 4 * offset["std"] < 0.008 and offset["source"] == "estimated"
    assert measurement.verdict == "measured", measurement.reason
    assert measurement.speed_lo < 15.0 < measurement.speed_hi and measurement.speed_hi - measurement.speed_lo < 0.4
    (notice,) = (notice for notice in result.notices if "ms after the left ones, by what moves in them" in notice)
    assert re.search(r"exposed −?[\d.]+ ± [\d.]+ ms after", notice)
    assert result.lag == pytest.approx(offset["value"], abs=0.05)


def test_what_is_stated_of_the_time_between_videos_is_not_asked(lagging):
    clip, _ = clip_and_truth(lagging)
    stated = replace(clip, offset=Quantity(0.0), vehicles=[])
    assert estimate_cameras(stated, open_recording(clip)).lag == 0.0


def test_an_outline_stays_where_nothing_moves():
    rng = np.random.default_rng(2)
    picture = cv2.GaussianBlur(np.asarray(rng.uniform(0, 255, (120, 160)), np.float32), (0, 0), 2.0)
    outline = np.array([[40.0, 30.0], [90.0, 30.0], [90.0, 70.0], [40.0, 70.0]])
    np.testing.assert_allclose(followed([picture] * 3, outline), outline, atol=0.02)
    np.testing.assert_array_equal(followed([picture], outline), outline)
