"""The console's runs, queued and executed one after another, each a command in a process and a folder of its own.

A run of clip C is stored in ``C/runs/0001/``: ``run.json`` is what was requested and how the run ended, ``asked/``
holds copies of the documents at that time, which the run measures, and ``out/`` is the command's output. The command
writes its output at the end (a live one vehicle by vehicle) and nothing else, so the clip is unchanged however a run
ends. A run whose record says that it is active, while no process of this console works on it, was interrupted.
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

from paceline.console.confinement import NotFound, check_document, file_below, folder_below
from paceline.console.runs.inputs import INPUTS_FOLDER, copy_documents
from paceline.console.runs.kinds import LIVE_RUN, MEASURING_KINDS, command_arguments, document_of, keeps_vehicles
from paceline.console.runs.results import Series, nothing_measured_reason
from paceline.console.runs.run_progress import RunProgress
from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED, EXIT_UNUSABLE_INPUT
from paceline.progress import MAX_LINE_LENGTH, PROGRESS_VARIABLE, parse_estimate, parse_pictures, parse_progress

RUNS_FOLDER = "runs"
TERMINATION_TIMEOUT_S = 5.0  # time that a cancelled command has to clean up before it is killed
MAX_MESSAGES = 20  # lines of a command's output that are kept
MAX_MESSAGE_LENGTH = 400  # characters of a line

STATE_WAITING, STATE_RUNNING = "waiting", "running"
STATE_MEASURED, STATE_NOTHING, STATE_FAILED = "measured", "nothing measured", "failed"
STATE_CANCELLED, STATE_INTERRUPTED = "cancelled", "interrupted"


@dataclass(frozen=True)
class Run:
    """One run: what was requested, its ``state`` and ``reason``, times in seconds since the epoch, and its progress."""

    clip: str
    number: int
    kind: str  # one of RUN_KINDS
    options: tuple[str, ...]
    state: str
    created: float
    started: float | None = None
    ended: float | None = None
    reason: str = ""
    doing: str = ""  # the activity of the latest progress line
    done: int = 0
    total: int | None = None
    first: float | None = None  # when the first progress line of the activity came: the start-up is not counted
    first_done: int = 0  # what was done then
    latest: float | None = None  # when the latest progress line came

    @property
    def active(self) -> bool:
        return self.state in (STATE_WAITING, STATE_RUNNING)

    def seconds_left(self, now: float) -> float | None:
        """The remaining seconds of the activity, extrapolated from what is done; None if unknown or over."""
        if self.state != STATE_RUNNING or self.total is None or self.done <= self.first_done:
            return None
        assert self.first is not None and self.latest is not None, "both are set by every progress line"
        step = (self.latest - self.first) / (self.done - self.first_done)
        left = step * (self.total - self.done) - (now - self.latest)
        return left if left > 0 else None


RUN_ADAPTER = TypeAdapter(Run)


class RunQueue:
    """All runs below ``root``, the resolved folder of the console, and the queue of those to do."""

    def __init__(self, root: Path, folder: Callable[[str], Path]) -> None:
        self._root, self._folder = root, folder
        self._lock = threading.Condition()
        self._active: dict[tuple[str, int], Run] = {}
        self._queue: deque[tuple[str, int]] = deque()
        self._process: tuple[tuple[str, int], subprocess.Popen[str]] | None = None
        self._cancelled: set[tuple[str, int]] = set()
        self._stopped: set[tuple[str, int]] = set()
        self._progress: dict[tuple[str, int], RunProgress] = {}
        self._closed = False
        self._known: dict[Path, tuple[int, Run | None]] = {}
        self._folder_lock = _lock_folder(root)
        self._worker = threading.Thread(target=self._work, name="runs", daemon=True)
        self._worker.start()

    def start(self, clip: str, kind: str, options: Sequence[str] = ()) -> Run:
        """Queues a run of the command with ``options``. Raises UnusableInput where it cannot be stored, NotFound where
        the clip has no document for the ``kind``."""
        folder = self._folder(clip)
        file = file_below(folder, document_of(kind))
        check_document(self._root, file)
        with self._lock:
            number = _make_run_folder(folder)
        run = Run(clip, number, kind, tuple(options), STATE_WAITING, time.time())
        run_folder = self.folder(run)
        try:  # without the lock: it takes seconds where thousands of vehicles are outlined
            copy_documents(self._root, file, self._inputs_folder(run, run_folder), keeps_vehicles(kind))
            _write_run(run_folder, run)
        except OSError as error:
            shutil.rmtree(run_folder, ignore_errors=True)
            raise UnusableInput(f"{run_folder}: cannot be written ({error.strerror})") from error
        except UnusableInput:
            shutil.rmtree(run_folder, ignore_errors=True)
            raise
        with self._lock:
            self._active[clip, number] = run
            self._queue.append((clip, number))
            self._lock.notify_all()
        return run

    def cancel(self, clip: str, number: int) -> None:
        """Cancels a waiting or active run."""
        key = clip, number
        with self._lock:
            if key in self._queue:
                self._queue.remove(key)
                self._end(replace(self._active[key], state=STATE_CANCELLED))
            elif key in self._active:
                self._cancelled.add(key)
                if self._process is not None and self._process[0] == key:
                    _terminate(self._process[1])

    def stop(self, clip: str, number: int) -> None:
        """Stops a live run as Ctrl-C does: the vehicles seen so far are measured and kept."""
        key = clip, number
        with self._lock:
            if self._process is not None and self._process[0] == key and key not in self._stopped:
                self._stopped.add(key)
                with contextlib.suppress(ProcessLookupError):
                    self._process[1].send_signal(signal.SIGINT)

    def is_stopping(self, run: Run) -> bool:
        """Whether a live run has been stopped and has not ended yet."""
        with self._lock:
            return (run.clip, run.number) in self._stopped

    def live_data(self, run: Run) -> tuple[list[Series], dict[str, Any]]:
        """The estimates of an active run over time, and the scene of its last frame; empty for other runs."""
        with self._lock:
            progress = self._progress.get((run.clip, run.number))
            return ([], {}) if progress is None else (progress.series(), progress.last_frame)

    def picture(self, run: Run, frame: int, view: int) -> bytes:
        """The latest picture of a ``view`` in an active live run, as JPEG. Raises NotFound."""
        with self._lock:
            progress = self._progress.get((run.clip, run.number))
            pictures = progress.pictures.get(frame, []) if progress is not None else []
        if not 0 <= view < len(pictures):
            raise NotFound(f"frame {frame}")
        return pictures[view]

    def runs_of(self, clip: str) -> list[Run]:
        """The runs of a clip, latest first."""
        try:
            numbers = [
                int(p.name) for p in folder_below(self._folder(clip), RUNS_FOLDER).iterdir() if p.name.isdecimal()
            ]
        except (NotFound, OSError):
            return []
        runs = (self.get(clip, number) for number in sorted(numbers, reverse=True))
        return [run for run in runs if run is not None]

    def get(self, clip: str, number: int) -> Run | None:
        """The run with this number, None if there is none."""
        with self._lock:
            if (clip, number) in self._active:
                return self._active[clip, number]
        try:
            return self._read(clip, number, _run_folder(self._folder(clip), number))
        except (NotFound, OSError):
            return None

    def active(self) -> list[Run]:
        """The running run and the waiting ones, in their order."""
        with self._lock:
            return sorted(self._active.values(), key=lambda run: (run.state != STATE_RUNNING, run.created))

    def folder(self, run: Run) -> Path:
        """The folder of a run. Raises NotFound where it is a link."""
        return _run_folder(self._folder(run.clip), run.number)

    def input_document(self, run: Run) -> Path:
        """The run's own copy of the document that it measures. Raises NotFound."""
        folder = self.folder(run)
        file = self._inputs_folder(run, folder) / run.clip / document_of(run.kind)
        return file_below(folder, str(file.relative_to(folder)))

    def _inputs_folder(self, run: Run, folder: Path) -> Path:
        """The folder of the copies in a run's ``folder``; in it they have the same relative paths as the originals in
        the console's. Of a clip right in the console's folder it has that one's name: a report is titled by the folder
        of its clip.yaml."""
        inputs = folder / INPUTS_FOLDER
        return inputs / self._root.name if run.clip == "." else inputs

    def output_folder(self, run: Run) -> Path:
        """The folder of the command's output, which appears when the command succeeds."""
        return self.folder(run) / "out"

    def close(self) -> None:
        """Ends the active run and waits until it has cleaned up."""
        with self._lock:
            self._closed = True
            self._queue.clear()
            if self._process is not None:
                _terminate(self._process[1])
            self._lock.notify_all()
        self._worker.join(2 * TERMINATION_TIMEOUT_S)
        os.close(self._folder_lock)

    def _read(self, clip: str, number: int, folder: Path) -> Run | None:
        """As `_read_run`, cached until the file changes: pages ask twice a second."""
        changed = (folder / "run.json").stat().st_mtime_ns
        known = self._known.get(folder)
        if known is None or known[0] != changed:
            known = self._known[folder] = changed, _read_run(clip, number, folder)
        return known[1]

    # --- the worker ------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            with self._lock:
                self._lock.wait_for(lambda: self._queue or self._closed)
                if self._closed:
                    return
                key = self._queue.popleft()
                run = self._active[key] = replace(self._active[key], state=STATE_RUNNING, started=time.time())
            try:
                ended = self._run(run)
            except (OSError, NotFound, UnusableInput) as error:
                reason = self._relative_reason(run, f"could not be run ({error})")
                ended = replace(run, state=STATE_FAILED, reason=reason)
            with self._lock:
                self._process = None
                self._end(ended)

    def _run(self, run: Run) -> Run:
        key = run.clip, run.number
        folder = self.folder(run)
        file, inputs = self.input_document(run), self._inputs_folder(run, folder)
        check_document(self._root, file)  # the files that it names may have changed while the run waited
        _write_run(folder, run)
        command = [
            sys.executable,
            "-P",
            "-m",
            "paceline",
            *command_arguments(run.kind, str(file.relative_to(inputs)), folder),
        ]
        with self._lock:
            if self._closed or key in self._cancelled:
                return replace(run, state=STATE_INTERRUPTED if self._closed else STATE_CANCELLED)
            process = subprocess.Popen(
                [*command, *run.options],
                cwd=inputs,  # the copies have the same relative paths here as the originals in the console's folder
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                env=_command_environment(),
                start_new_session=True,  # Ctrl-C goes to the console, which ends its runs itself
            )
            self._process = key, process
            self._progress[key] = RunProgress()
        threading.Thread(target=_kill_group_after_exit, args=[process], daemon=True).start()
        messages = self._read_output(key, process)
        status = process.wait()
        for partial in folder.glob(".*.partial"):  # left by a killed command
            shutil.rmtree(partial, ignore_errors=True)
        reason = messages[-1].removeprefix("paceline: ") if messages else ""
        run = self._active[key]
        if key in self._cancelled:
            return replace(run, state=STATE_CANCELLED)
        if key in self._stopped and status not in (EXIT_DONE, EXIT_NOTHING_MEASURED):
            return replace(run, state=STATE_CANCELLED, reason="it was stopped before anything could be measured")
        if self._closed:
            return replace(run, state=STATE_INTERRUPTED, reason="the console was closed")
        if status == EXIT_DONE:
            return replace(run, state=STATE_MEASURED)
        if status == EXIT_NOTHING_MEASURED:
            end_reason = (
                nothing_measured_reason(self.output_folder(run))
                if run.kind in MEASURING_KINDS
                else self._relative_reason(run, reason)
            )
            return replace(run, state=STATE_NOTHING, reason=end_reason)
        if status == EXIT_UNUSABLE_INPUT:
            return replace(run, state=STATE_FAILED, reason=self._relative_reason(run, reason))
        killed = f"its process was killed (signal {-status})" if status < 0 else f"it ended with status {status}"
        return replace(run, state=STATE_INTERRUPTED, reason=killed)

    def _read_output(self, key: tuple[str, int], process: subprocess.Popen[str]) -> list[str]:
        """Reads the command's output until it ends; returns the last of its messages."""
        messages: deque[str] = deque(maxlen=MAX_MESSAGES)
        assert process.stdout is not None
        with process.stdout:
            while line := process.stdout.readline(MAX_LINE_LENGTH):
                progress, estimate = parse_progress(line), parse_estimate(line)
                if estimate is not None:
                    with self._lock:
                        self._progress[key].add_estimate(estimate)
                    continue
                if (pictures := parse_pictures(line)) is not None:
                    with self._lock:
                        self._progress[key].add_pictures(pictures)
                    continue
                if progress is None:
                    messages.append(line.strip()[:MAX_MESSAGE_LENGTH])
                    continue
                with self._lock:
                    self._progress[key].finish_frame()
                    run, (activity, done, total) = self._active[key], progress
                    now = time.time()
                    if run.doing != activity or done < run.done:  # it begins, also anew
                        run = replace(run, first=now, first_done=done)
                    self._active[key] = replace(run, doing=activity, done=done, total=total, latest=now)
        return [message for message in messages if message]

    def _end(self, run: Run) -> None:
        ended = replace(run, ended=time.time())
        with contextlib.suppress(NotFound, OSError):  # the folder has been removed
            folder = self.folder(run)
            try:
                _write_run(folder, ended)
            except OSError:  # the disk is full: kept in memory only
                self._known[folder] = (folder / "run.json").stat().st_mtime_ns, ended
        key = run.clip, run.number
        del self._active[key]
        self._progress.pop(key, None)
        self._stopped.discard(key)

    def _relative_reason(self, run: Run, reason: str) -> str:
        """``reason`` with paths relative to the console's folder, and of originals instead of copies."""
        inputs = self._inputs_folder(run, self._root / run.clip / RUNS_FOLDER / f"{run.number:04d}")
        return reason.replace(f"{inputs}/", "").replace(f"{self._root}/", "")


