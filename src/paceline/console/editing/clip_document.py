"""The paths and vehicles of a clip.yaml, read for editing and written back with all else as a person wrote it."""

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

from paceline.documents.loading import load_clip
from paceline.documents.models import ClipModel, PathModel, SiteModel, VehicleModel, read_document
from paceline.documents.yaml_editing import format_flow
from paceline.errors import UnusableInput

Entry = dict[str, Any]

DECIMALS = 2  # of a pixel or a metre as written


class Changed(Exception):
    """The file is not the one that was read: someone else wrote it in the meantime."""


@dataclass(frozen=True)
class Setup:
    """What a person draws: ``paths`` by name and ``vehicles`` in order, as plain values in pixels of the recorded
    images; ``revision`` is the file that they were read from."""

    paths: dict[str, Entry]
    vehicles: list[Entry]
    revision: str


def read_setup(file: Path) -> Setup:
    """The set-up in a clip.yaml. Raises UnusableInput."""
    revision = revision_of(file)
    model = read_document(ClipModel, file)
    paths = {name: _plain(path) for name, path in (model.paths or {}).items()}
    return Setup(paths, [_plain(vehicle) for vehicle in model.vehicles or []], revision)


def read_site_paths(file: Path) -> dict[str, Entry]:
    """The paths that a clip.yaml has from its site, none without one. Raises UnusableInput."""
    site = read_document(ClipModel, file).site
    return {} if site is None else read_lanes(file.parent / site)


def read_lanes(file: Path) -> dict[str, Entry]:
    """The paths of a site.yaml. Raises UnusableInput."""
    return {name: _plain(path) for name, path in (read_document(SiteModel, file).paths or {}).items()}


def checked(paths: Mapping[str, Entry], vehicles: list[Entry]) -> tuple[dict[str, Entry], list[Entry]]:
    """The same with numbers rounded as they are written. Raises UnusableInput for what a clip.yaml may not hold."""
    try:
        model = ClipModel.model_validate({"left": "-", "right": "-", "paths": dict(paths), "vehicles": vehicles})
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"] if part != "[key]")
        raise UnusableInput(f"{where}: {first['msg'].removeprefix('Value error, ')}") from error
    known = {name: _rounded(_plain(path)) for name, path in (model.paths or {}).items()}
    return known, [_rounded(_plain(vehicle)) for vehicle in model.vehicles or []]


def save_setup(file: Path, setup: Setup) -> Setup:
    """Puts ``setup`` into the clip.yaml ``file`` in one step. Raises Changed where it is not of the setup's revision,
    UnusableInput where it could not be measured from then on."""
    if revision_of(file) != setup.revision:
        raise Changed
    paths, vehicles = checked(setup.paths, setup.vehicles)
    text = with_setup(file.read_text(encoding="utf-8"), str(file), paths, vehicles)
    partial = file.with_name(f".{file.name}.{secrets.token_hex(4)}.partial")
    try:
        partial.write_text(text, encoding="utf-8")
        shutil.copymode(file, partial)
        try:
            load_clip(partial)
        except UnusableInput as error:
            raise UnusableInput(str(error).replace(str(partial), str(file))) from error
        partial.replace(file)
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be written ({error.strerror})") from error
    finally:
        partial.unlink(missing_ok=True)
    return read_setup(file)


def with_setup(text: str, file: str, paths: Mapping[str, Entry], vehicles: list[Entry]) -> str:
    """``text`` of a clip.yaml with these ``paths`` and ``vehicles``; entries that stay the same keep their lines and
    comments, and everything else stands as it was. Raises UnusableInput where the file is written too unusually."""
    try:
        new = _with_section(text, "paths", list(paths.items()))
        new = _with_section(new, "vehicles", [(vehicle["id"], vehicle) for vehicle in vehicles])
        before, after = ({**yaml.safe_load(t), "paths": None, "vehicles": None} for t in (text, new))
        kept = before == after and _contents(ClipModel.model_validate(yaml.safe_load(new))) == (dict(paths), vehicles)
    except (yaml.YAMLError, ValidationError):
        kept = False
    if not kept:
        raise UnusableInput(
            f"{file}: paths and vehicles: are written in a way that cannot be added to; expected one key per line"
        )
    return new


