"""The clips below the console's folder, with the state of each."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from paceline.console.confinement import NotFound, check_document, file_below, folder_below, named_files
from paceline.console.document_references import (
    CLIP_FILE,
    FOLLOW_FILE,
    PartialFollowModel,
    is_follow,
    live_views,
    read_cached,
)
from paceline.console.frames.frame_cache import FileStamps, FrameCache, file_stamps, is_unchanged
from paceline.console.runs.kinds import MEASURING_KINDS
from paceline.console.runs.run_queue import STATE_CANCELLED, STATE_RUNNING, Run, RunQueue
from paceline.documents.loading import load_clip, load_follow
from paceline.documents.models import ClipModel
from paceline.errors import UnusableInput

MAX_FOLDER_DEPTH = 4  # levels of subfolders that are searched for clips
MAX_CLIPS = 1000
READER_THREADS = 2  # number of documents that are read at the same time
STATE_BEING_READ = "being read"


@dataclass(frozen=True)
class ClipContents:
    """What a clip.yaml or follow.yaml holds. ``state`` and ``reason`` say why it cannot be measured, and are empty
    where it can. ``live`` are its live sources, ``target`` is the name of the vehicle ahead, ``pictures`` whether
    frames can be shown, ``seconds`` the duration of the recording, None if unknown."""

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
class ClipEntry:
    """One clip: ``name`` is its folder's, ``state`` one or two words, ``reason`` a line of explanation or empty."""

    name: str
    state: str
    reason: str
    contents: ClipContents
    runs: list[Run]


class Library:
    """The clips below ``root``, a resolved folder; ``read_only`` where it cannot be written."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.read_only = not os.access(root, os.W_OK | os.X_OK)
        self.frame_cache = FrameCache(root)
        self.runs = RunQueue(root, self.folder)
        self._known: dict[Path, tuple[FileStamps, ClipContents]] = {}
        self._readers = ThreadPoolExecutor(READER_THREADS, "reading")
        self._reading: dict[Path, Future[tuple[FileStamps, ClipContents]]] = {}
        self._lock = threading.Lock()

    def refuse_read_only(self) -> None:
        """Raises UnusableInput where the console's folder cannot be written."""
        if self.read_only:
            raise UnusableInput("this folder cannot be written: its clips and results can be viewed, nothing else")

    def folder(self, name: str) -> Path:
        """The folder of the clip ``name``. Raises NotFound."""
        return self.file(name).parent

    def file(self, name: str) -> Path:
        """The clip.yaml or follow.yaml of the clip ``name``. Raises NotFound."""
        folder = folder_below(self.root, name)
        for document in (CLIP_FILE, FOLLOW_FILE):
            with suppress(NotFound):
                return file_below(folder, document)
        raise NotFound(name)

    def names(self) -> list[str]:
        """The names of the clips, sorted; links, hidden folders and folders inside a clip are skipped."""
        names = []
        for name in _find_clips(self.root, Path("."), MAX_FOLDER_DEPTH):
            names.append(name)
            if len(names) == MAX_CLIPS:
                break
        return sorted(names, key=str.lower)

    def entry(self, name: str, timeout: float | None = None) -> ClipEntry:
        """The clip ``name``; in the state STATE_BEING_READ where reading it takes longer than ``timeout`` s. Raises
        NotFound."""
        contents = self._contents(self.file(name), timeout)
        runs = [run for run in self.runs.runs_of(name) if run.kind in MEASURING_KINDS or run.active]
        state, reason = contents.state, contents.reason
        if not state:
            state, reason = _clip_state(contents, runs)
        return ClipEntry(name, state, reason, contents, runs)

    def _contents(self, file: Path, timeout: float | None) -> ClipContents:
        """As `_examine`, cached until a file changes: every open list asks every other second."""
        known = self._known.get(file)
        if known is not None and is_unchanged(known[0]):
            return known[1]
        with self._lock:
            reading = self._reading.get(file)
            if reading is None:
                reading = self._reading[file] = self._readers.submit(self._read, file)
        try:
            known = self._known[file] = reading.result(timeout)
        except TimeoutError:
            reason = "its files are large, or on a slow disk"
            return ClipContents(state=STATE_BEING_READ, reason=reason, chase=is_follow(file), pictures=False)
        finally:
            if reading.done():
                self._reading.pop(file, None)
        return known[1]

    def _read(self, file: Path) -> tuple[FileStamps, ClipContents]:
        return file_stamps(named_files(self.root, file)), self._examine(file)

    def _examine(self, file: Path) -> ClipContents:
        chase = is_follow(file)
        try:
            check_document(self.root, file)
            live = tuple(live_views(file))
            return self._examine_chase(file, live) if chase else self._examine_clip(file, live)
        except UnusableInput as error:
            return ClipContents(state="unreadable", reason=self.relative_message(error), chase=chase, pictures=False)

    def _examine_clip(self, file: Path, live: tuple[str, ...]) -> ClipContents:
        model = read_cached(ClipModel, file)
        vehicles, paths = len(model.vehicles or []), len(model.paths or {})
        if model.rig is None and model.site is None:
            return ClipContents(vehicles, paths, "no rig", "add the rig file of its cameras", live=live, pictures=False)
        clip = load_clip(file)
        seconds = None if live else self.frame_cache.open(file).seconds
        return ClipContents(len(clip.vehicles), len(clip.paths), live=live, pictures=not live, seconds=seconds)

    def _examine_chase(self, file: Path, live: tuple[str, ...]) -> ClipContents:
        model = read_cached(PartialFollowModel, file)
        if not live:
            self.frame_cache.open(file)
        reason = "outline the vehicle ahead, or place its model"
        if model.target is not None and model.start is not None:
            try:
                return ClipContents(chase=True, target=load_follow(file).target.name, live=live, pictures=not live)
            except UnusableInput as error:
                reason = self.relative_message(error)
        return ClipContents(state="no target", reason=reason, chase=True, live=live, pictures=not live)

    def relative_message(self, error: UnusableInput) -> str:
        """The error's message with file names relative to the console's folder."""
        return str(error).replace(f"{self.root}/", "").replace(str(self.root), ".")


def _clip_state(contents: ClipContents, runs: list[Run]) -> tuple[str, str]:
    if any(run.active for run in runs):
        return STATE_RUNNING, ""
    finished = [run for run in runs if run.state != STATE_CANCELLED]
    if finished:
        return finished[0].state, finished[0].reason
    if contents.live:
        return "live", f"{' and '.join(contents.live)}: measured while they record"
    if contents.chase:
        return "ready", f"check that the lines lie on the {contents.target}, then follow it"
    if not contents.vehicles and not contents.paths:
        return "no paths", "draw the road line that vehicles follow, or measure: lanes are then detected"
    if not contents.vehicles:
        return "no vehicles", "outline the vehicles, or measure: they are then detected"
    return "ready", "check the set-up, then measure"


def _find_clips(root: Path, below: Path, deep: int) -> Iterator[str]:
    try:
        if any((root / below / document).is_file() for document in (CLIP_FILE, FOLLOW_FILE)):
            yield below.as_posix()
            return
        if not deep:
            return
        with os.scandir(root / below) as entries:
            folders = [e.name for e in entries if not e.name.startswith(".") and e.is_dir(follow_symlinks=False)]
    except OSError:  # no permission
        return
    for name in sorted(folders):
        yield from _find_clips(root, below / name, deep - 1)
