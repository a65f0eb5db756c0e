"""Edits YAML files written by people: inserts values and entries, and preserves all else, comments included."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import yaml

from paceline.arrays import Array
from paceline.documents.yaml_loading import load_yaml
from paceline.errors import UnusableInput

Plain = dict[str, Any]


def insert_below(text: str, name: str, entries: Callable[[int], list[str]]) -> str:
    """``text`` of a YAML mapping with ``entries``, made for an indent, added to what stands below the key ``name``, or
    below a new key."""
    root = yaml.compose(text)
    assert isinstance(root, yaml.MappingNode), "a document that was read is a mapping"
    lines = text.splitlines()
    entries_by_key = {key.value: (key, value) for key, value in root.value}
    if name not in entries_by_key:
        return "\n".join([*lines, f"{name}:", *entries(2)]) + "\n"
    key, value = entries_by_key[name]
    if isinstance(value, yaml.MappingNode) and value.value and not value.flow_style:
        indent = value.value[0][0].start_mark.column
        last = value.value[-1][1].end_mark
        end = last.line if last.column == 0 else last.line + 1
        while end > key.start_mark.line + 1 and _is_outer_comment(lines[end - 1], indent):
            end -= 1  # lines between these entries and the next key belong to that key
        return "\n".join([*lines[:end], *entries(indent), *lines[end:]]) + "\n"
    row = key.start_mark.line
    _, hash_, comment = lines[row].partition("#")
    head = " " * key.start_mark.column + f"{name}:" + (f"  #{comment}" if hash_ else "")
    return "\n".join([*lines[:row], head, *entries(key.start_mark.column + 2), *lines[row + 1 :]]) + "\n"


def parse_edited(text: str) -> dict[str, Any]:
    """What ``text`` holds after something was added to it; empty where it is no YAML any more."""
    try:
        document: dict[str, Any] = load_yaml(text)
    except yaml.YAMLError:
        return {}
    return document


def _is_outer_comment(line: str, indent: int) -> bool:
    """Whether a line is empty or a comment that stands further left than the paths."""
    bare = line.lstrip()
    return not bare or (bare.startswith("#") and len(line) - len(bare) < indent)


def format_pixels(points: Array) -> str:
    """``points`` (N, 2) as a line of YAML."""
    return "[" + ", ".join(f"[{x:.2f}, {y:.2f}]" for x, y in points) + "]"


def format_text(text: str) -> str:
    """``text`` as a value of YAML in one line."""
    return yaml.safe_dump(text, allow_unicode=True, width=10**6).splitlines()[0]


def format_flow(value: object) -> str:
    """``value`` in one line of YAML."""
    text = yaml.dump(value, Dumper=_Flow, default_flow_style=True, allow_unicode=True, sort_keys=False, width=2**30)
    return str(text).removesuffix("...\n").strip()


class _Flow(yaml.CSafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True  # a list that occurs twice is written twice


def set_values(text: str, file: str, values: Plain) -> str:
    """``text`` of a YAML mapping with these top-level ``values``, all else as it was. Raises UnusableInput."""
    new = text
    for key, value in values.items():
        new = _set_value(new, key, value)
    try:
        before, after = load_yaml(text), load_yaml(new)
        unchanged = {**before, **values} == after
    except (yaml.YAMLError, TypeError):
        unchanged = False
    if not unchanged:
        raise UnusableInput(f"{file}: is written in a way that cannot be added to; expected one key per line")
    return new


def _set_value(text: str, key: str, value: object) -> str:
    root = yaml.compose(text)
    entries_by_key = {k.value: (k, v) for k, v in root.value} if isinstance(root, yaml.MappingNode) else {}
    line = f"{key}: {format_flow(value)}"
    if key not in entries_by_key:
        return f"{text.rstrip()}\n{line}\n"
    name, old = entries_by_key[key]
    end = old.end_mark.index
    if isinstance(old, yaml.CollectionNode) and not old.flow_style:  # it ends where the next key begins
        end = old.start_mark.index + len(_own_lines(text[old.start_mark.index : end]))
    return text[: name.start_mark.index] + line + text[end:]


def _own_lines(block: str) -> str:
    """A block's text without the empty lines and comments after it, which belong to what follows."""
    lines = block.splitlines()
    while lines and (not lines[-1].strip() or lines[-1].startswith("#")):
        lines.pop()
    return "\n".join(lines)
