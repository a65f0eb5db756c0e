"""How often intervals of a survey's percentiles, shares and differences hold the truth, over simulated surveys.

python benchmarks/survey_coverage.py [--n 2000] [--stress] [--seed 1] [--workers 1]

A quantity's truth is that of 4,800 simulated days of the site. Intervals of V85 that are compared: *recommended*, by
clusters, capture weights, measurement-error shift and calibration; *naive*, the binomial order statistics of measured
speeds as if they were independent and exact; the same joined with the calibration; ours without the calibration; ours
with quarter-hours as clusters.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from common import MPH, head, machine, row, share_out
from scipy.stats import binom
from simulated_surveys import DAY_S, SITES, STRESS_SITES, Site, Survey, simulate, true_speeds

from paceline.survey.statistics.capture import capture_weights, influence
from paceline.survey.statistics.clusters import clusters
from paceline.survey.statistics.common_error import CommonError
from paceline.survey.statistics.comparison import difference, matching_weights
from paceline.survey.statistics.distribution import percentile, share_over
from paceline.survey.statistics.estimate import (
    Blocks,
    Estimate,
    Passages,
    mean_estimate,
    pace_estimate,
    percentile_estimate,
    share_over_estimate,
)
from paceline.survey.statistics.interval import Interval, joined, percentile_interval
from paceline.survey.statistics.pace import pace

P = 0.85
LIMIT, PACE = 40 * MPH, 10 * MPH
FALL_MPH = 1.5  # between before and after
TRUE_DAYS, TRUE_PER_DAY, TRUE_SEED = 4800, 1000, 0
CHUNK = 25  # surveys that a process is given at a time
AFTER_SEED = 1_000_000  # added to the seed of a survey for that of the one after it
INTERVALS = ("recommended", "naive", "naive + calibration", "ours without calibration", "quarter-hours as clusters")
QUANTITIES = ("V50", "mean", "share over the limit", "pace share")
PAIR = "7 days, before and after a fall of 1.5 mph"


@dataclass(frozen=True)
class Work:
    """Surveys of ``site`` with so many ``seeds`` from the first on; ``is_pair``: each with one after it."""

    site: Site
    seeds: range
    is_pair: bool = False


def passages(survey: Survey, scope: str, flow: np.ndarray | None = None) -> Passages:
    """What the statistics take of a survey, with its weights of flow."""
    w, bins = capture_weights(survey.rough, survey.measured, survey.lane)
    number, lag = clusters(survey.line_at, survey.day, survey.lane, survey.day * DAY_S, scope)
    flow = np.ones(len(w)) if flow is None else flow
    return Passages(survey.v, survey.random_std, survey.measured, w, bins, number, lag, flow)


def blocks(survey: Survey) -> Blocks:
    """The calibrations of a survey by their names, with parameters of standard deviation 1."""
    found = {}
    for k in np.unique(survey.calibration):
        c = np.where(survey.calibration[:, None] == k, survey.relative * survey.v[:, None], 0.0)
        found[f"rig:{k}"] = c, np.eye(survey.relative.shape[1])
    return found


def naive_interval(survey: Survey) -> Interval:
    """Order statistics of the measured speeds whose ranks are the binomial distribution's 2.5 and 97.5 %."""
    v = np.sort(survey.v[survey.measured])
    lo, hi = (int(binom.ppf(q, len(v), P)) for q in (0.025, 0.975))
    return Interval(percentile(v, np.ones(len(v)), P), float(v[max(lo - 1, 0)]), float(v[min(hi, len(v) - 1)]))


def intervals(site: Site, seed: int) -> Iterator[tuple[str, Interval]]:
    """Each interval of one survey by its name."""
    survey = simulate(site, np.random.default_rng([seed, len(site.name)]))
    rigs, group = blocks(survey), passages(survey, site.scope)
    yield from v85_intervals(site, survey, group, rigs)
    yield "V50", percentile_estimate(group, 0.5, rigs).interval()
    yield "mean", mean_estimate(group, rigs).interval()
    yield "share over the limit", share_over_estimate(group, LIMIT, rigs).interval()
    yield "pace share", pace_estimate(group, pace(group.v, group.w, PACE), rigs).interval()


def v85_intervals(site: Site, survey: Survey, group: Passages, rigs: Blocks) -> Iterator[tuple[str, Interval]]:
    """The intervals of V85 that are compared, by their names."""
    best = percentile_estimate(group, P, rigs)
    naive = naive_interval(survey)
    yield "recommended", best.interval()
    yield "naive", naive
    yield "naive + calibration", joined(naive.value, naive, best.systematic_std)
    yield "ours without calibration", replace(best, common={}).interval()
    if site.scope == "days":
        number, lag = clusters(survey.line_at, survey.day, survey.lane, survey.day * DAY_S, "recorded")
        psi = influence(group.v, group.capture_weight, group.measured, group.bins, best.random.value, P)
        quarters = percentile_interval(group.v, group.w, psi, number, P, lag)
        yield "quarter-hours as clusters", replace(best, random=quarters).interval()


