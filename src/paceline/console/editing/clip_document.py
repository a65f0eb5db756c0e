"""Reads the paths and vehicles of a clip.yaml for editing, and writes them back with the rest of the file unchanged."""

from __future__ import annotations

import hashlib
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import ValidationError

from paceline.documents.loading import clip_from_model
from paceline.documents.models import ClipModel, PathModel, SiteModel, VehicleModel, checked_content, read_document
from paceline.documents.yaml_editing import format_flow
from paceline.documents.yaml_loading import load_with_nodes, load_yaml
from paceline.errors import UnusableInput

Entry = dict[str, Any]

COORDINATE_DECIMALS = 2  # decimals of written pixels and metres


class FileChanged(Exception):
    """The file has changed since it was read."""


@dataclass(frozen=True)
class ClipSetup:
    """Drawn ``paths`` by name and ``vehicles`` in order, as plain values in pixels of the images as recorded;
    ``revision`` identifies the content of the file that they were read from."""

    paths: dict[str, Entry]
    vehicles: list[Entry]
    revision: str


def read_clip_setup(file: Path) -> ClipSetup:
    """The paths and vehicles in a clip.yaml. Raises UnusableInput."""
    revision = file_revision(file)
    model = read_document(ClipModel, file)
    paths = {name: _plain(path) for name, path in (model.paths or {}).items()}
    return ClipSetup(paths, [_plain(vehicle) for vehicle in model.vehicles or []], revision)


def read_site_paths(file: Path) -> dict[str, Entry]:
    """The paths of the site.yaml that a clip.yaml names, none if it names no site. Raises UnusableInput."""
    site = read_document(ClipModel, file).site
    return {} if site is None else read_paths_of_site(file.parent / site)


def read_paths_of_site(file: Path) -> dict[str, Entry]:
    """The paths of a site.yaml. Raises UnusableInput."""
    return {name: _plain(path) for name, path in (read_document(SiteModel, file).paths or {}).items()}


def validated_setup(paths: Mapping[str, Entry], vehicles: list[Entry]) -> tuple[dict[str, Entry], list[Entry]]:
    """``paths`` and ``vehicles``, rounded as they are written. Raises UnusableInput where they are invalid."""
    try:
        model = ClipModel.model_validate({"left": "-", "right": "-", "paths": dict(paths), "vehicles": vehicles})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"] if part != "[key]")
        raise UnusableInput(f"{key}: {first['msg'].removeprefix('Value error, ')}") from error
    known = {name: _rounded_entry(_plain(path)) for name, path in (model.paths or {}).items()}
    return known, [_rounded_entry(_plain(vehicle)) for vehicle in model.vehicles or []]


def save_clip_setup(file: Path, setup: ClipSetup) -> ClipSetup:
    """Writes ``setup`` into the clip.yaml ``file`` atomically. Raises FileChanged where the file has another revision,
    UnusableInput where the clip could not be measured with it."""
    content = _read(file)
    if _revision(content) != setup.revision:
        raise FileChanged
    paths, vehicles = validated_setup(setup.paths, setup.vehicles)
    text, model = _edited(content.decode("utf-8"), file, paths, vehicles)
    clip_from_model(file, model)
    content = text.encode("utf-8")
    partial = file.with_name(f".{file.name}.{secrets.token_hex(4)}.partial")
    try:
        partial.write_bytes(content)
        shutil.copymode(file, partial)
        partial.replace(file)
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be written ({error.strerror})") from error
    finally:
        partial.unlink(missing_ok=True)
    return ClipSetup(paths, vehicles, _revision(content))


def with_clip_setup(text: str, file: Path, paths: Mapping[str, Entry], vehicles: list[Entry]) -> str:
    """``text`` of a clip.yaml with these ``paths`` and ``vehicles``; unchanged entries keep their lines and
    comments, and the rest of the file stays as it is. Raises UnusableInput where the file's style does not allow it."""
    return _edited(text, file, paths, vehicles)[0]


def _edited(text: str, file: Path, paths: Mapping[str, Entry], vehicles: list[Entry]) -> tuple[str, ClipModel]:
    """As `with_clip_setup`, with the model of the new text; either text is parsed once."""
    try:
        before, root = load_with_nodes(text)
        old_paths, old_vehicles = _plain_setup(ClipModel.model_validate(before))
        lines = text.splitlines()
        edits = [
            _section_edit(lines, root, "paths", list(old_paths.items()), list(paths.items())),
            _section_edit(lines, root, "vehicles", _by_id(old_vehicles), _by_id(vehicles)),
        ]
        for begin, end, section in sorted(reversed(edits), key=lambda edit: edit[0], reverse=True):
            lines[begin:end] = section
        new = "\n".join(lines) + "\n"
        after = load_yaml(new)
        model = checked_content(ClipModel, after, file)
        unset = {"paths": None, "vehicles": None}
        unchanged = before | unset == after | unset and _plain_setup(model) == (dict(paths), vehicles)
    except (yaml.YAMLError, ValidationError, UnusableInput, TypeError):
        unchanged = False
    if not unchanged:
        raise UnusableInput(
            f"{file}: paths and vehicles: are written in a way that cannot be edited; expected one key per line"
        )
    return new, model