def _command_environment() -> dict[str, str]:
    """The environment of a command that writes progress lines and is started in another folder."""
    environment = {**os.environ, PROGRESS_VARIABLE: "lines"}
    if python_path := environment.get("PYTHONPATH"):
        environment["PYTHONPATH"] = os.pathsep.join(os.path.abspath(path) for path in python_path.split(os.pathsep))
    return environment


def _terminate(process: subprocess.Popen[str]) -> None:
    """Terminates a process; kills its process group if it has not ended after TERMINATION_TIMEOUT_S."""

    def kill() -> None:
        if process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)

    with contextlib.suppress(ProcessLookupError):
        process.send_signal(signal.SIGTERM)
    timer = threading.Timer(TERMINATION_TIMEOUT_S, kill)
    timer.daemon = True
    timer.start()


def _kill_group_after_exit(process: subprocess.Popen[str]) -> None:
    """Kills the rest of a process group once its leader has ended: it would keep the output pipe open."""
    process.wait()
    with contextlib.suppress(ProcessLookupError):  # usually there are none
        os.killpg(process.pid, signal.SIGKILL)


def _make_run_folder(clip: Path) -> int:
    runs = clip / RUNS_FOLDER
    try:
        runs.mkdir(exist_ok=True)
        if runs.resolve() != runs:
            raise UnusableInput(f"{runs}: is a link; expected a folder for the runs")
        number = max((int(p.name) for p in runs.iterdir() if p.name.isdecimal()), default=0) + 1
        (runs / f"{number:04d}").mkdir()
    except OSError as error:
        raise UnusableInput(f"{runs}: cannot be written ({error.strerror}); runs are kept there") from error
    return number


