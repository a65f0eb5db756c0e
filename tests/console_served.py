"""A console as a person uses it: the real command on a free port, and a browser beside it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from chromium import CHROMIUM, Tab, browser
from run_command import COMMAND, ENVIRONMENT

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
CTRL, SHIFT = 2, 8
Console = tuple[Path, str, Callable[[], Tab]]  # the folder, the address, and what opens tabs


@contextmanager
def serving(
    folder: Path, *options: str, cwd: Path | None = None, before: list[str] | None = None
) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """`paceline console FOLDER` on a free port, after ``before``, and the address that it prints."""
    command = [*(before or []), *COMMAND, "console", str(folder), "--no-browser", "--port", "0", *options]
    streams: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=ENVIRONMENT, cwd=cwd or folder, **streams) as process:
        try:
            assert process.stdout is not None and process.stderr is not None
            line = process.stdout.readline()
            assert " is at http" in line, process.stderr.read()
            yield line.split(" is at ")[1].strip().rstrip("/"), process
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
                assert process.wait(60) == 0, process.stderr.read()
                assert "Traceback" not in (said := process.stderr.read()), said


@contextmanager
def consoled(base: Path, *before: str) -> Iterator[Console]:
    """A console of the folder ``base``/clips, and a browser."""
    for name in ("clips", "elsewhere"):
        (base / name).mkdir(exist_ok=True)
    at_once = serving(base / "clips", cwd=base / "elsewhere", before=list(before))
    with at_once as (address, _), browser(base / "profile") as new:
        yield base / "clips", address, new
    assert list((base / "elsewhere").iterdir()) == []


@contextmanager
def halted(clip: Path, far: Callable[[], bool]) -> Iterator[None]:
    """What measures ``clip`` stands still for a while once it is so ``far``; until then it goes in short steps."""
    wanted = f"{clip}/".encode()
    found = [p for p in Path("/proc").glob("[0-9]*/cmdline") if wanted in p.read_bytes() + b"/"]
    (pid,) = (int(p.parent.name) for p in found)
    os.kill(pid, signal.SIGSTOP)
    while not far():
        os.kill(pid, signal.SIGCONT)
        time.sleep(0.1)
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.2)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def on_screen(tab: Tab, view: int, point: list[float], editor: str = "pl-editor") -> tuple[float, float]:
    """Where a pixel of a picture is on the screen."""
    x, y = tab.run(
        f"(() => {{ const v = document.querySelector('{editor}').views[{view}];"
        f" const b = v.canvas.getBoundingClientRect(); const p = v.toScreen({json.dumps(point)});"
        " return [b.x + p[0], b.y + p[1]]; })()"
    )
    return x, y