def _plain_setup(model: ClipModel) -> tuple[dict[str, Entry], list[Entry]]:
    paths = {name: _plain(path) for name, path in (model.paths or {}).items()}
    return paths, [_plain(vehicle) for vehicle in model.vehicles or []]


def file_revision(file: Path) -> str:
    """A digest of the ``file``. Raises UnusableInput."""
    return _revision(_read(file))


def _revision(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be read ({error.strerror})") from error


def _by_id(vehicles: list[Entry]) -> list[tuple[str, Entry]]:
    return [(vehicle["id"], vehicle) for vehicle in vehicles]


def _plain(model: PathModel | VehicleModel) -> Entry:
    """The keys that are given, in the order of the file format, as plain JSON and YAML values."""
    values = {key: getattr(model, key) for key in type(model).model_fields if key in model.model_fields_set}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items() if v is not None}


def _rounded_entry(entry: Entry) -> Entry:
    return {
        key: np.round(value, COORDINATE_DECIMALS).tolist() if key in ("left", "right") else value
        for key, value in entry.items()
    }


# --- text ----------------------------------------------------------------------------------------------------------


def _section_edit(
    lines: list[str],
    root: yaml.Node | None,
    section: str,
    old_entries: list[tuple[str, Entry]],
    entries: list[tuple[str, Entry]],
) -> tuple[int, int, list[str]]:
    """The lines from one to before another, and those in their place, by which the top-level key ``section`` of the
    document ``root`` has the ``entries`` (name, values) for ``old_entries``: paths by name, vehicles in order."""
    entries_by_key = (
        {key.value: (key, value) for key, value in root.value} if isinstance(root, yaml.MappingNode) else {}
    )
    if section not in entries_by_key:
        body = [line for name, entry in entries for line in _entry_lines(section, name, entry, 2)]
        return len(lines), len(lines), [f"{section}:", *body] if body else []
    key, value = entries_by_key[section]
    begin = key.start_mark.line
    in_lines = isinstance(value, yaml.CollectionNode) and bool(value.value) and not value.flow_style
    if in_lines and value.start_mark.line > begin:
        starts = [(e[0] if isinstance(e, tuple) else e).start_mark.line for e in value.value]
        indent = len(lines[starts[0]]) - len(lines[starts[0]].lstrip())
        end = _section_end(lines, value, starts[-1], indent)
        starts = [_with_comments(lines, start, begin, indent) for start in starts]
        old = {_entry_key(v): lines[a:b] for v, a, b in zip(old_entries, starts, [*starts[1:], end], strict=True)}
        head = lines[begin : starts[0]]
    else:  # nothing, or all in one line
        old, indent = {}, key.start_mark.column + 2
        end = max(value.end_mark.line + (value.end_mark.column > 0), begin + 1)
        head = [f"{section}:"]
    body = [
        line for name, e in entries for line in old.get(_entry_key((name, e))) or _entry_lines(section, name, e, indent)
    ]
    return begin, end, [*head, *body] if body else []


def _entry_key(entry: tuple[str, Entry]) -> str:
    return repr(entry)


def _section_end(lines: list[str], value: yaml.Node, last: int, indent: int) -> int:
    """The line after a section; empty lines and less indented comments belong to the next one."""
    mark = value.end_mark
    end = mark.line if mark.column == 0 else mark.line + 1
    while end > last + 1:
        bare = lines[end - 1].lstrip()
        if bare and not (bare.startswith("#") and len(lines[end - 1]) - len(bare) < max(indent, 1)):
            break
        end -= 1
    return end


def _with_comments(lines: list[str], start: int, begin: int, indent: int) -> int:
    """The first of the comment lines right above an entry that are indented like it."""
    while start - 1 > begin and lines[start - 1].startswith(" " * indent + "#"):
        start -= 1
    return start


def _entry_lines(section: str, name: str, entry: Entry, indent: int) -> list[str]:
    pad = " " * indent
    if section == "paths":
        return [f"{pad}{format_flow(name)}:", *(f"{pad}  {key}: {format_flow(value)}" for key, value in entry.items())]
    marks = ["- ", *["  "] * (len(entry) - 1)]
    return [f"{pad}{mark}{key}: {format_flow(value)}" for mark, (key, value) in zip(marks, entry.items(), strict=True)]
