"""The settings of a run: a field for each, with its default, its range and its unit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from paceline.console.library import ClipContents
from paceline.console.runs.options import (
    convert_tolerance,
    limit_hint,
    limit_problem,
    setting_hint,
    setting_problem,
)
from paceline.speed.configuration import DEFAULTS

TOLERANCE_LABEL = "Largest half-width ±"
MOTION_LABELS = {"auto": "along their paths", "free": "freely", "line": "straight", "curve": "on a curve"}
WHOLE_NUMBERS = ("particles", "seed")


class SettingsForm:
    """The fields of a clip's settings, in the current element. ``change_kind`` is called with whether a recording is
    to be played as a live stream, ``warn`` with the seconds of background after every change of them."""

    def __init__(
        self,
        contents: ClipContents,
        unit: str,
        change_kind: Callable[[bool], None],
        warn: Callable[[float | None], None],
    ) -> None:
        self.fields: dict[str, Any] = {}
        self.change_kind, self.warn = change_kind, warn
        with ui.expansion("Settings").classes("pl-settings").props("dense") as self.expansion:
            if contents.chase:
                self.fields["overlay"] = ui.checkbox(
                    "Write the video, which takes most of the time (default: yes)", value=True
                )
            else:
                self._add_speed_fields(bool(contents.live))
                self._show_unit(unit)

    def _add_speed_fields(self, live: bool) -> None:
        self._add_number("particles", "Particles", "More are slower and give smoother estimates.")
        self._add_number("seed", "Seed", "The same seed gives the same result.")
        motion = ui.select(MOTION_LABELS, value=DEFAULTS.motion, label="Vehicles move").props("dense")
        motion.props["hint"] = f"default: {MOTION_LABELS[DEFAULTS.motion]}"
        self.fields["motion"] = motion
        self._add_number("tolerance", TOLERANCE_LABEL, "Speeds whose 95 % interval is wider than ± this are rejected.")
        limit = ui.input("Speed limit, with its unit", placeholder="30 mph", validation=limit_problem)
        limit.props("dense clearable").tooltip("Whether it is kept is said of every vehicle.")
        self.fields["limit"] = limit
        if not live:
            play = ui.checkbox("Play it as a live stream (default: no)", on_change=self._change_kind)
            play.tooltip("To try live measurement: vehicle after vehicle, as if the cameras recorded now.")
        self._add_number("learn", "Estimate the background for, s", "The road should be empty most of this time.", "s")
        self.fields["learn"].value = DEFAULTS.background.seconds
        self.fields["learn"].on_value_change(lambda event: self.warn(event.value))
        self.fields["learn"].set_visibility(live)

    def _add_number(self, name: str, label: str, effect: str, unit: str = "") -> None:
        precision = 0 if name in WHOLE_NUMBERS else None
        field = ui.number(label, precision=precision, validation=lambda value: setting_problem(name, value))
        field.props("dense clearable").tooltip(effect)
        field.props["hint"] = setting_hint(name, unit)
        self.fields[name] = field

    def _change_kind(self, event: Any) -> None:
        self.change_kind(event.value)
        self.fields["learn"].set_visibility(event.value)
        self.warn(self.fields["learn"].value)

    def _show_unit(self, unit: str) -> None:
        tolerance = self.fields["tolerance"]
        tolerance.props["label"], tolerance.props["hint"] = (
            f"{TOLERANCE_LABEL}, {unit}",
            setting_hint("tolerance", unit),
        )
        self.fields["limit"].props["hint"] = limit_hint(unit)

    def change_unit(self, before: str, unit: str) -> None:
        """Shows what is in the unit ``before`` in another one."""
        if tolerance := self.fields.get("tolerance"):
            if tolerance.value is not None:
                tolerance.value = convert_tolerance(tolerance.value, before, unit)
            self._show_unit(unit)

    def values(self) -> dict[str, Any]:
        """The values of all fields, None where one is empty."""
        values = {name: field.value for name, field in self.fields.items()}
        return values | {name: int(values[name]) for name in WHOLE_NUMBERS if values.get(name) is not None}

    def close(self) -> None:
        self.expansion.close()
