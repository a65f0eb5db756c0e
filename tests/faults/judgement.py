"""What counts as a failure of the product: numbers that are wrong, ends that are not in the contract, what is left."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .cases import Case, Visibility
from .processes import Ended

KINDS = "wrong number", "traceback", "hang", "left behind", "lost", "exit status"
MIN_ERROR_SHARE = 0.005  # of the true value, by which a wrong number lies outside its interval at least
INTERRUPTED = {"SIGINT": 130, "SIGTERM": 143}
SAID = "paceline: ", "note: "  # what lines on standard error begin with


@dataclass(frozen=True)
class Reading:
    """A number that a run states, with its interval, and the true one."""

    name: str
    value: float
    low: float
    high: float
    true: float

    @property
    def wrong(self) -> bool:
        """Whether the truth lies farther outside the interval than half its width and MIN_ERROR_SHARE of the truth."""
        outside = max(self.low - self.true, self.true - self.high)
        return outside > max((self.high - self.low) / 2, MIN_ERROR_SHARE * abs(self.true))


@dataclass(frozen=True)
class Outcome:
    """What a case's run did: how it ended, what it states, and how the files around it have changed.

    ``expected_new`` are the names that its output may have in the folder where ``new`` files are.
    """

    ended: Ended
    readings: tuple[Reading, ...] = ()
    new: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    complete: bool = False  # there is an output, and nothing of it is missing


@dataclass(frozen=True)
class Finding:
    """A failure of one of the KINDS."""

    kind: str
    text: str


def judge(case: Case, outcome: Outcome) -> list[Finding]:
    """All that counts as a failure of the product in a case."""
    ended = outcome.ended
    if ended.hung:
        return [Finding("hang", f"no end within {ended.seconds:.0f} s")]
    return [
        *_wrong_numbers(case, outcome.readings),
        *_crash(ended),
        *_exit_status(case, outcome),
        *_left(ended, outcome),
        *(Finding("lost", f"{name} is not what it was") for name in outcome.changed),
    ]


def _wrong_numbers(case: Case, readings: Sequence[Reading]) -> list[Finding]:
    if case.visibility == Visibility.NOT_VISIBLE:
        return []
    return [
        Finding("wrong number", f"{r.name}: {r.value:.4g} ({r.low:.4g} to {r.high:.4g}), true {r.true:.4g}")
        for r in readings
        if r.wrong
    ]


def _crash(ended: Ended) -> list[Finding]:
    lines = ended.stderr.splitlines()
    for k, line in enumerate(lines):
        if line.startswith(("Traceback", "Fatal Python error", "Exception ignored")) or "terminate called" in line:
            last = next((text for text in reversed(lines[k:]) if text.strip()), "")
            return [Finding("traceback", last.strip()[:160])]
    if ended.status < 0:
        return [Finding("traceback", f"ended by signal {-ended.status}")]
    return []


def _exit_status(case: Case, outcome: Outcome) -> list[Finding]:
    """What the contract in docs/files.md says of exit statuses and standard error."""
    ended, found = outcome.ended, []
    allowed = {0, 1, 2}
    if (interrupted := INTERRUPTED.get(case.disturbance.kind)) is not None:
        allowed.add(interrupted)
    if ended.status >= 0 and ended.status not in allowed:
        found.append(Finding("exit status", f"{ended.status}"))
    lines = [line for line in ended.stderr.splitlines() if line.strip()]
    if _crash(ended):
        return found
    strange = [line for line in lines if not line.startswith(SAID)]
    if strange:
        found.append(Finding("exit status", f"standard error: {strange[0][:120]}"))
    elif ended.status == 2 and (len(lines) != 1 or not lines[0].startswith("paceline: ")):
        found.append(Finding("exit status", f"2 with {len(lines)} lines on standard error"))
    if ended.status == 0 and not outcome.complete:
        found.append(Finding("exit status", "0 without all of the output"))
    return found


def _left(ended: Ended, outcome: Outcome) -> list[Finding]:
    found = [Finding("left behind", name) for name in outcome.new]
    if ended.survivors:
        found.append(Finding("left behind", f"{ended.survivors} processes"))
    return found


def contents(folder: Path) -> dict[str, str]:
    """What is in a folder: a digest of every file, and what else there is, by its name."""
    return {str(path.relative_to(folder)): _digest(path) for path in sorted(folder.rglob("*"))}


def _digest(path: Path) -> str:
    if path.is_symlink():
        return f"link to {path.readlink()}"
    if path.is_dir():
        return "folder"
    if not path.is_file():
        return "no file"
    return hashlib.sha256(path.read_bytes()).hexdigest()
