"""The command as a person calls it: in this process, which has imported what it needs already, or in one of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import chdir, contextmanager
from pathlib import Path
from typing import IO, NamedTuple
from unittest import mock

from paceline import cli

ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1] / "src"), "COLUMNS": "100"}
COMMAND = [sys.executable, "-m", "paceline"]


class Done(NamedTuple):
    """How a command ended: its status, and all that it and its libraries wrote to both streams."""

    returncode: int
    stdout: str
    stderr: str


def paceline(*arguments: object, folder: Path | None = None) -> Done:
    """`paceline ARGUMENTS` in this process, called from ``folder``."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with _captured("stdout", 1) as out, _captured("stderr", 2) as err:
        try:
            with (
                mock.patch.object(sys, "argv", ["paceline", *map(str, arguments)]),
                mock.patch.dict(os.environ, COLUMNS="100"),
                chdir(folder or "."),
            ):
                cli.main()
        except SystemExit as exit:
            return Done(int(exit.code or 0), _text(out), _text(err))
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    raise AssertionError("the command returned where it should have exited")


def in_a_process(*arguments: object) -> Done:
    """`paceline ARGUMENTS` in a process of its own."""
    command = [*COMMAND, *map(str, arguments)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=300)
    return Done(done.returncode, done.stdout, done.stderr)


def assert_one_line_error(done: Done, *words: str) -> None:
    """Status 2 and a single plain line on standard error with all ``words`` in it."""
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("paceline: ") and done.stderr.endswith("\n"), done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    for word in words:
        assert word in done.stderr


@contextmanager
def _captured(name: str, number: int) -> Iterator[IO[str]]:
    """A file that takes what goes to ``sys.NAME`` and, from libraries that are not Python, to its descriptor."""
    stream, before = getattr(sys, name), os.dup(number)
    with tempfile.TemporaryFile("w+", encoding="utf-8") as file:
        os.dup2(file.fileno(), number)
        setattr(sys, name, file)
        try:
            yield file
        finally:
            setattr(sys, name, stream)
            os.dup2(before, number)
            os.close(before)


def _text(file: IO[str]) -> str:
    file.flush()
    file.seek(0)
    return file.read()
