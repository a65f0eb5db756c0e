"""The settings that a page may choose for a run, validated by their model, as arguments of the command line."""

from __future__ import annotations

from typing import Any, get_args

from pydantic import ValidationError

from paceline.console.runs.kinds import FOLLOW_RUN, LIVE_RUN, SPEED_RUN
from paceline.errors import UnusableInput
from paceline.speed.choices import Motion
from paceline.speed.configuration import BackgroundSettings, SpeedSettings
from paceline.speed.settings_table import range_of, shown
from paceline.units import MAX_STATED_SPEED_MPS, SpeedUnit, convert, parse_speed, parse_unit

MOTION_NAMES: tuple[str, ...] = get_args(Motion)
UNIT_NAMES = tuple(unit.value for unit in SpeedUnit)
OPTION_NAMES = {"tolerance": "--max-half-width", "learn": "--background-seconds"}  # where a setting is named otherwise
SETTING_FIELDS = {
    **{name: SpeedSettings.model_fields[name] for name in ("particles", "seed", "tolerance")},
    "learn": BackgroundSettings.model_fields["seconds"],
}


def setting_hint(name: str, unit: str = "") -> str:
    """The default and the range of a setting of SETTING_FIELDS, whose values are in ``unit``."""
    field, suffix = SETTING_FIELDS[name], f" {unit}" if unit else ""
    default = "none" if field.default is None else shown(field.default) + suffix
    return f"default: {default}; {range_of(field)}{suffix}"


def limit_hint(unit: str) -> str:
    """The default and the range of a posted limit, in ``unit``."""
    return f"default: that of the files, if any; above 0, at most {convert(MAX_STATED_SPEED_MPS, unit):.0f} {unit}"


def setting_problem(name: str, value: object) -> str | None:
    """Why ``value`` cannot be that of a setting; None where it can, or where it is left to the default."""
    found = _refusal({} if value is None else {name: value}, strict=False)
    return None if found is None else found[1]


def limit_problem(text: str | None) -> str | None:
    """Why ``text`` states no posted limit; None where it does, or is empty."""
    try:
        _parse_limit(text)
    except UnusableInput as error:
        return str(error).removeprefix("limit: ")
    return None


def command_options(kind: str, settings: dict[str, Any]) -> list[str]:
    """Arguments for a run of this ``kind``. Raises UnusableInput, naming the setting."""
    if kind not in (SPEED_RUN, LIVE_RUN):
        return ["--no-overlay"] if kind == FOLLOW_RUN and settings.get("overlay") is False else []
    names = ("particles", "seed", "motion", "units", "tolerance", *(("learn",) if kind == LIVE_RUN else ()))
    chosen = {name: settings[name] for name in names if settings.get(name) is not None}
    if chosen.get("units", UNIT_NAMES[0]) not in UNIT_NAMES:
        raise UnusableInput(f"units: expected one of {', '.join(UNIT_NAMES)}")
    # a tolerance is positive in any unit
    if found := _refusal({name: chosen[name] for name in chosen if name != "units"}, strict=True):
        raise UnusableInput(": ".join(found))
    if limit := _parse_limit(settings.get("limit")):
        chosen["limit"] = limit
    texts = {name: f"{value:g}" if name in ("tolerance", "learn") else str(value) for name, value in chosen.items()}
    return [argument for name, text in texts.items() for argument in (OPTION_NAMES.get(name, f"--{name}"), text)]


def _refusal(values: dict[str, Any], strict: bool) -> tuple[str, str] | None:
    """The key that the settings' model refuses, and what it expects; None where it takes all ``values``."""
    try:
        SpeedSettings.model_validate(values, strict=strict)
    except ValidationError as error:
        first = error.errors()[0]
        return ".".join(map(str, first["loc"])), first["msg"].replace("Input should be", "expected")
    return None


def _parse_limit(text: object) -> str:
    """A posted limit as it was written; empty where there is none. Raises UnusableInput."""
    limit = str(text or "").strip()
    if limit:
        try:
            parse_speed(limit)
        except ValueError as error:
            raise UnusableInput(f"limit: {error}") from error
    return limit


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
