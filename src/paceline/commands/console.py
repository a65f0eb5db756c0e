"""``paceline console``: runs the web server in which clips are edited, measured and viewed."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE


def console(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="The folder that holds the clips.")] = Path("."),
    host: Annotated[
        str, typer.Option(help="Address to listen on; others than this machine's own require the printed token.")
    ] = "127.0.0.1",
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port; the first free one from 8640 on.")] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open a browser window.")] = True,
) -> int:
    """Set up, run and view measurements in the browser."""
    if importlib.util.find_spec("nicegui") is None:
        raise UnusableInput("the console needs NiceGUI; install it with: pip install 'paceline[console]'")

    from paceline.console.server import serve

    serve(folder, host, port, browser, lambda text: print(text, flush=True))
    return EXIT_DONE
