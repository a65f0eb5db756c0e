"""Joint self-calibration: the vehicles of one recording share a rig, so their evidence about it adds up.

Each vehicle's fit is a Gaussian in its own motion and in the rig's offset from rig.yaml
(`speed/refinement/self_calibration.py`). The information about the rig is summed over the vehicles and every speed is
corrected to the common rig. As a rig drifts, for instance with temperature, only vehicles of about the same time are
combined.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from paceline.arrays import Array
from paceline.speed import acceptance
from paceline.speed.configuration import DEFAULTS, JointCalibrationSettings, SpeedConfiguration
from paceline.speed.refinement.photometric_fit import MIN_INFORMATION_SHARE
from paceline.speed.results import ExposureEstimate, Measurement, RigInformation, Synchronisation, Track
from paceline.units import COVERAGE_95
from paceline.verdicts import message

SAME_VEHICLE_M = 2.0  # greatest median distance between two tracks of one vehicle, m


@dataclass(frozen=True, eq=False)
class CanonicalGaussian:
    """A Gaussian of the rig's offset in canonical (information) form.

    ``precision`` is (Q, Q) and ``score`` (Q,) the precision times the mean. Independent evidence adds up.
    """

    precision: Array
    score: Array

    def __add__(self, other: CanonicalGaussian) -> CanonicalGaussian:
        return CanonicalGaussian(self.precision + other.precision, self.score + other.score)

    def __sub__(self, other: CanonicalGaussian) -> CanonicalGaussian:
        return CanonicalGaussian(self.precision - other.precision, self.score - other.score)

    @property
    def covariance(self) -> Array:
        return np.asarray(np.linalg.inv(self.precision))

    @property
    def mean(self) -> Array:
        return np.asarray(np.linalg.solve(self.precision, self.score))


def rig_prior(Q: int) -> CanonicalGaussian:
    """The calibration as rig.yaml states it: offset 0 ± 1 in each of ``Q`` directions."""
    return CanonicalGaussian(np.eye(Q), np.zeros(Q))


def rig_evidence(rig: RigInformation) -> CanonicalGaussian:
    """What a vehicle's images add to the prior; its own offset was estimated under that prior."""
    return CanonicalGaussian(rig.information, rig.information @ rig.offset + rig.offset)


def shift_sigma(estimate: CanonicalGaussian, evidence: CanonicalGaussian) -> float:
    """By how many standard deviations ``evidence`` shifts an ``estimate`` of the rig.

    The maximum over independent directions, of those that the evidence determines to some degree.
    """
    root = np.linalg.cholesky(estimate.covariance)
    information, axes = np.linalg.eigh(root.T @ evidence.precision @ root)
    information = np.maximum(information, 0.0)
    shift = axes.T @ np.linalg.solve(root, (estimate + evidence).mean - estimate.mean)
    share = information / (1.0 + information)
    determined = share > MIN_INFORMATION_SHARE
    return float((np.abs(shift[determined]) / np.sqrt(share[determined])).max(initial=0.0))


def combine_consistent(
    evidence: Sequence[CanonicalGaussian], max_shift_sigma: float = DEFAULTS.limits.rig_shift_sigma
) -> tuple[CanonicalGaussian, NDArray[np.bool_]]:
    """The posterior of one rig from the prior and all consistent ``evidence``, and which of it (V,) was used.

    The least consistent piece is left out, one after the other. None is used where the last two contradict each other,
    as nothing shows which of them is right.
    """
    consistent, prior = np.full(len(evidence), True), rig_prior(len(evidence[0].score))
    while consistent.sum() > 1:
        posterior = sum((e for e, u in zip(evidence, consistent, strict=True) if u), prior)
        shifts = np.array(
            [shift_sigma(posterior - e, e) if u else 0.0 for e, u in zip(evidence, consistent, strict=True)]
        )
        if shifts.max() <= max_shift_sigma:
            return posterior, consistent
        consistent[np.argmax(shifts)] = False
    return prior, np.full(len(evidence), False)


def moments(rig: CanonicalGaussian, synchronisation: Synchronisation | None) -> tuple[Array, Array]:
    """Mean (Q,) and covariance (Q, Q) of a ``rig`` whose cameras may be triggered together, by model averaging.

    The odds of that are the ratio of the posterior and the prior density of no offset (Savage–Dickey).
    """
    mean, C = rig.mean, rig.covariance
    if synchronisation is None:
        return mean, C
    i = synchronisation.direction
    gain = C[:, i] / C[i, i]
    change = gain * (synchronisation.value - mean[i])
    density = norm.pdf(synchronisation.value, mean[i], np.sqrt(C[i, i]))
    probability = density / (density + synchronisation.density)
    covariance = C - probability * np.outer(gain, C[i])
    covariance += probability * (1.0 - probability) * np.outer(change, change)
    return mean + probability * change, covariance


