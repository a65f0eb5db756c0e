"""python -m tests.faults --n N --seed S [--only AREA] [--keep FOLDER]

Runs the cases of the seeds S to S + N - 1, prints a line for each failure with what repeats it, and a table by area.
"""

from __future__ import annotations

import argparse
import importlib
import os
import pkgutil
import shutil
import signal
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np

from . import documents, recordings
from .areas import run_case
from .cases import AREAS, Case, Visibility, area_of, draw_case
from .console_requests import run_console_case
from .judgement import KINDS, Finding, Outcome, judge
from .processes import can_mount

FAULTS = (*recordings.FAULTS, *documents.FAULTS)
ENDS = {0: "done", 1: "nothing measured", 2: "refused", 130: "interrupted", 143: "interrupted"}


@dataclass
class Tally:
    """The counts of an area."""

    ends: Counter[str] = field(default_factory=Counter)
    findings: Counter[str] = field(default_factory=Counter)
    measurable: int = 0
    measured: int = 0  # of the measurable ones

    def add(self, case: Case, outcome: Outcome, findings: Sequence[Finding]) -> None:
        self.ends[ENDS.get(outcome.ended.status, "other")] += 1
        self.findings.update({finding.kind for finding in findings})
        if case.measurable and case.area != "console":
            self.measurable += 1
            self.measured += outcome.ended.status == 0

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.ends + other.ends,
            self.findings + other.findings,
            self.measurable + other.measurable,
            self.measured + other.measured,
        )


def run_campaign(seeds: Sequence[int], only: str | None, keep: Path | None, stream: IO[str]) -> dict[str, Tally]:
    """Runs the cases of ``seeds`` and prints each failure to ``stream`` as it comes."""
    prepare_process()
    mounts = can_mount()
    tallies = {area: Tally() for area in AREAS if only in (None, area)}
    for seed in _until_interrupted(seeds):
        case = draw_case(seed, only or area_of(seed), FAULTS)
        folder = Path(tempfile.mkdtemp(prefix="paceline-faults-"))
        outcome = run_console_case(case, folder) if case.area == "console" else run_case(case, folder, mounts)
        findings = judge(case, outcome)
        tallies[case.area].add(case, outcome, findings)
        for line in [f"{finding.kind}: {finding.text}" for finding in findings] or _not_measured(case, outcome):
            print(f"{line}\n  {case}\n  --only {case.area} --n 1 --seed {seed}", file=stream)
        if keep is not None and (findings or len(seeds) == 1):
            kept = keep / f"{case.area}-{seed}"
            shutil.rmtree(kept, ignore_errors=True)
            shutil.copytree(folder, kept, symlinks=True, ignore=_pipes, ignore_dangling_symlinks=True)
        shutil.rmtree(folder)
        stream.flush()
        print(
            f"\r{seed - seeds[0] + 1} of {len(seeds)} cases; {case.area} took {outcome.ended.seconds:.1f} s",
            end="  ",
            file=sys.stderr,
            flush=True,
        )
    return tallies


def _not_measured(case: Case, outcome: Outcome) -> list[str]:
    """Why a case is not measured whose faults are harmless or can be repaired; that is no failure."""
    if not case.measurable or case.area == "console" or outcome.ended.status == 0:
        return []
    ended = outcome.ended
    lines = [
        line for line in ended.stdout.splitlines() if "rejected" in line or "no " in line
    ] + ended.stderr.splitlines()
    return [f"not measured: {lines[0].strip() if lines else ended.status}"]


def _until_interrupted(seeds: Sequence[int]) -> Iterator[int]:
    """The ``seeds`` up to the one after which Ctrl-C comes, so that what was done until then is reported."""
    interrupted: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: interrupted.append(number))
    try:
        for seed in seeds:
            if interrupted:
                return
            yield seed
    finally:
        signal.signal(signal.SIGINT, before)


def _pipes(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(folder) / name).is_fifo()]


def prepare_process() -> None:
    """Loads what the forks of this process use, and leaves no threads in it, which a fork does not survive.

    Plots have no content, as rendering takes most of a short run's time; processes of their own render them.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the test client's own libraries
        import console_client  # noqa: F401

    import cv2
    import matplotlib.figure
    import numba

    import paceline

    for module in pkgutil.walk_packages(paceline.__path__, "paceline."):
        if "cuda" not in module.name and "raytraced" not in module.name and not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    numba.njit(lambda x: x + 1)(np.ones(1))  # imports what Numba needs when it is first called

    def savefig(figure: object, file: IO[Any], *, format: str, **_: object) -> None:
        file.write("<svg></svg>" if format == "svg" else b"")

    matplotlib.figure.Figure.savefig = savefig  # type: ignore[method-assign, assignment]
    cv2.setNumThreads(0)


def table(tallies: dict[str, Tally]) -> str:
    """Markdown: a line for each area, and their sum."""
    ends = [*dict.fromkeys(ENDS.values()), "other"]
    head = ["area", "cases", *ends, "measured of measurable", *KINDS]
    lines = [head, ["---"] * len(head)]
    for name, tally in [*tallies.items(), ("all", sum(tallies.values(), Tally()))]:
        counts = [tally.ends[end] for end in ends]
        measured = f"{tally.measured} of {tally.measurable}"
        lines.append([name, str(sum(counts)), *map(str, counts), measured, *(str(tally.findings[k]) for k in KINDS)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def not_visible() -> str:
    """The faults that cannot be seen in principle, by name."""
    return ", ".join(fault.name for fault in FAULTS if fault.visibility == Visibility.NOT_VISIBLE)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("--n", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=AREAS)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="where the files of each failure are kept")
    options = parser.parse_args()
    os.environ |= {"NUMBA_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # one core, and no thread before a fork
    print(f"Cannot be seen in principle, so that numbers are not judged: {not_visible()}.\n", flush=True)
    tallies = run_campaign(range(options.seed, options.seed + options.n), options.only, options.keep, sys.stdout)
    print("\n" + table(tallies))
    sys.exit(any(tally.findings for tally in tallies.values()))


if __name__ == "__main__":
    main()
