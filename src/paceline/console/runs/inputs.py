"""What a run measures: its documents as they were when it was asked for, copied into a folder of its own.

The copies lie there as the originals do in the console's folder, so that messages and results name them alike.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from paceline.console.document_names import STREAM, ChaseModel, is_chase, read_small
from paceline.documents.models import ClipModel, Document, SiteModel
from paceline.errors import UnusableInput

ASKED = "asked"  # the folder of the copies
RECORDED = ("left", "right", "video", "times", "odometry")  # stay where they are
NAMED = ("rig", "camera", "target", "site")


def copy_documents(root: Path, file: Path, asked: Path, vehicles: bool) -> None:
    """Copies the clip.yaml or follow.yaml ``file`` below ``root``, with its ``vehicles`` or without, and the documents
    that it names into the new folder ``asked``, such that they say there what they say here. Nothing that they name may
    lie outside ``root``. Raises UnusableInput."""
    given = _values(read_small(ChaseModel if is_chase(file) else ClipModel, file))
    if not vehicles:
        given.pop("vehicles", None)
    for key in RECORDED:
        if key in given and not STREAM.fullmatch(given[key]):
            given[key] = str(file.parent / given[key])
    try:
        asked.mkdir()
        _put(root, file, asked, given)
    except OSError as error:
        raise UnusableInput(f"{asked}: cannot be written ({error.strerror})") from error


def _put(root: Path, file: Path, asked: Path, given: dict[str, Any]) -> None:
    """Writes the copy of ``file`` that says what is ``given``, and copies what that names."""
    copy = asked / file.relative_to(root)
    copy.parent.mkdir(parents=True, exist_ok=True)
    for key in NAMED:
        if key not in given:
            continue
        named = (file.parent / given[key]).resolve()
        there = asked / named.relative_to(root)
        given[key] = os.path.relpath(there, copy.parent)
        if not named.is_file():
            continue  # for the command to complain of
        there.parent.mkdir(parents=True, exist_ok=True)
        if key == "site":
            _put(root, named, asked, _values(read_small(SiteModel, named)))
        else:
            shutil.copyfile(named, there)
    copy.write_text(yaml.safe_dump(given, allow_unicode=True, sort_keys=False), encoding="utf-8")


def _values(model: Document) -> dict[str, Any]:
    """What is given in a document, as values that YAML knows."""
    plain: dict[str, Any] = _plain(model.model_dump(exclude_unset=True, exclude_none=True))
    return plain


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return value.tolist() if isinstance(value, np.ndarray) else value
