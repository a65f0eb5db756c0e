"""Proposed lanes as YAML: a site.yaml of their own, or put among the paths of a clip.yaml."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import yaml

from paceline.arrays import Array
from paceline.errors import UnusableInput
from paceline.lanes.lane_proposals import Lane

HALF = 1.96  # standard deviations in half a 95 % interval


def lane_names(count: int, taken: Iterable[str] = ()) -> list[str]:
    """``count`` names of lanes that are not among those ``taken``."""
    names: list[str] = []
    used, number = set(taken), 0
    while len(names) < count:
        number += 1
        if f"lane{number}" not in used:
            names.append(f"lane{number}")
    return names


def site_yaml(rig: str, lanes: dict[str, Lane]) -> str:
    """The site.yaml of ``lanes`` by name; ``rig`` is the rig.yaml as seen from its folder."""
    head = ["# lanes found by paceline lanes: look at the pictures beside this file before you use it"]
    return "\n".join([*head, f"rig: {quoted(rig)}", "paths:", *_entries(lanes, 2)]) + "\n"


def with_lanes(text: str, file: str, lanes: dict[str, Lane]) -> str:
    """``text`` of a clip.yaml with ``lanes`` added to its paths, everything else as it stands, comments too.

    Raises UnusableInput where its paths are written in a way that cannot be added to.
    """
    added = added_below(text, "paths", lambda indent: _entries(lanes, indent))
    before, new = yaml.safe_load(text), yaml.safe_load("\n".join(_entries(lanes, 0))) or {}
    wanted = before | {"paths": (before.get("paths") or {}) | new}
    after = read_back(added)
    if after | {"paths": after.get("paths") or {}} != wanted:
        raise UnusableInput(
            f"{file}: paths: is written in a way that cannot be added to; expected one path per line below a line "
            "'paths:', or use -o site.yaml"
        )
    return added


def added_below(text: str, name: str, entries: Callable[[int], list[str]]) -> str:
    """``text`` of a YAML mapping with ``entries``, made for an indent, added to what stands below the key ``name``, or
    below a new key."""
    root = yaml.compose(text)
    assert isinstance(root, yaml.MappingNode), "a document that was read is a mapping"
    lines = text.splitlines()
    found = {key.value: (key, value) for key, value in root.value}
    if name not in found:
        return "\n".join([*lines, f"{name}:", *entries(2)]) + "\n"
    key, value = found[name]
    if isinstance(value, yaml.MappingNode) and value.value and not value.flow_style:
        indent = value.value[0][0].start_mark.column
        last = value.value[-1][1].end_mark
        end = last.line if last.column == 0 else last.line + 1
        while end > key.start_mark.line + 1 and _is_aside(lines[end - 1], indent):
            end -= 1  # what stands between these entries and the next key belongs to that key
        return "\n".join([*lines[:end], *entries(indent), *lines[end:]]) + "\n"
    row = key.start_mark.line
    _, hash_, comment = lines[row].partition("#")
    head = " " * key.start_mark.column + f"{name}:" + (f"  #{comment}" if hash_ else "")
    return "\n".join([*lines[:row], head, *entries(key.start_mark.column + 2), *lines[row + 1 :]]) + "\n"


def read_back(text: str) -> dict[str, Any]:
    """What ``text`` holds after something was added to it; empty where it is no YAML any more."""
    try:
        found: dict[str, Any] = yaml.safe_load(text)
    except yaml.YAMLError:
        return {}
    return found


def _is_aside(line: str, indent: int) -> bool:
    """Whether a line is empty or a comment that stands further left than the paths."""
    bare = line.lstrip()
    return not bare or (bare.startswith("#") and len(line) - len(bare) < indent)


def _entries(lanes: dict[str, Lane], indent: int) -> list[str]:
    pad, lines = " " * indent, []
    for name, lane in lanes.items():
        width = f"{lane.width:.2f} ± {HALF * lane.width_std:.2f} m wide (95 %)"
        lines += [
            f"{pad}{name}:  # between lines {lane.between[0]} and {lane.between[1]}, {width}",
            f"{pad}  shape: {lane.shape}",
            f"{pad}  left: {pixels(lane.left)}",
            f"{pad}  right: {pixels(lane.right)}",
            f"{pad}  lateral_offset: 0.0  # what is drawn is the middle of the lane, for travel in either direction",
        ]
    return lines


def pixels(points: Array) -> str:
    """``points`` (N, 2) as a line of YAML."""
    return "[" + ", ".join(f"[{x:.2f}, {y:.2f}]" for x, y in points) + "]"


def quoted(text: str) -> str:
    """``text`` as a value of YAML in one line."""
    return yaml.safe_dump(text, allow_unicode=True, width=10**6).splitlines()[0]
