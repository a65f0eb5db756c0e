"""Runs of the command line, one after the other, each in a process and a folder of its own.

A run of clip C lives in ``C/runs/0001/``: ``run.json`` says what was asked and how it ended, ``asked/`` holds the
documents as they were then, which it measures, and ``out/`` is what the command wrote. The command puts its output in
place at the end (a live one vehicle by vehicle) and touches nothing else, so however a run ends the clip is as it was.
A run that says it is under way, while no process of this console works on it, was interrupted.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from paceline.console.confinement import NotHere, check_document, file_below, folder_below
from paceline.console.runs.inputs import ASKED, copy_documents
from paceline.console.runs.kinds import LIVE, MEASURING, arguments, document_of, keeps_vehicles
from paceline.console.runs.monitor import Watch
from paceline.console.runs.results import Series, why_nothing
from paceline.errors import UnusableInput
from paceline.progress import MAX_LINE_LENGTH, PROGRESS_VARIABLE, parse_estimate, parse_pictures, parse_progress

RUNS = "runs"
DONE, NOTHING_MEASURED, UNUSABLE = 0, 1, 2  # how the command line ends
PATIENCE = 5.0  # s, for a cancelled command to clear up before it is killed
LAST_WORDS = 20  # lines of a command's messages that are kept
LONGEST_WORDS = 400  # characters of one of them

WAITING, RUNNING = "waiting", "running"
MEASURED, NOTHING, FAILED, CANCELLED, INTERRUPTED = "measured", "nothing measured", "failed", "cancelled", "interrupted"


@dataclass(frozen=True)
class Run:
    """One run: what was asked, ``state`` and plain ``reason``, seconds since the epoch, and how far it is."""

    clip: str
    number: int
    kind: str  # one of kinds
    options: tuple[str, ...]
    state: str
    created: float
    started: float | None = None
    ended: float | None = None
    reason: str = ""
    doing: str = ""  # looking, averaging, measuring, following: one after the other
    done: int = 0
    total: int | None = None
    first: float | None = None  # when its first frame was done; what came before is no measure of the rest

    @property
    def active(self) -> bool:
        return self.state in (WAITING, RUNNING)

    def seconds_left(self, now: float) -> float | None:
        """Seconds to go by the pace so far, or None where that is not known yet."""
        if self.state != RUNNING or self.first is None or self.total is None or self.done < 2:
            return None
        return (now - self.first) / (self.done - 1) * (self.total - self.done)


RUN = TypeAdapter(Run)


class Runs:
    """All runs below ``root``, the resolved folder of the console, and the one that is under way."""

    def __init__(self, root: Path, folder: Callable[[str], Path]) -> None:
        self._root, self._folder = root, folder
        self._lock = threading.Condition()
        self._active: dict[tuple[str, int], Run] = {}
        self._queue: deque[tuple[str, int]] = deque()
        self._process: tuple[tuple[str, int], subprocess.Popen[str]] | None = None
        self._cancelled: set[tuple[str, int]] = set()
        self._stopped: set[tuple[str, int]] = set()
        self._watches: dict[tuple[str, int], Watch] = {}
        self._closed = False
        self._known: dict[Path, tuple[int, Run | None]] = {}
        self._held = _only_one(root)
        self._worker = threading.Thread(target=self._work, name="runs", daemon=True)
        self._worker.start()

    def start(self, clip: str, kind: str, options: Sequence[str] = ()) -> Run:
        """Queues a run of the command with ``options``. Raises UnusableInput where no run can be kept, NotHere where
        the clip has no document of the ``kind``."""
        folder = self._folder(clip)
        file = file_below(folder, document_of(kind))
        check_document(self._root, file)
        with self._lock:
            number = _make_folder(folder)
        run = Run(clip, number, kind, tuple(options), WAITING, time.time())
        where = self.folder(run)
        try:  # while pages go on: it takes seconds where thousands of vehicles are outlined
            copy_documents(self._root, file, where / ASKED, keeps_vehicles(kind))
            _write(where, run)
        except OSError as error:
            shutil.rmtree(where, ignore_errors=True)
            raise UnusableInput(f"{where}: cannot be written ({error.strerror})") from error
        except UnusableInput:
            shutil.rmtree(where, ignore_errors=True)
            raise
        with self._lock:
            self._active[clip, number] = run
            self._queue.append((clip, number))
            self._lock.notify_all()
        return run

    def cancel(self, clip: str, number: int) -> None:
        """Ends a run that waits or is under way; its folder says so."""
        key = clip, number
        with self._lock:
            if key in self._queue:
                self._queue.remove(key)
                self._end(replace(self._active[key], state=CANCELLED))
            elif key in self._active:
                self._cancelled.add(key)
                if self._process is not None and self._process[0] == key:
                    _stop(self._process[1])

    def stop(self, clip: str, number: int) -> None:
        """Ends a live run as Ctrl-C does: what has been seen is measured, and kept."""
        key = clip, number
        with self._lock:
            if self._process is not None and self._process[0] == key and key not in self._stopped:
                self._stopped.add(key)
                with contextlib.suppress(ProcessLookupError):
                    self._process[1].send_signal(signal.SIGINT)

    def is_stopping(self, run: Run) -> bool:
        """Whether a live run has been asked to end, and is still at it."""
        with self._lock:
            return (run.clip, run.number) in self._stopped

    def watch(self, run: Run) -> tuple[list[Series], dict[str, Any]]:
        """What a run under way has told so far: values over time, and the scene of its last frame."""
        with self._lock:
            watch = self._watches.get((run.clip, run.number))
            return ([], {}) if watch is None else (watch.series(), watch.scene)

    def picture(self, run: Run, frame: int, view: int) -> bytes:
        """What a live run under way has just seen in a ``view``, as JPEG. Raises NotHere."""
        with self._lock:
            watch = self._watches.get((run.clip, run.number))
            pictures = watch.pictures.get(frame, []) if watch is not None else []
        if not 0 <= view < len(pictures):
            raise NotHere(f"frame {frame}")
        return pictures[view]

    def of(self, clip: str) -> list[Run]:
        """The runs of a clip, latest first."""
        try:
            found = [int(p.name) for p in folder_below(self._folder(clip), RUNS).iterdir() if p.name.isdecimal()]
        except (NotHere, OSError):
            return []
        runs = (self.get(clip, number) for number in sorted(found, reverse=True))
        return [run for run in runs if run is not None]

    def get(self, clip: str, number: int) -> Run | None:
        """A run, or None where there is none of this number."""
        with self._lock:
            if (clip, number) in self._active:
                return self._active[clip, number]
        try:
            return self._read(clip, number, _folder_of(self._folder(clip), number))
        except (NotHere, OSError):
            return None

    def active(self) -> list[Run]:
        """The run under way and those that wait, in their order."""
        with self._lock:
            return sorted(self._active.values(), key=lambda run: (run.state != RUNNING, run.created))

    def folder(self, run: Run) -> Path:
        """Where a run is kept. Raises NotHere for a folder that is a link."""
        return _folder_of(self._folder(run.clip), run.number)

    def asked(self, run: Run) -> Path:
        """The document that a run measures, as it was when it was asked for. Raises NotHere."""
        name = document_of(run.kind)
        return file_below(self.folder(run), f"{ASKED}/{name if run.clip == '.' else f'{run.clip}/{name}'}")

    def out(self, run: Run) -> Path:
        """Where the command's output is, once it has ended well."""
        return self.folder(run) / "out"

    def close(self) -> None:
        """Ends what is under way and waits for it to clear up."""
        with self._lock:
            self._closed = True
            self._queue.clear()
            if self._process is not None:
                _stop(self._process[1])
            self._lock.notify_all()
        self._worker.join(2 * PATIENCE)
        os.close(self._held)

    def _read(self, clip: str, number: int, folder: Path) -> Run | None:
        """As `_read`, again only for a file that has changed: pages ask twice a second."""
        changed = (folder / "run.json").stat().st_mtime_ns
        known = self._known.get(folder)
        if known is None or known[0] != changed:
            known = self._known[folder] = changed, _read(clip, number, folder)
        return known[1]

    # --- the worker ------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._queue or self._closed)
                if self._closed:
                    return
                key = self._queue.popleft()
                run = self._active[key] = replace(self._active[key], state=RUNNING, started=time.time())
            try:
                ended = self._run(run)
            except (OSError, NotHere, UnusableInput) as error:
                reason = self._shown(run, f"could not be run ({error})")
                ended = replace(run, state=FAILED, reason=reason)
            with self._lock:
                self._process = None
                self._end(ended)

    def _run(self, run: Run) -> Run:
        key = run.clip, run.number
        where = self.folder(run)
        file, asked = self.asked(run), where / ASKED
        check_document(self._root, file)  # what it names may have become something else while the run waited
        _write(where, run)
        command = [sys.executable, "-P", "-m", "paceline", *arguments(run.kind, str(file.relative_to(asked)), where)]
        with self._lock:
            if self._closed or key in self._cancelled:
                return replace(run, state=INTERRUPTED if self._closed else CANCELLED)
            process = subprocess.Popen(
                [*command, *run.options],
                cwd=asked,  # where the copies are called as the originals are from the console's folder
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                env=_environment(),
                start_new_session=True,  # Ctrl-C is the console's, which ends its runs itself
            )
            self._process = key, process
            self._watches[key] = Watch()
        threading.Thread(target=_leave_nothing, args=[process], daemon=True).start()
        words = self._listen(key, process)
        status = process.wait()
        for partial in where.glob(".*.partial"):  # what a killed command could not clear up
            shutil.rmtree(partial, ignore_errors=True)
        reason = words[-1].removeprefix("paceline: ") if words else ""
        run = self._active[key]
        if key in self._cancelled:
            return replace(run, state=CANCELLED)
        if key in self._stopped and status not in (DONE, NOTHING_MEASURED):
            return replace(run, state=CANCELLED, reason="it was stopped before anything could be measured")
        if self._closed:
            return replace(run, state=INTERRUPTED, reason="the console was closed")
        if status == DONE:
            return replace(run, state=MEASURED)
        if status == NOTHING_MEASURED:
            why = why_nothing(self.out(run)) if run.kind in MEASURING else self._shown(run, reason)
            return replace(run, state=NOTHING, reason=why)
        if status == UNUSABLE:
            return replace(run, state=FAILED, reason=self._shown(run, reason))
        killed = f"its process was killed (signal {-status})" if status < 0 else f"it ended with status {status}"
        return replace(run, state=INTERRUPTED, reason=killed)

    def _listen(self, key: tuple[str, int], process: subprocess.Popen[str]) -> list[str]:
        """Follows what the command says until it ends; returns the last of its messages."""
        words: deque[str] = deque(maxlen=LAST_WORDS)
        assert process.stdout is not None
        with process.stdout:
            while line := process.stdout.readline(MAX_LINE_LENGTH):
                progress, estimate = parse_progress(line), parse_estimate(line)
                if estimate is not None:
                    with self._lock:
                        self._watches[key].add(estimate)
                    continue
                if (pictures := parse_pictures(line)) is not None:
                    with self._lock:
                        self._watches[key].show(pictures)
                    continue
                if progress is None:
                    words.append(line.strip()[:LONGEST_WORDS])
                    continue
                with self._lock:
                    self._watches[key].turn()
                    run, (doing, done, total) = self._active[key], progress
                    first = run.first if run.first and run.doing == doing else time.time()
                    self._active[key] = replace(run, doing=doing, done=done, total=total, first=first)
        return [word for word in words if word]

    def _end(self, run: Run) -> None:
        ended = replace(run, ended=time.time())
        with contextlib.suppress(NotHere, OSError):  # someone removed the folder in the meantime
            folder = self.folder(run)
            try:
                _write(folder, ended)
            except OSError:  # a full disk; how it ended is told as long as this console runs
                self._known[folder] = (folder / "run.json").stat().st_mtime_ns, ended
        key = run.clip, run.number
        del self._active[key]
        self._watches.pop(key, None)
        self._stopped.discard(key)

    def _shown(self, run: Run, reason: str) -> str:
        """``reason`` with files as seen from the console's folder, and copies called as what they are copies of."""
        asked = self._root / run.clip / RUNS / f"{run.number:04d}" / ASKED
        return reason.replace(f"{asked}/", "").replace(f"{self._root}/", "")


