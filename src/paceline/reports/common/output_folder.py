"""Writes the output of a command, a folder or a few files, atomically: all of it or none."""

from __future__ import annotations

import errno
import fcntl
import glob
import os
import secrets
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType, TracebackType

from paceline.errors import UnusableInput

# Errors without a file name that only writing can have caused.
WRITE_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG}
MIN_ABANDONED_AGE_S = 60.0  # of an incomplete output that is not locked: a process locks its own at once


class OutputFolder:
    """Collects a command's output and puts it in place at the end.

    ``with OutputFolder("out") as folder:`` gives the path of a hidden folder on the same file system to write into.
    When the block ends well, a new ``out`` appears in one step; in an ``out`` that already exists each file of the
    same name is replaced atomically and every other file stays. When the block raises, nothing is left behind; what a
    process that was killed has left is removed by the next one.
    Raises UnusableInput when ``out`` is a file, cannot be written or the disk is full.
    """

    def __init__(self, out: str | Path) -> None:
        self.out = Path(out)
        self._created: list[Path] = []  # folders created for the output, outermost first
        self._partial = self.out.parent / f".{self.out.name or 'paceline'}.{secrets.token_hex(4)}.partial"
        self._lock = -1  # file descriptor of the locked hidden folder

    def __enter__(self) -> Path:
        try:
            if self.out.exists() and not self.out.is_dir():
                raise UnusableInput(f"{self.out}: is a file; expected a folder for the output")
            # Inside an existing folder, which may be a mount point of its own, else beside the one to come.
            parent = self.out if self.out.is_dir() else self.out.parent
            for folder in reversed([p for p in (parent, *parent.parents) if not p.exists()]):
                folder.mkdir()
                self._created.append(folder)
            _remove_abandoned(parent, self.out.name or "paceline")
            self._partial = parent / self._partial.name
            self._partial.mkdir()
            self._lock = os.open(self._partial, os.O_RDONLY)
            with suppress(OSError):  # not every file system has locks
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BaseException as error:  # Ctrl-C, too, just after a folder was made
            self._clean_up()
            if isinstance(error, OSError):
                raise self._write_error(error) from error
            raise
        return self._partial

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                with _defer_interrupts():
                    self._replace_target()
                self._created.clear()
            elif isinstance(error, OSError) and self._is_output_error(error):
                raise self._write_error(error) from error
        except OSError as failure:
            raise self._write_error(failure) from failure
        finally:
            self._clean_up()

    def _clean_up(self) -> None:
        """Removes what has not been moved to the target."""
        shutil.rmtree(self._partial, ignore_errors=True)
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1
        self._remove_created()

    def _replace_target(self) -> None:
        if not self.out.exists():
            self._partial.rename(self.out)
            return
        files = [p.relative_to(self._partial) for p in sorted(self._partial.rglob("*")) if p.is_file()]
        for file in files:  # obstacles are found before the first file is replaced
            if (self.out / file).is_dir():
                raise IsADirectoryError(errno.EISDIR, "a folder is in the way", str(self.out / file))
            if any((self.out / folder).is_file() for folder in file.parents):
                raise NotADirectoryError(errno.ENOTDIR, f"a file is in the way of {file}", str(self.out / file))
        for file in files:
            (self.out / file).parent.mkdir(parents=True, exist_ok=True)
            os.replace(self._partial / file, self.out / file)

    def _is_output_error(self, error: OSError) -> bool:
        if isinstance(error.filename, str | os.PathLike):
            return Path(error.filename).is_relative_to(self._partial)
        return error.errno in WRITE_ERRORS

    def _write_error(self, error: OSError) -> UnusableInput:
        return UnusableInput(f"{self.out}: the output cannot be written here ({error.strerror or error})")

    def _remove_created(self) -> None:
        for folder in reversed(self._created):
            try:
                folder.rmdir()
            except OSError:  # it is in use
                return


def _remove_abandoned(parent: Path, name: str) -> None:
    """Removes the incomplete outputs called ``name`` in ``parent`` whose processes are gone: nobody locks them."""
    for partial in parent.glob(f".{glob.escape(name)}.*.partial"):
        with suppress(OSError):
            if time.time() - partial.stat().st_mtime < MIN_ABANDONED_AGE_S:
                continue
            folder = os.open(partial, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(partial, ignore_errors=True)
            finally:
                os.close(folder)


def write_all_or_none(contents: dict[Path, bytes]) -> None:
    """Writes all files or none. Raises UnusableInput, which names the first, where they cannot be written."""
    partial = {path: path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial") for path in contents}
    first = next(iter(contents))
    try:
        first.parent.mkdir(parents=True, exist_ok=True)
        for path, content in contents.items():
            if path.is_dir():
                raise UnusableInput(f"{path}: is a folder; expected the name of a file to write")
            partial[path].write_bytes(content)
        for path in contents:
            os.replace(partial[path], path)
    except OSError as error:
        raise UnusableInput(f"{first}: cannot be written ({error.strerror})") from error
    finally:
        for path in partial.values():
            with suppress(OSError):  # usually it has been moved
                path.unlink()


@contextmanager
def _defer_interrupts() -> Iterator[None]:
    """Defers Ctrl-C and termination while files are being replaced."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    held: list[tuple[int, FrameType | None]] = []
    previous = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in previous:
        signal.signal(number, lambda received, frame: held.append((received, frame)))
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
        for received, _ in held[:1]:
            signal.raise_signal(received)
