"""Runs a command in a process of its own, with limits, a full disk or a signal, and says how it ended."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

from .cases import Disturbance

ROOT = Path(__file__).parents[2]
SECONDS_ALLOWED = 60.0  # of wall time; the longest undisturbed case takes a fifth of it
MEMORY_ALLOWED = 6 << 30  # bytes more than the process has at its start, where no case sets another limit
POLL_S = 0.01
SIGNALS = {"SIGINT": signal.SIGINT, "SIGTERM": signal.SIGTERM}


@dataclass(frozen=True)
class Ended:
    """How a process ended: its exit status, negative for a signal's number, and what it printed."""

    status: int
    stdout: str
    stderr: str
    seconds: float
    hung: bool = False
    survivors: int = 0  # processes of its session that outlived it


def run_command(arguments: list[str], folder: Path, disturbance: Disturbance) -> Ended:
    """`paceline ARGUMENTS` in ``folder``, whose folder tmp is its TMPDIR."""

    def as_fork() -> None:
        from paceline import cli

        sys.argv = ["paceline", *arguments]
        cli.main()

    def as_own_process() -> None:
        os.execv(sys.executable, [sys.executable, "-m", "paceline", *arguments])

    return run(as_own_process if disturbance.own_process else as_fork, folder, disturbance)


def run(function: Callable[[], None], folder: Path, disturbance: Disturbance | None = None) -> Ended:
    """What a ``function`` does in a fork of this process."""
    disturbance = disturbance or Disturbance()
    (folder / "tmp").mkdir(exist_ok=True)
    begun = time.monotonic()
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        _child(function, folder, disturbance)
    status, hung = _wait(pid, begun, disturbance)
    survivors = _end_session(pid)
    stdout, stderr = ((folder / name).read_text(errors="replace") for name in ("stdout", "stderr"))
    return Ended(status, stdout, stderr, time.monotonic() - begun, hung, survivors)


def _child(function: Callable[[], None], folder: Path, disturbance: Disturbance) -> NoReturn:
    status = 1
    try:
        os.setsid()
        for name, number in (("stdout", 1), ("stderr", 2)):
            file = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_APPEND)
            os.dup2(file, number)
            os.close(file)
        sys.stdout, sys.stderr = (os.fdopen(n, "w", buffering=1, encoding="utf-8") for n in (1, 2))
        os.chdir(folder)
        environment = {"TMPDIR": str(folder / "tmp"), "PYTHONPATH": str(ROOT / "src"), "OPENBLAS_NUM_THREADS": "1"}
        os.environ.update(environment, COLUMNS="100")
        import tempfile

        tempfile.tempdir = None
        for number in SIGNALS.values():
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        _limit(disturbance)
        function()
        status = 0
    except SystemExit as exit:
        status = exit.code if isinstance(exit.code, int) else int(exit.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        with suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)


def _limit(disturbance: Disturbance) -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    memory = disturbance.size if disturbance.kind == "memory" else MEMORY_ALLOWED
    limit = pages * resource.getpagesize() + memory
    if not disturbance.own_process:
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    if disturbance.kind == "file size":
        resource.setrlimit(resource.RLIMIT_FSIZE, (disturbance.size, disturbance.size))


def _wait(pid: int, begun: float, disturbance: Disturbance) -> tuple[int, bool]:
    """The exit status of a process, which gets its signal on the way, and whether it had to be killed."""
    number, due = SIGNALS.get(disturbance.kind), None
    while True:
        ended, status = os.waitpid(pid, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), False
        now = time.monotonic()
        if number is not None and due is None and _answers_signals(pid):
            due = now + disturbance.after
        if number is not None and due is not None and now >= due:
            os.kill(pid, number)
            number = None
        if now - begun > SECONDS_ALLOWED:
            with suppress(ProcessLookupError):
                os.killpg(pid, signal.SIGKILL)
            _, status = os.waitpid(pid, 0)
            return os.waitstatus_to_exitcode(status), True
        time.sleep(POLL_S)


def _answers_signals(pid: int) -> bool:
    """Whether a process has begun: it then catches SIGTERM, which the interpreter alone does not."""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("SigCgt:"):
                return bool(int(line.split()[1], 16) >> (signal.SIGTERM - 1) & 1)
    return False


def _end_session(session: int) -> int:
    """Ends what is left of a session that this process has started; returns how many that were."""
    for attempt in range(100):
        members = list(_members(session))
        if not members:
            return 0
        if attempt < 99:
            time.sleep(POLL_S)  # children end with their parents, but not at once
    for pid in members:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return len(members)


def _members(session: int) -> Iterator[int]:
    for place in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = place.read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and fields[0] != "Z":
                yield int(place.parent.name)


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[None]:
    """A disk of ``size`` bytes at ``folder``."""
    size -= size % 4096
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def can_mount() -> bool:
    """Whether this user may mount disks."""
    return os.geteuid() == 0 and subprocess.run(["which", "mount"], capture_output=True).returncode == 0
