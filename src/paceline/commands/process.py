"""What a command is as a process: how it answers signals, and what becomes of output that nobody can take."""

from __future__ import annotations

import errno
import os
import signal
import sys
from contextlib import suppress
from types import FrameType, TracebackType
from typing import Any

INTERRUPTING_SIGNALS = signal.SIGINT, signal.SIGTERM
OPENCV_NO_MEMORY = -4  # code of a cv2.error, as cv2.Error.StsNoMem; OpenCV need not be imported to know it


class ReceivedSignals:
    """Ctrl-C and termination raise KeyboardInterrupt and SystemExit, so that no incomplete output remains.

    ``status`` is the exit status that the first one asks for, None where none has come.
    """

    def __init__(self) -> None:
        self.status: int | None = None
        for number in INTERRUPTING_SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # as a shell leaves it to what it starts
                signal.signal(number, self._answer)

    def ignore(self) -> None:
        """Answer none any more: the work is done, and the interpreter ends."""
        for number in INTERRUPTING_SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _answer(self, number: int, frame: FrameType | None) -> None:
        self.status = self.status or 128 + number
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(128 + number)


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory ran out, as Python, NumPy, OpenCV and FFmpeg say it: also that of a thread that cannot start."""
    if isinstance(error, OSError):  # EAGAIN is FFmpeg's where a thread cannot start
        is_of_ffmpeg = type(error).__module__.startswith("av.")
        return error.errno == errno.ENOMEM or is_of_ffmpeg and error.errno == errno.EAGAIN
    if isinstance(error, RuntimeError):
        return "can't start new thread" in str(error)
    return isinstance(error, MemoryError) or getattr(error, "code", None) == OPENCV_NO_MEMORY


class StandardOutput:
    """Stands in for standard output within its block, and drops what cannot be written, as to a full disk.

    ``problem`` says afterwards why something was dropped; None where nothing was, where the reader has gone, or where
    there is no standard output.
    """

    def __init__(self) -> None:
        self.problem: str | None = None
        self._stream = sys.stdout

    def write(self, text: str) -> int:
        try:
            self._stream.write(text)
        except OSError as error:
            self._drop(error)
        return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._drop(error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def __enter__(self) -> None:
        if self._stream is not None:
            sys.stdout = self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stream is not None:
            self.flush()
        sys.stdout = self._stream

    def _drop(self, error: OSError) -> None:
        if self.problem is None and not isinstance(error, BrokenPipeError):
            self.problem = f"standard output cannot be written ({error.strerror})"
        with suppress(OSError, ValueError):  # what is left in the buffer goes nowhere
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
