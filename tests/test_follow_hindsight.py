"""The first frames of a recording whose start is in doubt: looked at again once that is settled, and not before."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from small_chase import NOMINAL, SIZE, picture, start, truth, write

from paceline.documents import FollowClip, load_follow
from paceline.errors import UnusableInput
from paceline.follow.following import follow, follow_recording, tracker_for
from paceline.follow.hindsight import AGAIN, in_hindsight
from paceline.follow.results import FollowEstimate
from paceline.follow.start import CORRECTED, DOUBTED, UNTOLD
from paceline.follow.tracker import FollowTracker
from paceline.monocular import CameraFrame, CameraRecording, open_camera

FRAMES = 20
ASIDE = 24.0  # px that a hand errs here, a third of the width


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path: Path = tmp_path_factory.mktemp("chase")
    write(path, FRAMES)
    return path


def clip_of(folder: Path, aside: float) -> FollowClip:
    """The recording with a start that is so many px off."""
    document = (folder / "follow.yaml").read_text()
    x = start()["center"][0]  # type: ignore[index]
    moved = folder / f"aside-{aside:g}.yaml"
    moved.write_text(document.replace(repr(x), repr(x + aside)))
    return load_follow(moved)


def tracker(folder: Path) -> FollowTracker:
    return tracker_for(clip_of(folder, ASIDE))


def frames(first: int = 0, count: int = FRAMES) -> Iterator[tuple[CameraFrame, None]]:
    return ((CameraFrame(k, k / 15, picture(k)), None) for k in range(first, first + count))


def at_once(tracker: FollowTracker) -> list[FollowEstimate]:
    """What a live camera's user is told."""
    return [tracker.update(frame.image, frame.time, frame.index) for frame, _ in frames()]


def test_a_start_that_is_settled_was_followed_from_the_first_frame_on(folder: Path) -> None:
    live, seen = at_once(tracker(folder)), list(in_hindsight(tracker(folder), frames()))
    doubtful = [e.status for e in live].index("tracking")
    assert doubtful > 2 and live[doubtful].reason == CORRECTED
    assert [frame.index for frame, _ in seen] == list(range(FRAMES)) == [e.frame for _, e in seen]
    assert [e.reason for _, e in seen] == [AGAIN] * doubtful + [e.reason for e in live[doubtful:]]
    for frame, estimate in seen:
        assert estimate.status == "tracking"
        assert np.abs((estimate.position - truth(frame.index)) / estimate.position_std).max() < 4
    for (_, estimate), told in zip(seen[doubtful:], live[doubtful:], strict=True):
        np.testing.assert_array_equal(estimate.position, told.position)


def test_a_start_in_no_doubt_is_told_at_once(folder: Path) -> None:
    given: list[int] = []

    def watched() -> Iterator[tuple[CameraFrame, None]]:
        for frame, pose in frames():
            given.append(frame.index)
            yield frame, pose

    for frame, estimate in in_hindsight(tracker_for(clip_of(folder, 0.0)), watched()):
        assert estimate.status == "tracking" and estimate.reason == ""
        assert given[-1] == frame.index


def test_a_start_that_is_given_up_is_kept_no_longer_and_told_as_it_was(folder: Path) -> None:
    """There is nothing to see but the noise."""
    noise, count = np.random.default_rng(4), round(15 * DOUBTED) + 10
    nothing = [CameraFrame(k, k / 15, noise.integers(90, 110, SIZE[::-1], np.uint8)) for k in range(count)]
    given: list[int] = []

    def watched() -> Iterator[tuple[CameraFrame, None]]:
        for frame in nothing:
            given.append(frame.index)
            yield frame, None

    seen = []
    for frame, estimate in in_hindsight(tracker(folder), watched()):
        seen.append(estimate)
        assert given[-1] <= max(frame.index, round(15 * DOUBTED) + 1)
    assert [e.frame for e in seen] == list(range(count))
    assert seen[-1].reason == UNTOLD and not any(e.status == "tracking" for e in seen)


def test_what_does_not_lead_to_where_the_target_is_stays_in_doubt(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if the first image had shown it somewhere else."""
    wrong = np.array([60.0, 60.0, 0.5 * NOMINAL / truth(0)[2]])
    begin = FollowTracker.beginning_at
    monkeypatch.setattr(FollowTracker, "beginning_at", lambda self, place: begin(self, wrong))
    live, seen = at_once(tracker(folder)), [e for _, e in in_hindsight(tracker(folder), frames())]
    assert [e.status for e in seen] == [e.status for e in live]
    assert [e.reason for e in seen] == [e.reason for e in live]


def test_frames_before_one_that_cannot_be_used_are_told(folder: Path) -> None:
    """Also while the start is in doubt."""
    small = CameraFrame(2, 2 / 15, np.zeros((10, 10), np.uint8))
    seen: list[FollowEstimate] = []
    with pytest.raises(UnusableInput, match="frame 2: expected a grey image"):
        for _, estimate in in_hindsight(tracker(folder), [*frames(count=2), (small, None)]):
            seen.append(estimate)
    assert [e.frame for e in seen] == [0, 1]


def test_a_recording_that_ends_in_doubt_is_told_as_it_was(folder: Path) -> None:
    seen = [e for _, e in in_hindsight(tracker(folder), frames(count=3))]
    assert [e.status for e in seen] == ["coasting"] * 3


def test_a_recording_waits_and_a_live_camera_does_not(folder: Path) -> None:
    clip = clip_of(folder, ASIDE)
    assert set(follow_recording(clip).status) == {"tracking"}
    recording = open_camera(clip)
    live = CameraRecording(clip.camera, recording._feed, None)
    told = follow(clip, live)
    assert next(told)[1].status == "coasting"
