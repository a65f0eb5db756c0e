"""The exception for input that cannot be used."""

from __future__ import annotations


class UnusableInput(ValueError):
    """Input that cannot be measured; its message is one plain line for the person who supplied it.

    The message names the file, the key or frame, and what was expected there. The command line prints it and ends
    with status 2.
    """

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))
