"""How far a command is."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from paceline.console.telling import TOLD, telling


@contextmanager
def progress_bar(doing: str, show: bool) -> Iterator[Callable[[int, int | None], None] | None]:
    """A progress bar on standard error, moved on by calls with (frames done, frames in all if that is known).

    A program that started the command may ask for lines instead; once it reads them no more, the command ends.
    """
    if os.environ.get(TOLD) == "lines":
        yield lambda done, total: print(telling(doing, done, total), file=sys.stderr, flush=True)
        return
    if not show:
        yield None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.1f} frames/s" if task.speed else "")

    columns = [TextColumn(doing), BarColumn(), MofNCompleteColumn(), TextColumn("frames"), Rate()]
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