def _environment() -> dict[str, str]:
    """That of a command which tells how far it is, and is started from another folder."""
    environment = {**os.environ, PROGRESS_VARIABLE: "lines"}
    if found := environment.get("PYTHONPATH"):
        environment["PYTHONPATH"] = os.pathsep.join(os.path.abspath(path) for path in found.split(os.pathsep))
    return environment


def _stop(process: subprocess.Popen[str]) -> None:
    """Asks a process to end, and kills it and its own if it has not within PATIENCE."""

    def kill() -> None:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)

    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGTERM)
    timer = threading.Timer(PATIENCE, kill)
    timer.daemon = True
    timer.start()


def _leave_nothing(process: subprocess.Popen[str]) -> None:
    """Once a process has ended, however that was, ends its own: they would hold on to what is listened to."""
    process.wait()
    with contextlib.suppress(ProcessLookupError):  # most often there are none
        os.killpg(process.pid, signal.SIGKILL)


def _make_folder(clip: Path) -> int:
    runs = clip / RUNS
    try:
        runs.mkdir(exist_ok=True)
        if runs.resolve() != runs:
            raise UnusableInput(f"{runs}: is a link; expected a folder for the runs")
        number = max((int(p.name) for p in runs.iterdir() if p.name.isdecimal()), default=0) + 1
        (runs / f"{number:04d}").mkdir()
    except OSError as error:
        raise UnusableInput(f"{runs}: cannot be written ({error.strerror}); runs are kept there") from error
    return number


