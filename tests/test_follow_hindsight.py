"""Frames of a recording in which the target was not tracked at first: looked at again once it is known where it is, and
not before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tiny_chase import SIZE, picture, start, truth, write

from paceline.documents.loading import FollowClip, load_follow
from paceline.errors import UnusableInput
from paceline.follow import hindsight
from paceline.follow.following import follow, follow_recording, tracker_for
from paceline.follow.hindsight import AGAIN, in_hindsight
from paceline.follow.results import FollowEstimate
from paceline.follow.start import BESIDE, CORRECTED, DOUBTED, UNTOLD
from paceline.follow.tracker import FollowTracker
from paceline.recordings.monocular import CameraFrame, CameraRecording, open_camera

Image = NDArray[np.uint8]

FRAMES = 20
ASIDE = 24.0  # px that a hand errs here, a third of the width
LATE = round(15 * DOUBTED) + 1  # frames that may be kept


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


def tracker(folder: Path, aside: float = ASIDE) -> FollowTracker:
    return tracker_for(clip_of(folder, aside))


def frames(count: int = FRAMES, shown: Callable[[int], Image | None] = picture) -> list[tuple[CameraFrame, None]]:
    return [(CameraFrame(k, k / 15, shown(k)), None) for k in range(count)]


def at_once(tracker: FollowTracker, frames: list[tuple[CameraFrame, None]]) -> list[FollowEstimate]:
    """What a live camera's user is told."""
    return [tracker.update(frame.image, frame.time, frame.index) for frame, _ in frames]


def recorded(tracker: FollowTracker, frames: list[tuple[CameraFrame, None]]) -> list[FollowEstimate]:
    return [estimate for _, estimate in in_hindsight(tracker, frames)]


def latest(tracker: FollowTracker, frames: list[tuple[CameraFrame, None]]) -> int:
    """By how many frames the estimates were kept back at most."""
    given: list[int] = []

    def watched() -> Iterator[tuple[CameraFrame, None]]:
        for frame, pose in frames:
            given.append(frame.index)
            yield frame, pose

    return max(given[-1] - frame.index for frame, _ in in_hindsight(tracker, watched()))


def is_right(estimate: FollowEstimate) -> bool:
    off = (estimate.position - truth(estimate.frame)) / estimate.position_std
    return estimate.status == "tracking" and bool(np.abs(off).max() < 4)


def test_a_start_that_is_settled_was_followed_from_the_first_frame_on(folder: Path) -> None:
    own = tracker(folder)
    live, seen = at_once(tracker(folder), frames()), recorded(own, frames())
    doubtful = [e.status for e in live].index("tracking")
    assert doubtful > 2 and live[doubtful].reason == CORRECTED
    assert [e.frame for e in seen] == list(range(FRAMES)) and all(is_right(e) for e in seen)
    assert [e.time for e in seen] == [e.time for e in live]
    assert [e.reason for e in seen] == [AGAIN] * doubtful + [e.reason for e in live[doubtful:]]
    for estimate, told in zip(seen, live, strict=True):
        assert estimate.steering == told.steering
        assert (estimate.position == told.position).all() == (told.status == "tracking")
    assert own.probation.first is not None
    there = start()
    assert np.abs(own.probation.first[:2] - there["center"]).max() < 1.5
    assert own.probation.first[2] == pytest.approx(there["scale"], rel=0.02)
    assert not own.beginning_at(own.probation.first).probation.pending


def test_a_start_in_no_doubt_is_told_at_once(folder: Path) -> None:
    assert latest(tracker(folder, 0.0), frames()) == 0
    assert all(is_right(e) and not e.reason for e in recorded(tracker(folder, 0.0), frames()))


def test_a_start_that_is_given_up_is_kept_no_longer_and_told_as_it_was(folder: Path) -> None:
    """There is nothing to see but the noise."""
    noise = np.random.default_rng(4)
    nothing = frames(LATE + 10, lambda _: noise.integers(90, 110, SIZE[::-1], np.uint8))
    assert latest(tracker(folder), nothing) <= LATE
    seen = recorded(tracker(folder), nothing)
    assert [e.frame for e in seen] == list(range(LATE + 10))
    assert seen[-1].reason == UNTOLD and not any(e.status == "tracking" for e in seen)


@pytest.mark.parametrize("begins", [0, 2])
@pytest.mark.parametrize("image", [None, np.zeros(SIZE[::-1], np.uint8)])
def test_pictures_that_show_nothing_are_not_kept_for_ever(folder: Path, image: Image | None, begins: int) -> None:
    """Before the first that does, while the start is in doubt, or after it."""
    dark = frames(3 * LATE, lambda k: picture(k) if k < begins or k > 2 * LATE else image)
    assert latest(tracker(folder), dark) <= LATE
    assert [e.frame for e in recorded(tracker(folder), dark)] == list(range(3 * LATE))


def test_what_does_not_lead_to_where_the_target_is_stays_as_it_was(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = at_once(tracker(folder), frames())
    monkeypatch.setattr(hindsight, "distance", lambda *_: BESIDE)
    assert [(e.status, e.reason) for e in recorded(tracker(folder), frames())] == [(e.status, e.reason) for e in live]


def test_a_picture_that_cannot_be_read_stays_one(folder: Path) -> None:
    shots = frames(FRAMES, lambda k: None if k == 3 else picture(k))
    seen = recorded(tracker(folder), shots)
    assert [e.frame for e in seen if e.reason == "the frame could not be read"] == [3]
    assert [e.frame for e in seen if e.status != "tracking"] == [3]
    assert all(is_right(e) for e in seen if e.status == "tracking")


def test_two_estimates_are_the_same_if_both_track_and_are_at_one_place(folder: Path) -> None:
    own = tracker(folder, 0.0)
    e = at_once(own, frames(3))[-1]
    size = own.lock.recogniser.projection.size(e.scale)
    assert hindsight._is_same(e, e, own)
    assert not hindsight._is_same(replace(e, status="coasting"), e, own)
    assert not hindsight._is_same(e, replace(e, status="lost"), own)
    for share, same in ((0.9, True), (1.1, False)):
        assert hindsight._is_same(e, replace(e, center=e.center + [0.0, share * BESIDE * size]), own) == same
        assert hindsight._is_same(e, replace(e, scale=e.scale * np.exp(-share * BESIDE)), own) == same


def test_frames_before_one_that_cannot_be_used_are_told(folder: Path) -> None:
    """Also while the start is in doubt."""
    small = CameraFrame(2, 2 / 15, np.zeros((10, 10), np.uint8))
    seen: list[FollowEstimate] = []
    with pytest.raises(UnusableInput, match="frame 2: expected a grey image"):
        for _, estimate in in_hindsight(tracker(folder), [*frames(2), (small, None)]):
            seen.append(estimate)
    assert [e.frame for e in seen] == [0, 1]


def test_a_recording_that_ends_in_doubt_is_told_as_it_was(folder: Path) -> None:
    assert [e.status for e in recorded(tracker(folder), frames(3))] == ["coasting"] * 3


def test_a_recording_waits_and_a_live_camera_does_not(folder: Path) -> None:
    clip = clip_of(folder, ASIDE)
    assert set(follow_recording(clip).status) == {"tracking"}
    told = follow(clip, CameraRecording(clip.camera, open_camera(clip)._feed, None))
    assert next(told)[1].status == "coasting"
