"""A case of the campaign: what is done to which command, drawn from a seed and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

AREAS = "speed", "follow", "calibrate", "lanes", "vehicles", "live", "console"
AREA_SHARES = 0.24, 0.17, 0.13, 0.02, 0.05, 0.01, 0.38  # of the cases
CASES_PER_SCENE = 25  # consecutive seeds whose recordings are made from the same rendered pictures
FAULT_COUNT_SHARES = 0.1, 0.5, 0.28, 0.12  # of cases with 0, 1, 2, 3 faults
DISTURBED_SHARE = 0.25  # of the cases of a command: what disturbs its process
EARLIER_OUTPUT_SHARE = 0.4  # of the cases: the output folder holds the results of an earlier run


class Visibility(IntEnum):
    """What a fault does to a result, in principle; of several faults the highest counts."""

    HARMLESS = 0  # nothing: the result is right
    REPAIRABLE = 1  # what is left of the recording gives a right result
    VISIBLE = 2  # the recording contradicts itself: right, or rejected
    NOT_VISIBLE = 3  # another recording, without any fault, looks the same: the number is not judged


@dataclass(frozen=True)
class Fault:
    """A fault by ``name``, in the recordings of the ``areas``."""

    name: str
    visibility: Visibility
    areas: tuple[str, ...]
    apply: Callable[[Any, np.random.Generator], None]


@dataclass(frozen=True)
class Disturbance:
    """What disturbs a process: a signal ``after`` so many seconds, or a limit of ``size`` bytes."""

    kind: str = ""  # SIGINT | SIGTERM | full disk | file size | memory; empty: nothing
    after: float = 0.0
    size: int = 0
    own_process: bool = False  # one that starts the interpreter, instead of a fork of one that has imported all


@dataclass(frozen=True)
class Case:
    """One run of a command, with everything that is done to it, and whether that can be seen in principle."""

    seed: int
    area: str
    faults: tuple[Fault, ...]
    disturbance: Disturbance
    earlier_output: bool

    @property
    def visibility(self) -> Visibility:
        return max((fault.visibility for fault in self.faults), default=Visibility.HARMLESS)

    @property
    def scene_seed(self) -> int:
        return self.seed // CASES_PER_SCENE

    @property
    def measurable(self) -> bool:
        """Whether the result has to be measured: nothing is wrong but what is harmless or can be repaired."""
        return self.visibility <= Visibility.REPAIRABLE and not self.disturbance.kind

    def rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, AREAS.index(self.area), purpose])

    def __str__(self) -> str:
        names = [fault.name for fault in self.faults] or ["no fault"]
        if self.disturbance.kind:
            names.append(self.disturbance.kind)
        return f"{self.visibility.name.lower().replace('_', ' ')}: {', '.join(names)}"


def area_of(seed: int) -> str:
    return str(np.random.default_rng([seed, 11]).choice(AREAS, p=AREA_SHARES))


def draw_case(seed: int, area: str, faults: Sequence[Fault]) -> Case:
    """The case of a ``seed`` in an ``area``, with some of the ``faults`` that are possible there."""
    case = Case(seed, area, (), Disturbance(), False)
    rng = case.rng(1)
    possible = [fault for fault in faults if area in fault.areas]
    count = min(int(rng.choice(len(FAULT_COUNT_SHARES), p=FAULT_COUNT_SHARES)), len(possible))
    chosen = sorted(rng.choice(len(possible), count, replace=False).tolist()) if count else []
    disturbance = _draw_disturbance(rng, area)
    return Case(seed, area, tuple(possible[k] for k in chosen), disturbance, bool(rng.random() < EARLIER_OUTPUT_SHARE))


def _draw_disturbance(rng: np.random.Generator, area: str) -> Disturbance:
    own_process = area == "live"
    if area == "console" or rng.random() >= DISTURBED_SHARE:
        return Disturbance(own_process=own_process)
    kinds = ("SIGINT", "SIGTERM", "full disk", "file size", *(() if own_process else ("memory",)))
    kind = str(rng.choice(kinds))
    if kind in ("SIGINT", "SIGTERM"):
        own_process = own_process or bool(rng.random() < 0.25)
        return Disturbance(kind, float(rng.uniform(0.0, 8.0 if own_process else 2.0)), 0, own_process)
    low, high = {"full disk": (2e4, 2e6), "file size": (2e4, 1e6), "memory": (3e7, 6e8)}[kind]
    return Disturbance(kind, 0.0, int(np.exp(rng.uniform(np.log(low), np.log(high)))), own_process)
