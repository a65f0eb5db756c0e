"""Proposed lanes as YAML: a new site.yaml, or entries among the paths of a clip.yaml."""

from __future__ import annotations

from collections.abc import Iterable

from paceline.documents.yaml_editing import format_pixels, format_text, insert_below, parse_edited
from paceline.documents.yaml_loading import load_yaml
from paceline.errors import UnusableInput
from paceline.lanes.lane_proposals import Lane
from paceline.number_format import format_uncertain
from paceline.units import COVERAGE_95


def lane_names(count: int, used_names: Iterable[str] = ()) -> list[str]:
    """``count`` names of lanes that are not among those ``used_names``."""
    names: list[str] = []
    used, number = set(used_names), 0
    while len(names) < count:
        number += 1
        if f"lane{number}" not in used:
            names.append(f"lane{number}")
    return names


def site_yaml(rig: str, lanes: dict[str, Lane]) -> str:
    """The site.yaml of ``lanes`` by name; ``rig`` is the rig.yaml as seen from its folder."""
    head = ["# lanes found by paceline lanes: look at the pictures beside this file before you use it"]
    return "\n".join([*head, f"rig: {format_text(rig)}", "paths:", *_entries(lanes, 2)]) + "\n"


def with_lanes(text: str, file: str, lanes: dict[str, Lane]) -> str:
    """``text`` of a clip.yaml with ``lanes`` added to its paths, everything else as it stands, comments too.

    Raises UnusableInput where its paths are written in a way that cannot be added to.
    """
    added = insert_below(text, "paths", lambda indent: _entries(lanes, indent))
    before, new = load_yaml(text), load_yaml("\n".join(_entries(lanes, 0))) or {}
    expected = before | {"paths": (before.get("paths") or {}) | new}
    after = parse_edited(added)
    if after | {"paths": after.get("paths") or {}} != expected:
        raise UnusableInput(
            f"{file}: paths: is written in a way that cannot be added to; expected one path per line below a line "
            "'paths:', or use -o site.yaml"
        )
    return added


def _entries(lanes: dict[str, Lane], indent: int) -> list[str]:
    pad, lines = " " * indent, []
    for name, lane in lanes.items():
        width = f"{format_uncertain(lane.width, COVERAGE_95 * lane.width_std)} m wide (95 %)"
        lines += [
            f"{pad}{name}:  # between lines {lane.between[0]} and {lane.between[1]}, {width}",
            f"{pad}  shape: {lane.shape}",
            f"{pad}  left: {format_pixels(lane.left)}",
            f"{pad}  right: {format_pixels(lane.right)}",
            f"{pad}  lateral_offset: 0.0  # what is drawn is the middle of the lane, for travel in either direction",
        ]
    return lines
