"""Surveys of a site with known truth: vehicles of several days with all that makes their speeds alike, and what a rig
measures of them. Speeds in m/s, written apart from the statistics that are tried on them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import expit

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MPH = 0.44704  # m/s, exact by definition
DAY_S, QUARTER_S, GROUP_S = 86_400.0, 900.0, 600.0  # s; group: vehicles measured together
QUARTERS = 96  # quarter-hours of a day
DESIRED_MEAN_MPH, DESIRED_STD_MPH, LANE_MPH = 36.0, 4.6, 2.0  # of leaders; lane 1 is faster by the last
TAIL_SHARE, TAIL_MEAN_MPH = 0.08, 4.0  # leaders who exceed their desired speed, exponentially distributed
NOON_MPH, NOON_STD_H = -1.5, 2.0  # slower at noon
QUARTER_STD_MPH, QUARTER_CORRELATION = 0.7, 0.6
FOLLOWING, FOLLOWER_STD_MPH, FOLLOWER_GAP_S = 0.35, 0.8, 2.0  # probability that another follows; speed; headway
CALIBRATION_STDS = np.array(
    [0.004, 0.0015, 0.0015, 0.001]
)  # relative: scale, by lane, by a vehicle's place in the lane
GROUP_STD = 0.003  # relative
OWN_STD_SPREAD = 0.4  # standard deviation of the logarithm of the vehicles' own standard deviations
ROUGH_STD = 0.04  # relative, of rough speeds
HALF_MISSED_MPH = 42.0  # at which half of the fall of the measured share has come
MISSED_SCALE_MPH = 2.5


@dataclass(frozen=True)
class Site:
    """What is filmed and how: ``days``, ``per_day`` vehicles in the observed ``hours`` (from, to) of the day.

    ``day_std_mph`` is that of day effects, ``own_mph`` the median of the speeds' own standard deviations, stated as
    ``stated_share`` of it, with errors of Student's t of ``own_dof`` degrees of freedom scaled to it; ``captured`` the
    measured share of slow and of fast vehicles; ``calibrations`` as many rigs, one after the other; ``change_mph`` is
    added to all speeds, ``unequal`` lets the days' flows differ by a factor of up to 4.
    """

    name: str
    days: int
    per_day: float
    hours: tuple[float, float] = (0.0, 24.0)
    day_std_mph: float = 0.5
    own_mph: float = 0.3
    own_dof: float = np.inf
    stated_share: float = 1.0
    captured: tuple[float, float] = (0.97, 0.85)
    calibrations: int = 1
    scope: Any = "days"
    change_mph: float = 0.0
    unequal: bool = False


@dataclass(frozen=True, eq=False)
class Survey:
    """Passages (N,) in order of time: ``true`` and measured speeds ``v``, rough speeds, all m/s, and what a store would
    know of them. ``calibration`` (N,) is the number of the rig, ``relative`` (N, 4) the response of a speed to its
    parameters, which have the covariance 1: c = relative × v."""

    line_at: Array
    day: Indices
    lane: Indices
    true: Array
    v: Array
    random_std: Array
    rough: Array
    measured: NDArray[np.bool_]
    calibration: Indices
    relative: Array


SITES = (
    Site("7 days, 10,000 vehicles, one calibration", 7, 1430),
    Site("14 days, 2 h each", 14, 570, hours=(7.0, 9.0)),
    Site("8 days, calibrated anew half-way", 8, 1430, calibrations=2),
    Site("5 days, 900 vehicles", 5, 180),
    Site("3 days, 4,400 vehicles, days as clusters", 3, 1467),
    Site("7 days, own error 1.5 mph", 7, 1430, own_mph=1.5),
    Site("7 days, measured share falls from 95 to 55 %", 7, 1430, captured=(0.95, 0.55)),
    Site("1 day, 1,500 vehicles, `recorded`", 1, 1500, day_std_mph=0.0, scope="recorded"),
    Site("2 days, 2,900 vehicles, `recorded`", 2, 1450, day_std_mph=0.0, scope="recorded"),
)
STRESS_SITES = (
    Site("7 days, flows of days differ up to fourfold", 7, 1430, unequal=True),
    Site("7 days, own error 1.5 mph, heavy tails (t₃)", 7, 1430, own_mph=1.5, own_dof=3.0),
    Site("7 days, own error 1.5 mph, stated as 1.2", 7, 1430, own_mph=1.5, stated_share=0.8),
    Site("7 days, own error 1.5 mph, stated as 1.8", 7, 1430, own_mph=1.5, stated_share=1.2),
)


def flow_profile(hour: Array) -> Array:
    """The flow at an ``hour`` (N,) of the day, relative: little at night, peaks in the morning and the afternoon."""
    peaks = np.exp(-(((hour - 8) / 1.5) ** 2) / 2) + 1.2 * np.exp(-(((hour - 17) / 2) ** 2) / 2)
    return 0.08 + peaks + 0.8 * expit((hour - 6.5) * 2) * expit((20.5 - hour) * 2)


def simulate(site: Site, rng: np.random.Generator, rigs: Array | None = None) -> Survey:
    """A survey of a site; day effects, quarter-hour effects, vehicles and errors are drawn by ``rng``, those of the
    calibrations too, unless ``rigs`` (calibrations, 4) states them, in their standard deviations."""
    line_at, day, lane, true = traffic(site, rng)
    N = len(true)
    calibration = np.minimum(day * site.calibrations // site.days, site.calibrations - 1)
    relative = CALIBRATION_STDS * np.column_stack([np.ones(N), lane == 0, lane == 1, rng.normal(size=N)])
    rigs = rng.normal(size=(site.calibrations, len(CALIBRATION_STDS))) if rigs is None else rigs
    groups, group = np.unique(line_at // GROUP_S, return_inverse=True)
    factor = 1 + (relative * rigs[calibration]).sum(1) + GROUP_STD * rng.normal(size=len(groups))[group]
    own = site.own_mph * MPH * np.exp(OWN_STD_SPREAD * rng.normal(size=N))
    noise = rng.normal(size=N)
    if np.isfinite(site.own_dof):
        noise = rng.standard_t(site.own_dof, N) * np.sqrt((site.own_dof - 2) / site.own_dof)
    slow, fast = site.captured
    captured = slow + (fast - slow) * expit((true / MPH - HALF_MISSED_MPH) / MISSED_SCALE_MPH)
    rough = true * (1 + ROUGH_STD * rng.normal(size=N))
    v, measured = true * factor + own * noise, rng.uniform(size=N) < captured
    stated = site.stated_share * own
    return Survey(
        line_at, day, lane, true, np.where(measured, v, np.nan), stated, rough, measured, calibration, relative
    )


def traffic(site: Site, rng: np.random.Generator) -> tuple[Array, Indices, Indices, Array]:
    """Instants (N,) s, days, lanes and true speeds m/s of all vehicles of a site, in order of time."""
    centres = (np.arange(QUARTERS) + 0.5) * 24 / QUARTERS
    profile = np.where((centres >= site.hours[0]) & (centres < site.hours[1]), flow_profile(centres), 0.0)
    size = rng.uniform(0.5, 2.0, site.days) if site.unequal else np.ones(site.days)
    leaders = site.per_day * (1 - FOLLOWING) * size[:, None] * profile / profile.sum()
    count = rng.poisson(leaders).ravel()  # in each quarter-hour of each day
    quarter = np.repeat(np.arange(len(count)), count)
    at = (quarter + rng.uniform(size=len(quarter))) * QUARTER_S
    lane = rng.integers(0, 2, len(at))
    speed = DESIRED_MEAN_MPH + site.change_mph + LANE_MPH * lane + DESIRED_STD_MPH * rng.normal(size=len(at))
    speed += (rng.uniform(size=len(at)) < TAIL_SHARE) * rng.exponential(TAIL_MEAN_MPH, len(at))
    speed += NOON_MPH * np.exp(-(((at % DAY_S / 3600 - 12) / NOON_STD_H) ** 2) / 2)
    day_effects = site.day_std_mph * rng.normal(size=site.days)
    speed += day_effects[quarter // QUARTERS] + quarter_effects(site.days * QUARTERS, rng)[quarter]
    members = rng.geometric(1 - FOLLOWING, len(at))
    leader = np.repeat(np.arange(len(at)), members)
    place = np.arange(len(leader)) - np.repeat(np.cumsum(members) - members, members)
    followed = speed[leader] + np.where(place > 0, FOLLOWER_STD_MPH * rng.normal(size=len(leader)), 0.0)
    passed = at[leader] + FOLLOWER_GAP_S * place
    order = np.argsort(passed)
    day = (quarter // QUARTERS)[leader][order]
    return passed[order], day, lane[leader][order], np.maximum(followed[order], 5.0) * MPH


def quarter_effects(count: int, rng: np.random.Generator) -> Array:
    """What all speeds of each of ``count`` quarter-hours have in common, mph: an autoregressive process."""
    drawn = QUARTER_STD_MPH * rng.normal(size=count)
    drawn[1:] *= np.sqrt(1 - QUARTER_CORRELATION**2)
    return np.asarray(lfilter([1.0], [1.0, -QUARTER_CORRELATION], drawn))


def true_speeds(site: Site, seed: int) -> Array:
    """True speeds m/s of the vehicles of all days at a site."""
    return traffic(site, np.random.default_rng(seed))[3]
