"""What a page may ask of a run, as arguments of the command line: known settings in known ranges, and nothing else."""

from __future__ import annotations

from typing import Any

from paceline.console.runs.kinds import AHEAD, LIVE, SPEED
from paceline.errors import UnusableInput
from paceline.units import convert, parse_unit

LEAST_PARTICLES, MOST_PARTICLES = 20, 100_000
MOTIONS, UNITS = ("auto", "free", "line", "curve"), ("mph", "km/h", "m/s")
MOST_TOLERANCE = 1000.0  # of any unit
LEAST_LEARNING, MOST_LEARNING = 2.0, 3600.0  # s


def options_of(kind: str, given: dict[str, Any]) -> list[str]:
    """Arguments for a run of this ``kind``. Raises UnusableInput, naming the setting."""
    if kind not in (SPEED, LIVE):
        return ["--no-overlay"] if kind == AHEAD and given.get("overlay") is False else []
    arguments: list[str] = []
    for option, most in (("particles", MOST_PARTICLES), ("seed", 2**31)):
        if given.get(option) is not None:
            arguments += [f"--{option}", str(to_whole(given[option], most))]
    if given.get("particles") is not None and given["particles"] < LEAST_PARTICLES:
        raise UnusableInput(f"particles: expected {LEAST_PARTICLES} to {MOST_PARTICLES}")
    for option, valid in (("motion", MOTIONS), ("units", UNITS)):
        if given.get(option) is not None:
            if given[option] not in valid:
                raise UnusableInput(f"{option}: expected one of {', '.join(valid)}")
            arguments += [f"--{option}", str(given[option])]
    if given.get("tolerance") is not None:
        if not 0 < (half := to_number(given["tolerance"])) <= MOST_TOLERANCE:
            raise UnusableInput(f"tolerance: expected a speed above 0, at most {MOST_TOLERANCE:g}")
        arguments += ["--tolerance", f"{half:g}"]
    if kind == LIVE and given.get("learn") is not None:
        seconds = to_number(given["learn"])
        if not LEAST_LEARNING <= seconds <= MOST_LEARNING:
            raise UnusableInput(f"learn: expected {LEAST_LEARNING:g} to {MOST_LEARNING:g} seconds")
        arguments += ["--learn", f"{seconds:g}"]
    return arguments


def in_unit(tolerance: float, before: str, unit: str) -> float:
    """A tolerance in the unit ``before`` in another ``unit``, as many of them as make it as much as it was."""
    return float(f"{convert(tolerance * parse_unit(before).mps, unit):.3g}")


def to_whole(value: object, most: int) -> int:
    """``value``, if it is a whole number from 0 to ``most``. Raises UnusableInput."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
        raise UnusableInput(f"expected a whole number from 0 to {most}, found {str(value)[:40]!r}")
    return value


def to_number(value: object) -> float:
    """``value``, if it is a number that anything here can be. Raises UnusableInput."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e9:
        raise UnusableInput(f"expected a number, found {str(value)[:40]!r}")
    return float(value)
