"""What is kept of a run: every row of a short one, evenly thinned rows of a long one, and counts over all frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from paceline.follow.results import FollowEstimate, FollowResult, ModelWidth
from paceline.path_following.steering_goal import SteeringGoal

OTHER = "other reasons"
REASONS, EPISODES = 50, 200  # kept of each; counts stay complete
WIDTH = 18  # numbers of one estimate


@dataclass
class Episode:
    """A stretch of frames in which the target was not tracked."""

    first_frame: int
    last_frame: int
    start: float  # s
    stop: float
    status: str  # lost if it was ever that, coasting otherwise
    reason: str  # the first one


@dataclass
class Tally:
    """Counts over all frames of a run; ranges are metres ahead in frames that were tracked."""

    frames: int = 0
    status: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    episodes: list[Episode] = field(default_factory=list)
    episode_count: int = 0
    range_min: float = np.inf
    range_max: float = -np.inf
    range_sum: float = 0.0
    latency_max: float = 0.0
    start: float = np.nan  # s
    stop: float = np.nan
    tracking: bool = True  # in the latest frame

    @property
    def tracked(self) -> int:
        return self.status["tracking"]

    @property
    def share(self) -> float:
        """Share of frames tracked, 0 … 1; NaN without any frame."""
        return self.tracked / self.frames if self.frames else np.nan

    @property
    def range_mean(self) -> float:
        return self.range_sum / self.tracked if self.tracked else np.nan

    @property
    def longest(self) -> Episode | None:
        """The longest of the stretches kept, in seconds."""
        return max(self.episodes, key=lambda e: e.stop - e.start, default=None)

    def add(self, e: FollowEstimate) -> None:
        if not self.frames:
            self.start = e.time
        self.stop = e.time
        self.frames += 1
        self.status[e.status] += 1
        self.latency_max = max(self.latency_max, e.latency)
        if e.reason:
            self.reasons[e.reason if e.reason in self.reasons or len(self.reasons) < REASONS else OTHER] += 1
        if e.status == "tracking":
            z = float(e.position[2])
            self.range_min, self.range_max = min(self.range_min, z), max(self.range_max, z)
            self.range_sum += z
        else:
            self._add_to_episode(e)
        self.tracking = e.status == "tracking"

    def _add_to_episode(self, e: FollowEstimate) -> None:
        if self.tracking:
            self.episode_count += 1
            if self.episode_count <= EPISODES:
                self.episodes.append(Episode(e.frame, e.frame, e.time, e.time, e.status, e.reason))
        elif self.episode_count <= EPISODES:
            episode = self.episodes[-1]
            episode.last_frame, episode.stop = e.frame, e.time
            if e.status == "lost":
                episode.status = "lost"


class History:
    """Collects estimates. Of a run longer than ``keep`` frames every second row is dropped, as often as it takes."""

    def __init__(self, keep: int | None = 20_000) -> None:
        """``keep`` is even and at least 2; None keeps every row."""
        self.tally = Tally()
        self.every = 1  # frames from one row kept to the next
        self._keep = keep
        self._rows = np.empty((keep or 1024, WIDTH))
        self._words: list[tuple[str, str]] = []  # status and reason

    def add(self, e: FollowEstimate) -> None:
        if self.tally.frames % self.every == 0:
            if len(self._words) == len(self._rows):
                self._make_room()
            self._rows[len(self._words)] = (
                e.frame, e.time, *e.center, e.scale, *e.weights, *e.position, *e.position_std, e.bearing, e.steering,
                e.residual, e.latency,
            )  # fmt: skip
            self._words.append((e.status, e.reason))
        self.tally.add(e)

    def _make_room(self) -> None:
        if self._keep is None:
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
            return
        half = self._rows[::2].copy()
        self._rows[: len(half)] = half
        self._words = self._words[::2]
        self.every *= 2

    def result(
        self,
        clip: str,
        target: str,
        width: ModelWidth,
        steering_goal: SteeringGoal,
        assumed: dict[str, float],
        configuration: dict[str, object],
        versions: dict[str, str],
        notices: list[str],
        seconds: float,
    ) -> FollowResult:
        rows = self._rows[: len(self._words)]
        return FollowResult(
            clip=clip,
            target=target,
            frame=rows[:, 0].astype(np.int64),
            time=rows[:, 1].copy(),
            center=rows[:, 2:4].copy(),
            scale=rows[:, 4].copy(),
            weights=rows[:, 5:8].copy(),
            position=rows[:, 8:11].copy(),
            position_std=rows[:, 11:14].copy(),
            bearing=rows[:, 14].copy(),
            steering=rows[:, 15].copy(),
            residual=rows[:, 16].copy(),
            latency=rows[:, 17].copy(),
            width=width,
            steering_goal=steering_goal,
            assumed=assumed,
            status=[status for status, _ in self._words],
            reason=[reason for _, reason in self._words],
            configuration=configuration,
            versions=versions,
            notices=notices,
            seconds=seconds,
        )
