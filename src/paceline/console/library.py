"""The clips below the console's folder, and how far each is."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from paceline.console.confinement import NotHere, check_document, file_below, folder_below, named_files
from paceline.console.document_names import CLIP, FOLLOW, ChaseModel, is_chase, live_views, read_small
from paceline.console.frames.frame_cache import Gallery, Stamps, is_unchanged, stamps_of
from paceline.console.runs.kinds import MEASURING
from paceline.console.runs.run_list import CANCELLED, RUNNING, Run, Runs
from paceline.documents.loading import load_clip, load_follow
from paceline.documents.models import ClipModel
from paceline.errors import UnusableInput

DEEPEST = 4  # folders below the console's own in which clips are looked for
MOST = 1000  # clips
READERS = 2  # documents that are read at once
BEING_READ = "being read"


@dataclass(frozen=True)
class Contents:
    """What a clip.yaml or follow.yaml holds, and why it cannot be measured if it cannot; ``state`` is empty while it
    can. ``live`` are its live sources, ``target`` is the vehicle ahead, ``pictures`` whether there are any to see, and
    ``seconds`` how long the recording lasts where that is known."""

    vehicles: int = 0
    paths: int = 0
    state: str = ""
    reason: str = ""
    chase: bool = False
    target: str = ""
    live: tuple[str, ...] = ()
    pictures: bool = True
    seconds: float | None = None


@dataclass(frozen=True)
class Entry:
    """One clip: its ``name`` is its folder's, ``state`` a word or two, ``reason`` a plain line where one helps."""

    name: str
    state: str
    reason: str
    contents: Contents
    runs: list[Run]


class Library:
    """The clips below ``root``, a resolved folder; where it is ``read_only`` they are looked at and nothing else."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.read_only = not os.access(root, os.W_OK | os.X_OK)
        self.gallery = Gallery(root)
        self.runs = Runs(root, self.folder)
        self._known: dict[Path, tuple[Stamps, Contents]] = {}
        self._readers = ThreadPoolExecutor(READERS, "reading")
        self._reading: dict[Path, Future[tuple[Stamps, Contents]]] = {}
        self._lock = threading.Lock()

    def refuse_read_only(self) -> None:
        """Raises UnusableInput where the console's folder cannot be written."""
        if self.read_only:
            raise UnusableInput("this folder cannot be written: its clips can be looked at and read, nothing else")

    def folder(self, name: str) -> Path:
        """The folder of the clip ``name``. Raises NotHere."""
        return self.file(name).parent

    def file(self, name: str) -> Path:
        """The clip.yaml or follow.yaml of the clip ``name``. Raises NotHere."""
        folder = folder_below(self.root, name)
        for document in (CLIP, FOLLOW):
            with suppress(NotHere):
                return file_below(folder, document)
        raise NotHere(name)

    def names(self) -> list[str]:
        """The clips by name; links, hidden folders and what lies inside a clip are passed over."""
        found = []
        for name in _search(self.root, Path("."), DEEPEST):
            found.append(name)
            if len(found) == MOST:
                break
        return sorted(found, key=str.lower)

    def entry(self, name: str, patience: float | None = None) -> Entry:
        """How far the clip ``name`` is; of one that takes longer than ``patience``, s, to be read, that it is being
        read. Raises NotHere."""
        contents = self._contents(self.file(name), patience)
        runs = [run for run in self.runs.of(name) if run.kind in MEASURING or run.active]
        state, reason = contents.state, contents.reason
        if not state:
            state, reason = _state(contents, runs)
        return Entry(name, state, reason, contents, runs)

    def _contents(self, file: Path, patience: float | None) -> Contents:
        """As `_examine`, again only when a file has changed: every open list asks every other second."""
        known = self._known.get(file)
        if known is not None and is_unchanged(known[0]):
            return known[1]
        with self._lock:
            reading = self._reading.get(file)
            if reading is None:
                reading = self._reading[file] = self._readers.submit(self._read, file)
        try:
            known = self._known[file] = reading.result(patience)
        except TimeoutError:
            reason = "its files are large, or far away"
            return Contents(state=BEING_READ, reason=reason, chase=is_chase(file), pictures=False)
        finally:
            if reading.done():
                self._reading.pop(file, None)
        return known[1]

    def _read(self, file: Path) -> tuple[Stamps, Contents]:
        return stamps_of(named_files(self.root, file)), self._examine(file)

    def _examine(self, file: Path) -> Contents:
        chase = is_chase(file)
        try:
            check_document(self.root, file)
            live = tuple(live_views(file))
            return self._examine_chase(file, live) if chase else self._examine_clip(file, live)
        except UnusableInput as error:
            return Contents(state="unreadable", reason=self.shown(error), chase=chase, pictures=False)

    def _examine_clip(self, file: Path, live: tuple[str, ...]) -> Contents:
        model = read_small(ClipModel, file)
        vehicles, paths = len(model.vehicles or []), len(model.paths or {})
        if model.rig is None and model.site is None:
            return Contents(vehicles, paths, "no rig", "add the rig file of its cameras", live=live, pictures=False)
        clip = load_clip(file)
        seconds = None if live else self.gallery.open(file).seconds
        return Contents(len(clip.vehicles), len(clip.paths), live=live, pictures=not live, seconds=seconds)

    def _examine_chase(self, file: Path, live: tuple[str, ...]) -> Contents:
        model = read_small(ChaseModel, file)
        if not live:
            self.gallery.open(file)
        reason = "outline the vehicle ahead, or place its model"
        if model.target is not None and model.start is not None:
            try:
                return Contents(chase=True, target=load_follow(file).target.name, live=live, pictures=not live)
            except UnusableInput as error:
                reason = self.shown(error)
        return Contents(state="no target", reason=reason, chase=True, live=live, pictures=not live)

    def shown(self, error: UnusableInput) -> str:
        """The error's line with names of files as seen from the console's folder."""
        return str(error).replace(f"{self.root}/", "").replace(str(self.root), ".")


def _state(contents: Contents, runs: list[Run]) -> tuple[str, str]:
    if any(run.active for run in runs):
        return RUNNING, ""
    done = [run for run in runs if run.state != CANCELLED]
    if done:
        return done[0].state, done[0].reason
    if contents.live:
        return "live", f"{' and '.join(contents.live)}: measured while recording"
    if contents.chase:
        return "ready", f"see that the lines lie on the {contents.target}, then follow it"
    if not contents.vehicles and not contents.paths:
        return "no paths", "draw the road line that vehicles follow, or measure: lanes are then looked for"
    if not contents.vehicles:
        return "no vehicles", "outline the vehicles, or measure: they are then looked for"
    return "ready", "look the set-up over, then measure"


def _search(root: Path, below: Path, deep: int) -> Iterator[str]:
    try:
        if any((root / below / document).is_file() for document in (CLIP, FOLLOW)):
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
