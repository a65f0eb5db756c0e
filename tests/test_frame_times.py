"""When frames were taken, by what moves: hypotheses about missing, repeated and swapped pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from paceline.documents.loading import Clip, load_clip
from paceline.geometry import triangulate
from paceline.imaging.frame_times import clear_part, estimate_steps, frame_times, longest_increasing, rate_conversion
from paceline.imaging.moving_features import moving_features
from paceline.imaging.recorded_cameras import estimate_cameras
from paceline.imaging.rigid_motions import Displacement, Interval, displacement_covariance, rigid_motions
from paceline.recordings.stereo import open_recording
from paceline.simulation.stereo.clip import RenderedClip, Scene, Vehicle, render, write
from paceline.speed.measurement import measure_clip

Array = NDArray[np.float64]
Place = Callable[[float], Array]  # where a vehicle is at a time, (3,) m
ALONG_STD_M, ACROSS_STD_M = 0.15, 0.003  # of displacements, along the rays and across them


def driving(speed: float, acceleration: float = 0.0, start: float = 60.0) -> Place:
    """A vehicle that comes nearer along the road and stops where it would go back."""

    def place(t: float) -> Array:
        moment = min(t, -speed / acceleration) if acceleration < 0 else t
        travelled = speed * moment + acceleration * moment**2 / 2
        return np.array([2.0 + 0.02 * travelled, 1.5, start - travelled])

    return place


def intervals(places: Sequence[Place], order: Sequence[int], rate: float, seed: int = 1) -> list[Interval]:
    """What is seen to move in a recording whose pictures were taken at the instants ``order``."""
    rng = np.random.default_rng(seed)

    def displacement(group: int, place: Place, a: float, b: float) -> Displacement:
        ray = place(b) / np.linalg.norm(place(b))
        along = np.outer(ray, ray)
        covariance = ALONG_STD_M**2 * along + ACROSS_STD_M**2 * (np.eye(3) - along)
        return Displacement(group, place(b) - place(a) + rng.multivariate_normal(np.zeros(3), covariance), covariance)

    return [
        Interval(k, k + 1, 1 / rate, [displacement(j, place, a / rate, b / rate) for j, place in enumerate(places)])
        for k, (a, b) in enumerate(zip(order, order[1:], strict=False))
    ]


def steps_of(order: Sequence[int]) -> list[int]:
    return np.diff(order).tolist()


def found(places: Sequence[Place], order: Sequence[int], rate: float) -> list[int]:
    return estimate_steps(intervals(places, order, rate), 1 / rate)[1]


SWAPPED, MISSING = [0, 1, 2, 3, 5, 4, 6, 7, 8, 9], [0, 1, 2, 3, 6, 7, 8, 9]
REPEATED, FIRST_REPEATED = [0, 1, 2, 3, 3, 3, 3, 4, 5, 6, 7], [0, 0, 0, 1, 2, 3, 4, 5, 6]
DOUBLED = [k for k in range(8) for _ in range(2)]


@pytest.mark.parametrize("order", [SWAPPED, MISSING, REPEATED, FIRST_REPEATED, DOUBLED, list(range(10))])
@pytest.mark.parametrize("rate", [5.0, 25.0])
def test_the_pictures_true_instants_are_found(order: list[int], rate: float) -> None:
    assert found([driving(20.0)], order, rate) == steps_of(order)
    assert found([driving(16.0), driving(12.0, -4.0)], order, rate) == steps_of(order)


@pytest.mark.parametrize("first", [0, 1])
def test_every_picture_twice_though_nothing_moves_for_some_time(first: int) -> None:
    """The intervals of a while tell nothing: those of a recorder that writes each picture twice go on through them, and
    the stated times hold. Where no picture is repeated they do not."""
    doubled = [k for k in range(16) for _ in range(2)][first:]
    for order in (doubled, list(range(31))):
        seen = intervals([driving(20.0)], order, 10.0)
        seen = [replace(i, displacements=[]) if 9 <= n < 18 or n == 24 else i for n, i in enumerate(seen)]
        _, steps, unclear = estimate_steps(seen, 0.1)
        assert steps == steps_of(order) and not unclear
        count = len(steps) + 1
        taken = frame_times(np.arange(count), np.arange(count) / 10, np.arange(1, count), np.array(steps), 0.1)
        assert np.ptp(taken.times[taken.kept] - np.arange(count)[taken.kept] / 10) < 0.101
        assert taken.kept.sum() == len(set(order)) and not taken.gaps and not len(taken.unordered)


@pytest.mark.slow
@given(
    motions=st.lists(st.tuples(st.floats(0.0, 40.0), st.floats(-9.0, 6.0)), min_size=1, max_size=3),
    rate=st.sampled_from([5.0, 10.0, 25.0]),
    seed=st.integers(0, 999),
)
@settings(max_examples=20, deadline=None, phases=[Phase.explicit, Phase.generate])
def test_no_traffic_is_taken_for_a_fault(motions: list[tuple[float, float]], rate: float, seed: int) -> None:
    """Steady, braking to a stop, setting off, at any speed."""
    places = [driving(speed, acceleration) for speed, acceleration in motions]
    assert set(estimate_steps(intervals(places, range(12), rate, seed), 1 / rate)[1]) == {1}


@pytest.mark.parametrize("missing", [1, 2, 3])
def test_a_gap_that_the_times_tell_is_no_fault(missing: int) -> None:
    order = [0, 1, 2, *range(3 + missing, 10)]
    seen = intervals([driving(20.0)], order, 5.0)
    seen = [replace(i, duration=step / 5) for i, step in zip(seen, steps_of(order), strict=True)]
    assert set(estimate_steps(seen, 0.2)[1]) == {1}


def test_a_gap_of_unclear_length_parts_a_recording() -> None:
    """A vehicle that brakes is seen coarsely: whether two frames are missing or three cannot be told. The part that
    shows the outlined vehicle is kept."""
    order = [*range(5), *range(8, 14)]
    seen = intervals([driving(9.0, -3.0)], order, 5.0)
    coarse = [replace(d, covariance=d.covariance + 0.6**2 * np.eye(3)) for d in seen[4].displacements]
    seen[4] = replace(seen[4], displacements=coarse)
    _, steps, unclear = estimate_steps(seen, 0.2)
    assert unclear == {4} and steps[4] > 1
    for outlined, kept in ((2, list(range(5))), (7, list(range(5, 11)))):
        corrected = frame_times(np.arange(11), np.arange(11) / 5, np.arange(1, 11), np.array(steps), 0.2, [outlined])
        parted = clear_part(replace(corrected, unclear=np.array([5])), [outlined])
        assert [parted.unclear_within(*span) for span in ((0, 4), (4, 8), (5, 8), (0, 9))] == [None, 5, None, 5]
        assert parted.indices[parted.kept].tolist() == kept and not parted.gaps
        assert not len(parted.unordered) and not len(parted.repeated) and parted.clear.sum() == len(kept)


def test_a_vehicle_that_is_followed_wrongly_once_changes_no_time() -> None:
    seen = intervals([driving(20.0), driving(15.0)], range(10), 5.0)
    wrong = Displacement(0, np.array([3.0, -1.0, 2.0]), seen[4].displacements[0].covariance)
    seen[4] = replace(seen[4], displacements=[wrong, seen[4].displacements[1]])
    assert set(estimate_steps(seen, 0.2)[1]) == {1}


def test_a_repetition_is_recognised_by_times_of_whole_milliseconds() -> None:
    """As of MKV files: of 30 frames/s each third interval is a millisecond longer."""
    order = [k for k in range(12) for _ in range(1 + (k in (3, 5, 8)))]
    stated = np.round(np.arange(len(order)) / 30, 3)
    corrected = frame_times(np.arange(15), stated, np.arange(1, 15), np.array(steps_of(order)), 0.033)
    assert corrected.repeated.tolist() == [4, 7, 11] and not len(corrected.unordered)


def test_a_part_may_be_a_single_frame() -> None:
    corrected = frame_times(np.arange(8), np.arange(8) / 5, np.arange(1, 8), np.array(steps_of(MISSING)), 0.2)
    parted = clear_part(replace(corrected, unclear=np.array([1])), [0])
    assert parted.kept_frame.tolist() == [0, *[-1] * 7] and not len(parted.repeated) and not len(parted.unordered)


def test_outlined_vehicles_on_both_sides_of_an_unclear_gap_keep_all_frames() -> None:
    order = [*range(5), *range(8, 14)]
    corrected = frame_times(np.arange(11), np.arange(11) / 5, np.arange(1, 11), np.array(steps_of(order)), 0.2)
    assert clear_part(replace(corrected, unclear=np.array([5])), [2, 7]).kept.all()


def test_frames_are_left_out_so_that_each_instant_is_kept_once_and_in_order() -> None:
    for order in (SWAPPED, MISSING, REPEATED, FIRST_REPEATED):
        indices, stated = np.arange(len(order)), np.arange(len(order)) / 5
        corrected = frame_times(indices, stated, indices[1:], np.array(steps_of(order)), 0.2)
        np.testing.assert_allclose(corrected.times, np.array(order) / 5, atol=1e-9)
        kept = np.array(order)[corrected.kept]
        assert (np.diff(kept) > 0).all()
        assert len(kept) == len(set(order)) - (order is SWAPPED)
        assert corrected.repeated.tolist() == [k for k in range(1, len(order)) if order[k] == order[k - 1]]
        assert len(corrected.unordered) == (order is SWAPPED)
        assert corrected.gaps == ([(3, 4, 2)] if order is MISSING else [])


def test_an_outlined_frame_is_kept_and_that_of_its_repetition_known() -> None:
    indices, stated = np.arange(10), np.arange(10) / 5
    steps = np.array(steps_of(SWAPPED))
    assert frame_times(indices, stated, indices[1:], steps, 0.2, [4]).unordered.tolist() == [5]
    assert frame_times(indices, stated, indices[1:], steps, 0.2, [5]).unordered.tolist() == [4]
    indices = np.arange(len(REPEATED))
    corrected = frame_times(indices, indices / 5, indices[1:], np.array(steps_of(REPEATED)), 0.2, [5])
    assert corrected.repeated.tolist() == [3, 4, 6]
    assert corrected.kept_frame[[3, 4, 5, 6, 7]].tolist() == [5, 5, 5, 5, 7]


def test_a_recorder_that_repeats_regularly_keeps_its_clock() -> None:
    assert rate_conversion(np.array(steps_of(DOUBLED))) == 2.0
    pulled = [k for k in range(16) for _ in range(1 + (k % 4 == 3))]  # four pictures in five frames
    assert rate_conversion(np.array(steps_of(pulled))) == 5 / 4
    assert rate_conversion(np.array(steps_of(REPEATED))) == 1.0
    corrected = frame_times(np.arange(16), np.arange(16) / 10, np.arange(1, 16), np.array(steps_of(DOUBLED)), 0.1)
    np.testing.assert_allclose(corrected.times[corrected.kept], np.arange(8) / 5)
    assert corrected.gaps == []


@given(values=st.lists(st.tuples(st.integers(0, 8), st.sampled_from([1, 1, 1, 9])), min_size=1, max_size=9))
def test_the_frames_kept_are_the_most_that_increase(values: list[tuple[int, int]]) -> None:
    times, weights = (np.array(column) for column in zip(*values, strict=True))
    kept = longest_increasing(times.astype(float), weights, 0.5)
    assert (np.diff(times[kept]) > 0).all()
    subsets = (list(c) for n in range(1, len(values) + 1) for c in combinations(range(len(values)), n))
    assert weights[kept].sum() == max(weights[c].sum() for c in subsets if (np.diff(times[c]) > 0).all())


# --- rendered clips -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def clean() -> RenderedClip:
    vehicle = Vehicle("v0", 16.0, start_distance=45.0)
    return render(Scene(5, (vehicle,), image_size=(640, 480), focal=1400.0, camera_height=3.0, tilt=0.06, frames=11))


def spoiled(clean: RenderedClip, folder: Path, left: Sequence[int], right: Sequence[int] | None = None) -> Clip:
    """The clip with its pictures in another order, those that appear again compressed anew."""
    write(clean, folder)
    for side, pictures, order in (("left", clean.left, left), ("right", clean.right, right or left)):
        for file in (folder / side).iterdir():
            file.unlink()
        for k, picture in enumerate(order):
            image = pictures[picture]
            if picture in order[:k]:
                image = np.asarray(cv2.imdecode(cv2.imencode(".jpg", image)[1], cv2.IMREAD_UNCHANGED), np.uint8)
            cv2.imwrite(str(folder / side / f"{k:04d}.png"), image)
    file = folder / "clip.yaml"
    document = yaml.safe_load(file.read_text())
    del document["synchronised"]
    file.write_text(yaml.safe_dump(document))
    return load_clip(file)


def test_displacements_are_those_of_the_vehicle_within_their_covariance(clean: RenderedClip, tmp_path: Path) -> None:
    clip = spoiled(clean, tmp_path, range(11))
    places = {row["frame"]: np.array(row["position"]) for row in clean.truth}
    features = moving_features(clip.rig, open_recording(clip).frames())
    seen = list(rigid_motions(clip.rig, features))
    assert [(i.first, i.second) for i in seen] == [(k, k + 1) for k in range(10)]
    squares = []
    for interval in seen:
        for d in interval.displacements:
            residual = d.vector - (places[interval.second] - places[interval.first])
            squares.append(residual @ np.linalg.solve(d.covariance, residual))
    assert len(squares) >= 8
    assert np.median(squares) < 7.8  # 95 % of a χ² with 3 degrees of freedom


def test_covariance_of_a_displacement_is_that_of_scattered_pixels(clean: RenderedClip) -> None:
    rng, rig = np.random.default_rng(3), clean.rig
    place, later = np.array([1.0, 0.5, 40.0]), np.array([1.0, 0.5, 36.0])
    (left, right), (left_later, right_later) = rig.project(place), rig.project(later)
    n, std = 20_000, 0.15
    shift, earlier, disparity = rng.normal(0, std, (n, 2)), rng.normal(0, std, n), rng.normal(0, std, n)
    along = np.array([1.0, 0.0])
    a = triangulate(rig, np.broadcast_to(left, (n, 2)), right + earlier[:, None] * along)
    b = triangulate(rig, left_later + shift, right_later + shift + disparity[:, None] * along)
    scattered = np.cov((b - a).T)
    stated = displacement_covariance(rig, place[None], later[None], np.zeros((1, 2)))[0]
    np.testing.assert_allclose(np.sqrt(np.diag(stated)), np.sqrt(np.diag(scattered)), rtol=0.1)


@pytest.mark.parametrize(
    ("order", "code"),
    [
        ([0, 1, 2, 3, 5, 4, 6, 7, 8, 9, 10], "frames_out_of_order"),
        ([0, 1, 2, 3, 5, 6, 7, 8, 9, 10], "frames_missing_estimated"),
        ([0, 1, 2, 3, 4, 4, 4, 5, 6, 7, 8, 9, 10], "frames_repeated"),
    ],
)
def test_times_of_a_spoiled_recording_are_corrected(
    clean: RenderedClip, tmp_path: Path, order: list[int], code: str
) -> None:
    cameras = estimate_cameras(spoiled(clean, tmp_path, order), open_recording(load_clip(tmp_path / "clip.yaml")))
    assert [n.code for n in cameras.notices if n.code.startswith("frames")] == [code]
    times = cameras.recording.times
    np.testing.assert_allclose(times, np.array(order)[cameras.recording.indices] / 5, atol=0.05)
    assert not [n for n in cameras.recording.notices if "dropped" in n]


@pytest.mark.slow
def test_a_fault_of_one_view_only_changes_no_time(clean: RenderedClip, tmp_path: Path) -> None:
    clip = spoiled(clean, tmp_path, [0, 1, 2, 3, 5, 4, 6, 7, 8, 9, 10], range(11))
    assert len(estimate_cameras(clip, open_recording(clip)).recording) == 11


def test_a_vehicle_outlined_on_a_repeated_picture_is_measured(clean: RenderedClip, tmp_path: Path) -> None:
    order = [0, 0, 0, *range(1, 11)]
    clip = spoiled(clean, tmp_path, order)
    result = measure_clip(replace(clip, vehicles=[replace(v, frame=v.frame + 1) for v in clip.vehicles]))
    measurement = result.measurements[0]
    assert measurement.verdict == "measured" and measurement.speed_lo < 16.0 < measurement.speed_hi
    assert any("copy" in notice for notice in result.notices)
