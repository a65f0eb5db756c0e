"""The command line program ``paceline``: its global options, and its commands from `paceline.commands`."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
import warnings
from typing import Annotated

import typer

from paceline.commands.calibrate import calibrate
from paceline.commands.compare import compare
from paceline.commands.console import console
from paceline.commands.drive import drive
from paceline.commands.follow import follow_vehicle
from paceline.commands.lanes import lanes
from paceline.commands.process import ReceivedSignals, StandardOutput, is_out_of_memory
from paceline.commands.renamed_options import accepting
from paceline.commands.rig import rig
from paceline.commands.simulate import simulate
from paceline.commands.speed import OLD_OPTIONS, speed
from paceline.commands.target import target
from paceline.commands.vehicles import vehicles
from paceline.commands.warm_up import warm_up
from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_INTERRUPTED, EXIT_UNUSABLE_INPUT

CALLBACK_DELAY_S = 0.05  # time after which an interrupt inside a callback comes again

app = typer.Typer(
    name="paceline",
    help="Measures how fast vehicles move, with ordinary cameras.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command(cls=accepting(OLD_OPTIONS))(speed)
app.command()(compare)
app.command("follow")(follow_vehicle)
app.command()(calibrate)
app.command(cls=accepting({"--write": "--in-place"}))(lanes)
app.command(cls=accepting({"--write": "--in-place"}))(vehicles)
app.add_typer(rig, name="rig")
app.add_typer(target, name="target")
app.add_typer(simulate, name="simulate")
app.command()(drive)
app.command()(console)
app.command()(warm_up)


def main() -> None:
    """Runs the command line and exits with its status; every error is one plain line on standard error."""
    signals = ReceivedSignals()
    output = StandardOutput()
    sys.unraisablehook = _end_after_callback
    warnings.formatwarning = lambda message, *_: f"paceline: {message}\n"  # one plain line
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads, for matrices this small, only stand in the way
    try:
        with output:
            status = app(prog_name="paceline", standalone_mode=False)
    except UnusableInput as error:
        print(f"paceline: {error}", file=sys.stderr)
        status = EXIT_UNUSABLE_INPUT
    except typer.TyperException as error:  # a wrong option or argument
        text = " ".join(error.format_message().split()).replace("Value error, ", "").rstrip(".")
        print(f"paceline: {text}; see paceline --help", file=sys.stderr)
        status = EXIT_UNUSABLE_INPUT
    except Exception as error:
        if signals.status is not None:  # compiled code that calls Python raises errors of its own for an interrupt
            status = signals.status
        elif is_out_of_memory(error):
            print("paceline: there is not enough memory; expected more, or a shorter recording", file=sys.stderr)
            status = EXIT_UNUSABLE_INPUT
        else:
            raise
    signals.ignore()  # what there is to write is written
    if status == EXIT_INTERRUPTED:  # how Typer answers Ctrl-C
        print("paceline: interrupted", file=sys.stderr)
        # where Ctrl-C came inside an exec of a string, as dataclasses are made by, ``python -m`` would be ended by the
        # signal itself, with another status; the next exec clears that
        exec("")
    if output.problem is not None:
        print(f"paceline: {output.problem}", file=sys.stderr)
    sys.exit(status)


def _end_after_callback(unraisable: sys.UnraisableHookArgs) -> None:
    """A Ctrl-C or a termination that came inside a callback, as of LLVM while Numba compiles, where nothing can be
    raised, comes again after it; other exceptions are reported as usual."""
    numbers = {KeyboardInterrupt: signal.SIGINT, SystemExit: signal.SIGTERM}
    if unraisable.exc_type in numbers:
        again = threading.Timer(CALLBACK_DELAY_S, _thread.interrupt_main, [numbers[unraisable.exc_type]])
        again.daemon = True
        again.start()
    else:
        sys.__unraisablehook__(unraisable)


def _show_version(requested: bool) -> None:
    if requested:
        from paceline.version import __version__

        print(f"paceline {__version__}")
        raise typer.Exit


@app.callback()
def paceline(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Measures how fast vehicles move, with ordinary cameras."""