def _contents(model: ClipModel) -> tuple[dict[str, Entry], list[Entry]]:
    paths = {name: _plain(path) for name, path in (model.paths or {}).items()}
    return paths, [_plain(vehicle) for vehicle in model.vehicles or []]


def revision_of(file: Path) -> str:
    """What changes when the ``file`` does. Raises UnusableInput."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be read ({error.strerror})") from error


def _plain(model: PathModel | VehicleModel) -> Entry:
    """What is given, in the order of the file format, as values that JSON and YAML know."""
    given = {key: getattr(model, key) for key in type(model).model_fields if key in model.model_fields_set}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in given.items() if v is not None}


def _rounded(entry: Entry) -> Entry:
    return {
        key: np.round(value, DECIMALS).tolist() if key in ("left", "right") else value for key, value in entry.items()
    }


# --- text ----------------------------------------------------------------------------------------------------------


def _with_section(text: str, section: str, entries: list[tuple[str, Entry]]) -> str:
    """``text`` with the ``entries`` (name, values) of its top-level key ``section``: paths by name, vehicles in
    order."""
    root = yaml.compose(text)
    lines = text.splitlines()
    found = {key.value: (key, value) for key, value in root.value} if isinstance(root, yaml.MappingNode) else {}
    if section not in found:
        body = [line for name, entry in entries for line in _lines(section, name, entry, 2)]
        return "\n".join([*lines, *([f"{section}:", *body] if body else [])]) + "\n"
    key, value = found[section]
    begin = key.start_mark.line
    in_lines = isinstance(value, yaml.CollectionNode) and bool(value.value) and not value.flow_style
    if in_lines and value.start_mark.line > begin:
        starts = [(e[0] if isinstance(e, tuple) else e).start_mark.line for e in value.value]
        indent = len(lines[starts[0]]) - len(lines[starts[0]].lstrip())
        end = _end(lines, value, starts[-1], indent)
        starts = [_with_comments(lines, start, begin, indent) for start in starts]
        old = {_key(v): lines[a:b] for v, a, b in zip(_old(section, text), starts, [*starts[1:], end], strict=True)}
        head = lines[begin : starts[0]]
    else:  # nothing, or all in one line
        old, indent = {}, key.start_mark.column + 2
        end = max(value.end_mark.line + (value.end_mark.column > 0), begin + 1)
        head = [f"{section}:"]
    body = [line for name, e in entries for line in old.get(_key((name, e)), _lines(section, name, e, indent))]
    return "\n".join([*lines[:begin], *([*head, *body] if body else []), *lines[end:]]) + "\n"


def _old(section: str, text: str) -> list[tuple[str, Entry]]:
    paths, vehicles = _contents(ClipModel.model_validate(yaml.safe_load(text)))
    return list(paths.items()) if section == "paths" else [(vehicle["id"], vehicle) for vehicle in vehicles]


def _key(entry: tuple[str, Entry]) -> str:
    return repr(entry)


def _end(lines: list[str], value: yaml.Node, last: int, indent: int) -> int:
    """The line after a section; empty lines and comments further left belong to what follows."""
    mark = value.end_mark
    end = mark.line if mark.column == 0 else mark.line + 1
    while end > last + 1:
        bare = lines[end - 1].lstrip()
        if bare and not (bare.startswith("#") and len(lines[end - 1]) - len(bare) < max(indent, 1)):
            break
        end -= 1
    return end


def _with_comments(lines: list[str], start: int, begin: int, indent: int) -> int:
    """The first of the comment lines right above an entry, indented as it is."""
    while start - 1 > begin and lines[start - 1].startswith(" " * indent + "#"):
        start -= 1
    return start


def _lines(section: str, name: str, entry: Entry, indent: int) -> list[str]:
    pad = " " * indent
    if section == "paths":
        return [f"{pad}{format_flow(name)}:", *(f"{pad}  {key}: {format_flow(value)}" for key, value in entry.items())]
    marks = ["- ", *["  "] * (len(entry) - 1)]
    return [f"{pad}{mark}{key}: {format_flow(value)}" for mark, (key, value) in zip(marks, entry.items(), strict=True)]
