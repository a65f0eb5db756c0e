"""Handling of Ctrl-C while a live source is read."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def ended_by_interrupt(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C calls ``stop``, so that what was seen until then is reported; the second one interrupts."""

    def end(number: int, frame: FrameType | None) -> None:
        stop()
        signal.signal(number, previous)

    previous = signal.signal(signal.SIGINT, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)
