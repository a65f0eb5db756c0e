"""The settings that a page may choose for a run, validated by their model, as arguments of the command line."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import ValidationError

from paceline.console.runs.kinds import FOLLOW_RUN, LIVE_RUN, SPEED_RUN
from paceline.errors import UnusableInput
from paceline.speed.choices import Motion
from paceline.speed.configuration import SpeedSettings
from paceline.units import SpeedUnit, convert, parse_speed, parse_unit

MOTION_NAMES: tuple[str, ...] = get_args(Motion)
UNIT_NAMES = tuple(unit.value for unit in SpeedUnit)
OPTION_NAMES = {"tolerance": "--max-half-width", "learn": "--background-seconds"}  # where a setting is named otherwise


def setting_range(name: str) -> tuple[float | None, float | None]:
    """The least and the greatest value of a numeric setting, None where its model has no such limit."""
    limits = {
        kind: value
        for limit in SpeedSettings.model_fields[name].metadata
        for kind in ("ge", "le")
        if (value := getattr(limit, kind, None)) is not None
    }
    return limits.get("ge"), limits.get("le")


def command_options(kind: str, settings: dict[str, Any]) -> list[str]:
    """Arguments for a run of this ``kind``. Raises UnusableInput, naming the setting."""
    if kind not in (SPEED_RUN, LIVE_RUN):
        return ["--no-overlay"] if kind == FOLLOW_RUN and settings.get("overlay") is False else []
    names = ("particles", "seed", "motion", "units", "tolerance", *(("learn",) if kind == LIVE_RUN else ()))
    chosen = {name: settings[name] for name in names if settings.get(name) is not None}
    if chosen.get("units", UNIT_NAMES[0]) not in UNIT_NAMES:
        raise UnusableInput(f"units: expected one of {', '.join(UNIT_NAMES)}")
    try:  # a tolerance is positive in any unit
        SpeedSettings.model_validate({name: chosen[name] for name in chosen if name != "units"}, strict=True)
    except ValidationError as error:
        first = error.errors()[0]
        key, expected = ".".join(map(str, first["loc"])), first["msg"].replace("Input should be", "expected")
        raise UnusableInput(f"{key}: {expected}") from error
    if limit := str(settings.get("limit") or "").strip():
        try:
            parse_speed(limit)
        except ValueError as error:
            raise UnusableInput(f"limit: {error}") from error
        chosen["limit"] = limit
    texts = {name: f"{value:g}" if name in ("tolerance", "learn") else str(value) for name, value in chosen.items()}
    return [argument for name, text in texts.items() for argument in (OPTION_NAMES.get(name, f"--{name}"), text)]


def convert_tolerance(tolerance: float, before: str, unit: str) -> float:
    """A tolerance in the unit ``before``, converted to ``unit`` and rounded to three digits."""
    return float(f"{convert(tolerance * parse_unit(before).mps, unit):.3g}")


def parse_whole_number(value: object, maximum: int) -> int:
    """``value``, if it is a whole number from 0 to ``maximum``. Raises UnusableInput."""
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= maximum:
        raise UnusableInput(f"expected a whole number from 0 to {maximum}, found {str(value)[:40]!r}")
    return value


def parse_number(value: object) -> float:
    """``value``, if it is a number below 10⁹ in size. Raises UnusableInput."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1e9:
        raise UnusableInput(f"expected a number, found {str(value)[:40]!r}")
    return float(value)
