"""Formats results as data: cells of a table, and JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np


def format_cell(value: float) -> str:
    """The shortest text that reads back as the same number; empty where it is not finite."""
    return repr(float(value)) if math.isfinite(value) else ""


def write_json(document: dict[str, object], file: Path) -> None:
    """Writes ``document`` as `json_text`."""
    file.write_text(json_text(document), encoding="utf-8")


def json_text(document: dict[str, object]) -> str:
    """``document`` as indented JSON; numbers that are not finite become null."""
    return json.dumps(to_json_value(document), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def to_json_value(value: object) -> object:
    """``value`` converted to JSON types; numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return to_json_value(value.tolist())
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    if isinstance(value, np.generic):
        return to_json_value(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, str | int):
        return value
    return str(value)