def _write_run(folder: Path, run: Run) -> None:
    partial = folder / ".run.json.partial"
    partial.write_text(json.dumps(asdict(run), indent=2) + "\n", encoding="utf-8")
    partial.replace(folder / "run.json")


def _run_folder(clip: Path, number: int) -> Path:
    return folder_below(clip, f"{RUNS_FOLDER}/{number:04d}")


def _read_run(clip: str, number: int, folder: Path) -> Run | None:
    try:
        content = json.loads(file_below(folder, "run.json").read_text(encoding="utf-8"))
        run = RUN_ADAPTER.validate_python({**content, "clip": clip, "number": number})
    except (ValueError, TypeError):
        return None
    if not run.active:
        return run
    if (
        run.kind != LIVE_RUN and (folder / "out" / "summary.json").is_file()
    ):  # its output appears at once, so the run had ended
        return replace(run, state=STATE_MEASURED)
    return replace(run, state=STATE_INTERRUPTED, reason="the console or the computer was stopped while it ran")


def _lock_folder(root: Path) -> int:
    """Locks ``root`` until this process ends; returns its descriptor. Raises UnusableInput if it is locked."""
    try:
        held = os.open(root, os.O_RDONLY)
        fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UnusableInput(f"{root}: another console serves this folder already") from error
    except OSError as error:
        raise UnusableInput(f"{root}: cannot be read ({error.strerror})") from error
    return held
