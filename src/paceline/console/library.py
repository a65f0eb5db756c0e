"""The clips below the console's folder, and how far each is."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from paceline.console.frames import Gallery, Stamps, is_unchanged, stamps_of
from paceline.console.runs import CANCELLED, RUNNING, Run, Runs
from paceline.console.safety import check_clip, file_below, folder_below, named_files
from paceline.documents import load_clip
from paceline.errors import UnusableInput
from paceline.schemas import ClipModel, read_document

DEEPEST = 4  # folders below the console's own in which clips are looked for
MOST = 1000  # clips


@dataclass(frozen=True)
class Entry:
    """One clip: its ``name`` is its folder's, ``state`` a word or two, ``reason`` a plain line where one helps."""

    name: str
    state: str
    reason: str
    vehicles: int
    paths: int
    runs: list[Run]


@dataclass(frozen=True)
class Contents:
    """What a clip.yaml holds, and why it cannot be measured if it cannot; ``state`` is empty while it can."""

    vehicles: int = 0
    paths: int = 0
    state: str = ""
    reason: str = ""


class Library:
    """The clips below ``root``, a resolved folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.gallery = Gallery(root)
        self.runs = Runs(root, self.folder)
        self._known: dict[Path, tuple[Stamps, Contents]] = {}

    def folder(self, name: str) -> Path:
        """The folder of the clip ``name``. Raises NotHere."""
        folder = folder_below(self.root, name)
        file_below(folder, "clip.yaml")
        return folder

    def file(self, name: str) -> Path:
        """The clip.yaml of the clip ``name``. Raises NotHere."""
        return self.folder(name) / "clip.yaml"

    def names(self) -> list[str]:
        """The clips by name; links, hidden folders and what lies inside a clip are passed over."""
        found = []
        for name in _search(self.root, Path("."), DEEPEST):
            found.append(name)
            if len(found) == MOST:
                break
        return sorted(found, key=str.lower)

    def entry(self, name: str) -> Entry:
        """How far the clip ``name`` is. Raises NotHere."""
        contents = self._contents(self.file(name))
        runs = [run for run in self.runs.of(name) if run.kind == "speed" or run.active]
        state, reason = contents.state, contents.reason
        if not state:
            state, reason = _state(contents, runs)
        return Entry(name, state, reason, contents.vehicles, contents.paths, runs)

    def _contents(self, file: Path) -> Contents:
        """As `_examine`, again only when a file has changed: every open list asks every other second."""
        known = self._known.get(file)
        if known is None or not is_unchanged(known[0]):
            stamps = stamps_of(named_files(self.root, file))
            known = self._known[file] = stamps, self._examine(file)
        return known[1]

    def _examine(self, file: Path) -> Contents:
        try:
            check_clip(self.root, file)
            model = read_document(ClipModel, file)
            vehicles, paths = len(model.vehicles or []), len(model.paths or {})
            if model.rig is None and model.site is None:
                return Contents(vehicles, paths, "no rig", "add the rig file of its cameras")
            clip = load_clip(file)
            self.gallery.open(file)
        except UnusableInput as error:
            return Contents(0, 0, "unreadable", self.shown(error))
        return Contents(len(clip.vehicles), len(clip.paths))

    def shown(self, error: UnusableInput) -> str:
        """The error's line with names of files as seen from the console's folder."""
        return str(error).replace(f"{self.root}/", "").replace(str(self.root), ".")


def _state(contents: Contents, runs: list[Run]) -> tuple[str, str]:
    if any(run.active for run in runs):
        return RUNNING, ""
    done = [run for run in runs if run.state != CANCELLED]
    if done:
        return done[0].state, done[0].reason
    if not contents.vehicles and not contents.paths:
        return "no paths", "draw the road line that vehicles follow, or measure: lanes are then looked for"
    if not contents.vehicles:
        return "no vehicles", "outline the vehicles, or measure: they are then looked for"
    return "ready", "look the set-up over, then measure"


def _search(root: Path, below: Path, deep: int) -> Iterator[str]:
    try:
        if (root / below / "clip.yaml").is_file():
            yield below.as_posix()
            return
        if not deep:
            return
        with os.scandir(root / below) as entries:
            folders = [e.name for e in entries if not e.name.startswith(".") and e.is_dir(follow_symlinks=False)]
    except OSError:  # not ours to read
        return
    for name in sorted(folders):
        yield from _search(root, below / name, deep - 1)
