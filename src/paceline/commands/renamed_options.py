"""Options that have been renamed: the old spelling is still accepted, but ``--help`` shows the new one only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from typer.core import TyperCommand


def accepting(new_names: Mapping[str, str]) -> type[TyperCommand]:
    """A class of commands that accept the old options that are the keys of ``new_names``, as ``--old`` or
    ``--old=VALUE``."""

    class CommandWithOldOptions(TyperCommand):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            end = args.index("--") if "--" in args else len(args)
            return super().parse_args(ctx, [*map(renamed, args[:end]), *args[end:]])

    def renamed(argument: str) -> str:
        option, equals, value = argument.partition("=")
        return f"{new_names.get(option, option)}{equals}{value}"

    return CommandWithOldOptions
