"""Documents and folders of recordings that a test spoils."""

from __future__ import annotations

import copy
import shutil
from pathlib import Path
from typing import Any, Self

import yaml


def changed(document: Any, key: str, value: Any) -> Any:
    """A copy of ``document`` with ``value`` at ``key`` (``vehicles.0.left``), or without that key for None."""
    document = copy.deepcopy(document)
    *parents, last = [int(k) if k.isdecimal() else k for k in key.split(".")]
    place = document
    for parent in parents:
        place = place[parent]
    if value is None:
        del place[last]
    else:
        place[last] = value
    return document


class Folder:
    """A copy of a recording's folder that a case spoils."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def copied(cls, original: Path, to: Path) -> Self:
        return cls(Path(shutil.copytree(original, to)))

    def set(self, file: str, key: str, value: Any) -> None:
        """``value`` at ``key`` of a YAML file (``vehicles.0.left``); None takes the key away."""
        document = changed(yaml.safe_load((self.folder / file).read_text()), key, value)
        (self.folder / file).write_text(yaml.safe_dump(document))