def _write(folder: Path, run: Run) -> None:
    partial = folder / ".run.json.partial"
    partial.write_text(json.dumps(asdict(run), indent=2) + "\n", encoding="utf-8")
    partial.replace(folder / "run.json")


def _folder_of(clip: Path, number: int) -> Path:
    return folder_below(clip, f"{RUNS}/{number:04d}")


def _read(clip: str, number: int, folder: Path) -> Run | None:
    try:
        found = json.loads(file_below(folder, "run.json").read_text(encoding="utf-8"))
        run = RUN.validate_python({**found, "clip": clip, "number": number})
    except (ValueError, TypeError):
        return None
    if not run.active:
        return run
    if run.kind != LIVE and (folder / "out" / "summary.json").is_file():  # its output appears whole, so it had ended
        return replace(run, state=MEASURED)
    return replace(run, state=INTERRUPTED, reason="the console or the computer was stopped while it ran")


def _only_one(root: Path) -> int:
    """A lock on ``root``, held until this process ends. Raises UnusableInput where another console holds it."""
    try:
        held = os.open(root, os.O_RDONLY)
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UnusableInput(f"{root}: another console serves this folder already") from error
    except OSError as error:
        raise UnusableInput(f"{root}: cannot be read ({error.strerror})") from error
    return held
