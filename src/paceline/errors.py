"""The exception for input that cannot be used, and which files cannot be it."""

from __future__ import annotations

import stat
from pathlib import Path


class UnusableInput(ValueError):
    """Input that cannot be measured; its message is one plain line for the person who supplied it.

    The message names the file, the key or frame, and what was expected there. The command line prints it and ends
    with status 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))


def refuse_pipe_or_device(path: Path) -> None:
    """Raises UnusableInput where ``path`` is a pipe, a socket or a device: reading it may have no end.

    What cannot be looked at passes: reading it says why.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UnusableInput(f"{path}: is a pipe, a socket or a device; expected a file")