def pair_intervals(site: Site, seed: int) -> Iterator[tuple[str, Interval]]:
    """The intervals of the difference of two surveys by one rig: of V85 and of the mean, and as of two rigs."""
    before, after = simulate_pair(site, seed)
    cells = [2 * (s.line_at % DAY_S // 3600).astype(np.int64) + s.lane for s in (before, after)]
    groups = [passages(s, "days", flow) for s, flow in zip((before, after), matching_weights(*cells), strict=True)]
    rigs = [blocks(s) for s in (before, after)]
    a, b = (percentile_estimate(group, P, rig) for group, rig in zip(groups, rigs, strict=True))
    yield "one rig", difference(a, b).interval()
    yield "as of two rigs", difference(a, replace(b, common=renamed(b))).interval()
    a, b = (mean_estimate(group, rig) for group, rig in zip(groups, rigs, strict=True))
    yield "mean, one rig", difference(a, b).interval()


def simulate_pair(site: Site, seed: int) -> tuple[Survey, Survey]:
    """A survey before and one after by the same rig: its errors are drawn once."""
    errors = np.random.default_rng([seed, AFTER_SEED]).normal(size=(site.calibrations, 4))
    before = simulate(site, np.random.default_rng([seed, 0]), errors)
    return before, simulate(replace(site, change_mph=-FALL_MPH), np.random.default_rng([seed, 1]), errors)


def renamed(estimate: Estimate) -> dict[str, CommonError]:
    return {f"{name}, another": error for name, error in estimate.common.items()}


def surveyed(work: Work) -> dict[str, list[Interval]]:
    """The intervals of all surveys of a piece of work by their names."""
    found = defaultdict(list)
    for seed in work.seeds:
        for name, interval in (pair_intervals if work.is_pair else intervals)(work.site, seed):
            found[name].append(interval)
    return dict(found)


@lru_cache
def truths(hours: tuple[float, float], day_std_mph: float) -> dict[str, float]:
    """The true values of the quantities at a site, m/s or shares; of V85 under the name of each of its intervals."""
    v = true_speeds(Site("", TRUE_DAYS, TRUE_PER_DAY, hours, day_std_mph), TRUE_SEED)
    each = np.ones(len(v))
    shares = share_over(v, each, LIMIT), pace(v, each, PACE).share
    values = percentile(v, each, 0.5), float(v.mean()), *shares
    return dict.fromkeys(INTERVALS, percentile(v, each, P)) | dict(zip(QUANTITIES, values, strict=True))


def cells(found: list[Interval], truth: float, unit: float) -> tuple[str, str, str, str]:
    """Covered, median half-width, and the share of intervals that lie below and above the truth."""
    lo, hi = (np.array([getattr(i, end) for i in found]) for end in ("lo", "hi"))
    half = float(np.median(hi - lo)) / 2 / unit
    shares = [np.mean((lo <= truth) & (truth <= hi)), np.mean(hi < truth), np.mean(lo > truth)]
    covered, below, above = (f"{100 * float(s):.1f}" for s in shares)
    return f"{covered} %", f"{half:.3f}" if half < 0.1 else f"{half:.2f}", f"{below} %", f"{above} %"


def work_of(site: Site, n: int, seed: int, is_pair: bool = False) -> list[Work]:
    """``n`` surveys from ``seed`` on, in chunks."""
    return [Work(site, range(k, min(k + CHUNK, seed + n)), is_pair) for k in range(seed, seed + n, CHUNK)]


def main() -> None:
    parser = argparse.ArgumentParser(description="How often the intervals of simulated surveys hold the truth.")
    parser.add_argument("--n", type=int, default=2000, help="surveys of each site, and pairs")
    parser.add_argument("--stress", action="store_true", help="sites at which an assumption does not hold")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first survey")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    args = parser.parse_args()
    columns = ("interval", "covered", "median half-width, mph", "below the truth", "above")
    print(head("site", "surveys", *columns), flush=True)
    others = []
    for site in STRESS_SITES if args.stress else SITES:
        truth = truths(site.hours, site.day_std_mph)
        found = gathered(work_of(site, args.n, args.seed), args.workers)
        for name in INTERVALS:
            if name in found:
                print(row(site.name, args.n, name, *cells(found[name], truth[name], MPH)), flush=True)
        for name in QUANTITIES:
            unit = MPH if name in ("V50", "mean") else 0.01
            others.append(row(site.name, args.n, name, *cells(found[name], truth[name], unit)))
    print("\n" + head("site", "surveys", "quantity", "covered", "median half-width, mph or %", *columns[3:]))
    print("\n".join(others), flush=True)
    if args.stress:
        print(f"\n{machine()}")
        return
    print("\n" + head("pairs of surveys", "pairs", "difference", *columns[1:]))
    for name, intervals_of_name in gathered(work_of(SITES[0], args.n, args.seed, True), args.workers).items():
        print(row(PAIR, args.n, name, *cells(intervals_of_name, -FALL_MPH * MPH, MPH)))
    print(f"\n{machine()}")


def gathered(work: list[Work], workers: int) -> dict[str, list[Interval]]:
    """The intervals of all pieces of work by their names, in the order of the seeds."""
    found: dict[str, list[Interval]] = defaultdict(list)
    for part in share_out(surveyed, work, workers):
        for name, values in part.items():
            found[name] += values
    return found


if __name__ == "__main__":
    main()
