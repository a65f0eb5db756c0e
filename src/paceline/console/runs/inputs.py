"""The inputs of a run: copies of its documents at the time it was requested, in a folder of its own.

The copies have the same paths below that folder as the originals below the console's folder, so that messages and
results name them alike.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from paceline.console.document_references import STREAM_PATTERN, PartialFollowModel, is_follow, read_cached
from paceline.documents.models import ClipModel, Document, SiteModel
from paceline.errors import UnusableInput

INPUTS_FOLDER = "asked"
RECORDING_KEYS = ("left", "right", "video", "times", "odometry")  # paths to files that are not copied
DOCUMENT_KEYS = ("rig", "camera", "target", "site")


def copy_documents(root: Path, file: Path, inputs: Path, vehicles: bool) -> None:
    """Copies the clip.yaml or follow.yaml ``file`` below ``root``, with or without its ``vehicles``, and the documents
    that it names into the new folder ``inputs``; relative paths are adapted. Files that they name must lie below
    ``root``. Raises UnusableInput."""
    values = _given_values(read_cached(PartialFollowModel if is_follow(file) else ClipModel, file))
    if not vehicles:
        values.pop("vehicles", None)
    for key in RECORDING_KEYS:
        if key in values and not STREAM_PATTERN.fullmatch(values[key]):
            values[key] = str(file.parent / values[key])
    try:
        inputs.mkdir(parents=True)
        _write_copy(root, file, inputs, values)
    except OSError as error:
        raise UnusableInput(f"{inputs}: cannot be written ({error.strerror})") from error


def _write_copy(root: Path, file: Path, inputs: Path, values: dict[str, Any]) -> None:
    """Writes the copy of ``file`` with the values ``values``, and copies the documents that these name."""
    copy = inputs / file.relative_to(root)
    copy.parent.mkdir(parents=True, exist_ok=True)
    for key in DOCUMENT_KEYS:
        if key not in values:
            continue
        named = (file.parent / values[key]).resolve()
        target = inputs / named.relative_to(root)
        values[key] = os.path.relpath(target, copy.parent)
        if not named.is_file():
            continue  # the command reports it
        target.parent.mkdir(parents=True, exist_ok=True)
        if key == "site":
            _write_copy(root, named, inputs, _given_values(read_cached(SiteModel, named)))
        else:
            shutil.copyfile(named, target)
    copy.write_text(yaml.safe_dump(values, allow_unicode=True, sort_keys=False), encoding="utf-8")


def _given_values(model: Document) -> dict[str, Any]:
    """The given values of a document, as plain YAML values."""
    values: dict[str, Any] = _plain(model.model_dump(exclude_unset=True, exclude_none=True))
    return values


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return value.tolist() if isinstance(value, np.ndarray) else value