def corrected(m: Measurement, rig: CanonicalGaussian) -> Measurement:
    """``m`` with its speeds at the estimated ``rig``, whose covariance gives the systematic part."""
    information = m.rig_information
    assert information is not None
    mean, covariance = moments(rig, information.synchronisation)
    change = mean - information.offset
    systematic = float(np.sqrt(information.mean_speed_gradient @ covariance @ information.mean_speed_gradient))
    half_width = float(np.hypot(information.half_width, COVERAGE_95 * systematic))
    speed = m.speed + float(information.mean_speed_gradient @ change)
    variances = np.einsum("nq,qr,nr->n", information.speed_jacobian, covariance, information.speed_jacobian)
    speed_changes = information.speed_jacobian @ change
    ends = np.flatnonzero(np.isfinite(speed_changes))[[0, -1]]
    speeds, stds = m.track.refined_speed + speed_changes, np.sqrt(information.speed_stds**2 + variances)
    return replace(
        m,
        track=replace(m.track, refined_speed=speeds, refined_std=stds),
        speed=speed,
        speed_lo=speed - half_width,
        speed_hi=speed + half_width,
        random_std=information.mean_speed_std,
        systematic_std=systematic,
        acceleration=m.acceleration + float(np.diff(speed_changes[ends])[0] / np.diff(m.track.time[ends])[0]),
    )


def neighbours(
    m: Measurement, others: Iterable[Measurement], settings: JointCalibrationSettings = DEFAULTS.joint_calibration
) -> list[Measurement]:
    """The ``others`` to combine with ``m``, nearest in time first; a vehicle that is outlined twice counts once."""
    candidates = [
        (abs(float(o.track.time.mean() - m.track.time.mean())), o) for o in others if o.rig_information is not None
    ]
    nearby: list[Measurement] = []
    for interval, other in sorted(candidates, key=lambda pair: pair[0]):
        if interval > settings.window_s or len(nearby) == settings.neighbours:
            break
        if not any(same_vehicle(other.track, known.track) for known in [m, *nearby]):
            nearby.append(other)
    return nearby


def same_vehicle(track: Track, other: Track) -> bool:
    """Whether two tracks are of one vehicle, by their distance in the frames that they share."""
    _, i, j = np.intersect1d(track.frame, other.frame, return_indices=True)
    distances = np.linalg.norm(track.position[i] - other.position[j], axis=1)
    return len(distances) > 0 and float(np.median(distances)) < SAME_VEHICLE_M


def with_neighbours(
    m: Measurement, others: Iterable[Measurement], configuration: SpeedConfiguration = DEFAULTS
) -> Measurement:
    """``m`` corrected to the rig that it and its `neighbours` among ``others`` determine, with a new verdict.

    It is rejected if it contradicts the other vehicles, or if all of them contradict rig.yaml. Where no two vehicles
    are consistent, only the chance that both cameras are triggered together is taken into account.
    """
    if m.rig_information is None:
        return m
    group = [*neighbours(m, others, configuration.joint_calibration), m]
    evidence = [rig_evidence(o.rig_information) for o in group if o.rig_information is not None]
    limit = configuration.limits.rig_shift_sigma
    posterior, used = combine_consistent(evidence, limit)
    if not used.any():
        if m.rig_information.synchronisation is None:
            return m
        posterior, used[-1] = rig_prior(len(m.rig_information.offset)) + evidence[-1], True
    count, prior = int(used.sum()), rig_prior(len(m.rig_information.offset))
    if not used[-1]:
        shift = shift_sigma(posterior, evidence[-1])
        reason = message("calibration_differs_between_vehicles", deviation=shift, max_deviation=limit)
    elif (shift := shift_sigma(prior, posterior - prior)) > limit:
        reason = message("calibration_inconsistent_jointly", vehicles=count, deviation=shift, max_deviation=limit)
    else:
        random, m = m.rig_information.half_width, replace(corrected(m, posterior), calibrated_by=count)
        reason = acceptance.check_interval(m.speed, (m.speed_hi - m.speed_lo) / 2, random, configuration.limits)
    return replace(m.with_verdict(reason), rig_information=None)


def calibrate_jointly(
    measurements: Sequence[Measurement], configuration: SpeedConfiguration = DEFAULTS
) -> list[Measurement]:
    """The ``measurements`` of one recording, each corrected to the rig that neighbouring vehicles determine."""
    return [with_neighbours(m, [o for o in measurements if o is not m], configuration) for m in measurements]


def estimate_exposures(measurements: Sequence[Measurement]) -> dict[str, ExposureEstimate]:
    """What all vehicles of a recording together determine of its exposures, by the quantity's name."""
    informed = [(m, m.rig_information) for m in measurements if m.rig_information is not None]
    if not informed or not (stds := informed[0][1].exposure_stds):
        return {}
    evidence = [rig_evidence(information) for _, information in informed]
    single = rig_prior(len(evidence[0].score)) + evidence[0]
    posterior = combine_consistent(evidence)[0] if len(evidence) > 1 else single
    first = len(posterior.score) - len(stds)
    mean, covariance = moments(posterior, informed[0][1].synchronisation)
    spread = np.sqrt(np.diag(covariance))
    effects = np.median([np.abs(r.mean_speed_gradient * spread) / max(m.speed, 1e-9) for m, r in informed], axis=0)
    return {
        name: ExposureEstimate(float(std * mean[i]), float(std * spread[i]), float(effects[i]))
        for i, (name, std) in enumerate(stds.items(), first)
    }
