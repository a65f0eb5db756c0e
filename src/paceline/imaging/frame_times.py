"""When the frames of a recording were truly taken, by the motion of all that moves in them.

Where frames are missing, repeated or swapped, everything that moves jumps at once by whole intervals. The hypotheses
are integers: how many intervals each frame was taken after the one before it, 1 where nothing is wrong. They are tested
against each other by Kalman filters of the velocities (a filter for each vehicle under each hypothesis): what drives
changes its velocity by no more than tyres allow.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from paceline.arrays import Array, Indices, Mask
from paceline.imaging.moving_features import MovingFeatures
from paceline.imaging.rigid_motions import Displacement, Interval, rigid_motions
from paceline.progress import Progress
from paceline.recordings.stereo import StereoFrame, StereoRecording

FRAME_STEPS = (1, 0, 2, 3, 4, 5, -1, -2)  # intervals from one frame to the next
FAULT_PROBABILITY = 1e-6  # of each step but 1; recorders that have repeated pictures do so again more often,
# and as probable is it that one writes every picture twice
# Accelerations (m/s²) along the direction of travel, sideways and upwards: their standard deviations in ordinary
# driving and where tyres are used to their limits (twice these), and how probable either is
ACCELERATION_STDS_MPS2 = np.array([[2.0, 2.0, 0.3], [4.5, 4.5, 1.0]])
ACCELERATION_PROBABILITIES = 0.9, 0.1
BODY_MOTION_STD_MPS = 0.05  # velocity of a vehicle's body on its springs
OUTLIER_PROBABILITY = 1e-4  # of a displacement that is wrong
MAX_OUTLIER_SPEED_MPS = 90.0  # a wrong displacement is anywhere up to this speed
FIRST_SPEED_STDS_MPS = 0.05, 20.0  # of vehicles that stand and that drive
MIN_REGULAR_REPETITIONS = 3  # from which on they are a recorder's that repeats pictures to reach its rate
MAX_HYPOTHESES = 32
MAX_LOG_ODDS = 30.0  # of the likeliest hypothesis against those that are dropped
MERGED_STEPS = 3  # hypotheses that agree in these last steps differ no longer
CLEAR_LOG_ODDS = 3.0  # 20 to 1: of the likeliest hypothesis against others, from which on a step is clear
DOWN = np.array([0.0, 1.0, 0.0])  # about, in the left camera's axes


@dataclass(frozen=True, eq=False)
class _Velocity:
    """The ``mean`` velocity (3,) m/s over a step of so many seconds, its ``covariance`` (3, 3), and a velocity (3,) of
    the direction of ``travel``. It is not ``is_known`` where only repetitions have been seen of what moves."""

    mean: Array
    covariance: Array
    duration: float
    travel: Array
    is_known: bool = True


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """So many steps, of which ``repetitions`` are 0 and the last ones are the ``latest``, the logarithm of their
    probability and the velocity of each group under them; ``history`` links all of them, the last one first. Under a
    hypothesis that is ``doubled``, the recorder writes every picture twice: every second step is 0, from the first
    (0) or from the second (1) on.

    ``unclear`` are the places of steps in which hypotheses that are nearly as likely differed from it.
    """

    log_probability: float
    velocities: dict[int, _Velocity]
    latest: tuple[int, ...] = ()
    count: int = 0
    repetitions: int = 0
    history: tuple[Any, ...] = ()
    unclear: frozenset[int] = frozenset()
    doubled: int | None = None

    @property
    def expected_step(self) -> int:
        """The next step where nothing moves that tells it."""
        return 0 if self.doubled == self.count % 2 else 1

    def against(self, others: Iterable[_Hypothesis]) -> _Hypothesis:
        """The same after it was preferred to the ``others``."""
        unclear = set(self.unclear)
        for other in others:
            if self.log_probability - other.log_probability < CLEAR_LOG_ODDS:
                unclear |= other.unclear
                own, history, place = self.history, other.history, self.count - 1
                while own is not history:
                    (step, own), (other_step, history) = own, history
                    if step != other_step:
                        unclear.add(place)
                    place -= 1
        return replace(self, unclear=frozenset(unclear))

    @property
    def steps(self) -> list[int]:
        """All of its steps."""
        steps, history = [], self.history
        while history:
            step, history = history
            steps.append(step)
        return steps[::-1]

    def log_prior(self, step: int) -> float:
        """The logarithm of the probability of a further ``step``, before anything is seen of it."""
        if self.doubled is not None:
            return 0.0 if step == self.expected_step else float(np.log(FAULT_PROBABILITY))
        repetition = max(FAULT_PROBABILITY, self.repetitions / (self.count + 2))
        return float(np.log({0: repetition, 1: 1.0 - repetition}.get(step, FAULT_PROBABILITY)))


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """When the N frames of a recording were taken, ``times`` (s), and which of them are ``kept`` (N,): each once and in
    order.

    ``gaps`` are the frames between which others are missing of which no file tells, and how many. How long after the
    ones before them those of ``unclear`` (U,) were taken cannot be told; frames that are not ``clear`` (N,) are left
    out for that.
    """

    indices: Indices
    times: Array
    kept: Mask
    gaps: list[tuple[int, int, int]]
    clear: Mask
    period: float  # s, between the frames of a recording without faults
    unclear: Indices = field(default_factory=lambda: np.zeros(0, np.int64))

    def unclear_within(self, first: int, last: int) -> int | None:
        """The first unclear frame after ``first`` and not after ``last``, None where there is none."""
        return next((n for n in self.unclear.tolist() if first < n <= last), None)

    @property
    def kept_frame(self) -> Indices:
        """The frame (N,) that is kept of those taken at the time of each, −1 where none is."""
        kept_times = np.array([-np.inf, *self.times[self.kept], np.inf])
        kept_indices = np.array([-1, *self.indices[self.kept], -1])
        after = np.searchsorted(kept_times, self.times)
        nearest = np.where(self.times - kept_times[after - 1] < kept_times[after] - self.times, after - 1, after)
        same = np.abs(kept_times[nearest] - self.times) < self.period / 2
        return np.asarray(np.where(same, kept_indices[nearest], -1))

    @property
    def repeated(self) -> Indices:
        """The frames that are left out because they repeat one that is kept."""
        return np.asarray(self.indices[~self.kept & self.clear & (self.kept_frame >= 0)])

    @property
    def unordered(self) -> Indices:
        """The frames that are left out because frames before them were taken later, or frames after them earlier."""
        return np.asarray(self.indices[~self.kept & self.clear & (self.kept_frame < 0)])


def estimate_frame_times(
    recording: StereoRecording,
    features: Iterable[tuple[StereoFrame, MovingFeatures]],
    outlined: Sequence[int] = (),
    progress: Progress | None = None,
) -> FrameTimes:
    """When the frames of ``recording`` were taken, by the ``features`` of what moves in each; those ``outlined`` are
    kept if possible."""
    period = recording.pairing.interval
    intervals = reported(rigid_motions(recording.rig, features), len(recording), progress)
    frames, steps, unclear = estimate_steps(intervals, period)
    seconds = np.array([second for _, second in frames], np.int64)
    corrected = frame_times(recording.indices, recording.times, seconds, np.array(steps, np.int64), period, outlined)
    corrected = replace(corrected, unclear=seconds[sorted(unclear)])
    return clear_part(corrected, outlined) if outlined else corrected


def reported(intervals: Iterable[Interval], count: int, progress: Progress | None) -> Iterator[Interval]:
    """The ``intervals`` between ``count`` frames; ``progress`` is called with frames done and frames in all."""
    for done, interval in enumerate(intervals, 2):
        yield interval
        if progress is not None:
            progress(done, count)


def frame_times(
    indices: Indices, stated: Array, frames: Indices, steps: Indices, period: float, outlined: Iterable[int] = ()
) -> FrameTimes:
    """The `FrameTimes` of frames with ``indices`` (N,) and ``stated`` times (N,) s, of which ``frames`` (M,) were taken
    ``steps`` (M,) − 1 frame periods (``period`` s each) later after the one before them than stated."""
    if (steps == 1).all():
        every_frame = np.ones(len(stated), bool)
        return FrameTimes(indices, stated, every_frame, [], every_frame, period)
    delay = np.zeros(len(stated))
    delay[np.searchsorted(indices, frames)] = (steps - 1) * period
    conversion = rate_conversion(steps)
    times = stated[0] + conversion * (stated + np.cumsum(delay) - stated[0])
    weights = np.where(np.isin(indices, list(outlined)), len(indices), 1)
    selection = longest_increasing(times, weights, period / 2)
    unkept_times, rows = times[~selection], np.flatnonzero(selection)
    gaps = []
    for a, b in zip(rows, rows[1:], strict=False):
        between = (times[a] + period / 2 < unkept_times) & (unkept_times < times[b] - period / 2)
        count = (times[b] - times[a]) / conversion - (stated[b] - stated[a])
        if (missing := round(count / period) - int(between.sum())) > 0:
            gaps.append((int(indices[a]), int(indices[b]), missing))
    return FrameTimes(indices, times, selection, gaps, np.ones(len(times), bool), period)


def clear_part(corrected: FrameTimes, outlined: Sequence[int]) -> FrameTimes:
    """That part of a ``corrected`` recording which holds the ``outlined`` frames and is not interrupted before an
    unclear one; all of it where these frames lie in several parts."""
    part = np.searchsorted(corrected.unclear, corrected.indices, "right")
    parts = np.unique(part[np.isin(corrected.indices, outlined)])
    if not len(corrected.unclear) or len(parts) != 1:
        return corrected
    clear = part == parts[0]
    selection = corrected.kept & clear
    rows = corrected.indices[selection]
    gaps = [gap for gap in corrected.gaps if rows[0] <= gap[0] and gap[1] <= rows[-1]]
    return replace(corrected, kept=selection, gaps=gaps, clear=clear)


def rate_conversion(steps: Indices) -> float:
    """How much longer the intervals between the pictures are than the frames', from each frame to the next ``steps``
    (M,) of them: more than 1 where a recorder regularly repeats pictures to reach its rate.

    Single repetitions are pictures put in between, by which a recording becomes longer than what it shows.
    """
    repeated = steps == 0
    starts = np.flatnonzero(np.diff(repeated, prepend=False) & repeated)
    spacings = np.diff(starts)
    if len(starts) < MIN_REGULAR_REPETITIONS or np.ptp(spacings) > 1:
        return 1.0
    span = steps[starts[0] : starts[-1]]
    return len(span) / max(int(span.sum()), 1)


def longest_increasing(times: Array, weights: Array, least: float) -> Mask:
    """The frames (N,) of the greatest total of ``weights`` (N,) whose ``times`` (N,) increase by at least ``least``."""
    total, previous = weights.astype(float), np.full(len(times), -1)
    for k in range(1, len(times)):
        before = np.where(times[:k] <= times[k] - least, total[:k], 0.0)
        best = int(np.argmax(before))
        if before[best] > 0:
            total[k] += before[best]
            previous[k] = best
    selection = np.zeros(len(times), bool)
    k = int(np.argmax(total))
    while k >= 0:
        selection[k] = True
        k = int(previous[k])
    return selection


def estimate_steps(
    intervals: Iterable[Interval], period: float
) -> tuple[list[tuple[int, int]], list[int], frozenset[int]]:
    """The frames of each of the ``intervals``, and how many frame periods (``period`` s each) it is longer than stated,
    plus 1: the likeliest of all sequences of `FRAME_STEPS`. And the places of the steps that are not clear."""
    frames: list[tuple[int, int]] = []
    doubled = [_Hypothesis(float(np.log(FAULT_PROBABILITY)), {}, doubled=first) for first in (0, 1)]
    hypotheses = [_Hypothesis(0.0, {}), *doubled]
    for interval in intervals:
        frames.append((interval.first, interval.second))
        steps = _possible_steps(interval, period) if interval.displacements else []
        hypotheses = _pruned(
            [_extended(h, interval, step, period) for h in hypotheses for step in steps or [h.expected_step]]
        )
    best = hypotheses[0].against(hypotheses[1:])
    return frames, best.steps, best.unclear


def _possible_steps(interval: Interval, period: float) -> list[int]:
    """Those of `FRAME_STEPS` after which an ``interval`` takes some time, or is that to a repetition."""
    return [step for step in FRAME_STEPS if step == 0 or abs(interval.duration + (step - 1) * period) > period / 2]


def _pruned(hypotheses: list[_Hypothesis]) -> list[_Hypothesis]:
    """The likeliest of the ``hypotheses``, best first, and of those that differ no longer only the best."""
    hypotheses = sorted(hypotheses, key=lambda h: -h.log_probability)
    least = hypotheses[0].log_probability - MAX_LOG_ODDS
    groups: dict[tuple[object, ...], list[_Hypothesis]] = {}
    for hypothesis in hypotheses:
        if hypothesis.log_probability > least:
            groups.setdefault((hypothesis.doubled, *hypothesis.latest), []).append(hypothesis)
    return [best.against(others) for best, *others in groups.values()][:MAX_HYPOTHESES]


def _extended(hypothesis: _Hypothesis, interval: Interval, step: int, period: float) -> _Hypothesis:
    """The ``hypothesis`` with a further ``step`` over ``interval``."""
    log_probability, velocities = hypothesis.log_probability + hypothesis.log_prior(step), {}
    for displacement in interval.displacements:
        known = hypothesis.velocities.get(displacement.group)
        if step == 0:
            log_density, velocities[displacement.group] = _repeated(known, displacement, interval.duration)
        else:
            known = known if known is not None and known.is_known else None
            duration = interval.duration + (step - 1) * period
            log_density, velocities[displacement.group] = _updated(known, displacement, duration)
        log_probability += log_density
    return _Hypothesis(
        log_probability,
        velocities,
        (*hypothesis.latest, step)[-MERGED_STEPS:],
        hypothesis.count + 1,
        hypothesis.repetitions + (step == 0),
        (step, hypothesis.history),
        hypothesis.unclear,
        hypothesis.doubled,
    )


def _repeated(known: _Velocity | None, displacement: Displacement, duration: float) -> tuple[float, _Velocity]:
    """The log density of a ``displacement`` between a picture and its repetition, and the velocity after it.

    It is that of a vehicle that stands for the ``duration`` (s) stated: what stands shows neither.
    """
    if known is None:
        log_density, standing = _updated(None, displacement, duration, FIRST_SPEED_STDS_MPS[:1])
        return log_density, replace(standing, is_known=False)
    log_density, standing = _updated(replace(known, mean=np.zeros(3)), displacement, duration)
    return log_density, known if known.is_known else replace(standing, is_known=False)


def _updated(
    known: _Velocity | None,
    displacement: Displacement,
    duration: float,
    first_stds: tuple[float, ...] = FIRST_SPEED_STDS_MPS,
) -> tuple[float, _Velocity]:
    """The log density of a ``displacement`` over ``duration`` s where the velocity before it is ``known``, and the
    velocity after it."""
    body = BODY_MOTION_STD_MPS**2 * np.eye(3)
    observed, noise = displacement.vector / duration, displacement.covariance / duration**2 + body
    unit = 3 * np.log(abs(duration))  # of densities of velocities against those of displacements
    if known is None:
        outcomes = [_predicted(np.zeros(3), std**2 * np.eye(3), observed, noise) for std in first_stds]
        best = max(outcomes, key=lambda outcome: outcome[0])
        return best[0] - float(np.log(len(FIRST_SPEED_STDS_MPS))) - unit, _Velocity(*best[1], duration, observed)
    between = (abs(known.duration) + abs(duration)) / 2
    axes = _axes_of_travel(max(known.travel, observed, key=lambda velocity: float(np.linalg.norm(velocity))))
    outcomes = []
    for stds, probability in zip(ACCELERATION_STDS_MPS2, ACCELERATION_PROBABILITIES, strict=True):
        spread = known.covariance + between**2 * (axes.T * stds**2) @ axes
        log_density, velocity = _predicted(known.mean, spread, observed, noise)
        outcomes.append((np.log(probability) + log_density, velocity))
    outcomes.append((np.log(OUTLIER_PROBABILITY) - 3 * np.log(2 * MAX_OUTLIER_SPEED_MPS), (known.mean, spread)))
    total = float(np.logaddexp.reduce([log_density for log_density, _ in outcomes])) - unit
    mean, covariance = max(outcomes, key=lambda outcome: outcome[0])[1]
    return total, _Velocity(mean, covariance, duration, mean)


def _predicted(mean: Array, spread: Array, observed: Array, noise: Array) -> tuple[float, tuple[Array, Array]]:
    """The log density of what is ``observed`` (3,) with the covariance ``noise`` (3, 3) where ``mean`` (3,) with the
    covariance ``spread`` is predicted, and the mean and the covariance after it."""
    gain = np.linalg.solve(spread + noise, spread).T
    innovation = observed - mean
    return _log_normal(innovation, spread + noise), (mean + gain @ innovation, spread - gain @ spread)


def _axes_of_travel(velocity: Array) -> Array:
    """Unit vectors (3, 3) along a ``velocity`` (3,), sideways and downwards, one a row."""
    along = velocity / max(float(np.linalg.norm(velocity)), 1e-9)
    sideways = np.cross(DOWN, along)
    sideways /= max(float(np.linalg.norm(sideways)), 1e-9)
    return np.array([along, sideways, np.cross(along, sideways)])


def _log_normal(residual: Array, covariance: Array) -> float:
    _, log_determinant = np.linalg.slogdet(2 * np.pi * covariance)
    return float(-0.5 * (residual @ np.linalg.solve(covariance, residual) + log_determinant))
