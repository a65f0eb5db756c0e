from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # when NumPy is imported; see `paceline.blas`, also for why

import cv2
import numpy as np
import pytest
from hypothesis import settings

from paceline.cameras import Camera, StereoRig

if TYPE_CHECKING:
    from fastapi.testclient import TestClient


# Every run tries the same examples, so that what fails is what was changed; `make test-all` looks for new ones.
settings.register_profile("same examples", derandomize=True, deadline=None)
settings.load_profile("same examples")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell leaves it to what it starts in the background
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """Says on the line before the last how long `.ci/run` has taken."""
    yield
    if begun := os.environ.get("CI_BEGUN"):
        minutes, seconds = divmod(round(time.time()) - int(begun), 60)
        terminalreporter.write_line(f"Wall time of .ci/run: {minutes} min {seconds} s")


@pytest.fixture(scope="session")
def rig() -> StereoRig:
    """Half a metre of baseline and 2200 px of focal length, out of true in every respect."""
    left = Camera((1024, 768), np.array([[2200.0, 0, 511.5], [0, 2210, 383.5], [0, 0, 1]]))
    right = Camera((1024, 768), np.array([[2150.0, 0, 505.0], [0, 2145, 390.0], [0, 0, 1]]))
    return StereoRig(left, right, cv2.Rodrigues(np.array([0.004, -0.02, 0.006]))[0], np.array([-0.5, 0.02, -0.03]))


@pytest.fixture(scope="session")
def small_clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The clip.yaml of one vehicle at 12 m/s in seven small pictures: measured in a second, by any method."""
    from paceline.simulation.stereo.clip import Scene, Vehicle, render, write

    vehicle = Vehicle("v0", speed=12.0, start_distance=32.0)
    scene = Scene(seed=5, vehicles=(vehicle,), image_size=(480, 360), focal=1000.0, frames=7, rate=5.0)
    return write(render(scene), tmp_path_factory.mktemp("small"))


@pytest.fixture
def signals_as_before() -> Iterator[None]:
    """Ctrl-C and termination are answered after the test as before it."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def unrendered_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots are drawn on their figures, but the files have no content: rendering takes half a measurement's time."""
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", leave_out)


def leave_out(figure: object, file: IO[Any], *, format: str, **_: object) -> None:
    """In place of what renders a ``figure`` into a ``file``."""
    file.write("<svg></svg>" if format == "svg" else b"")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The console's folder, with one clip, beside another folder that it must not see."""
    from console_client import put_folder

    return put_folder(tmp_path_factory.mktemp("safety").resolve())


@pytest.fixture(scope="module")
def client(folder: Path) -> Iterator[TestClient]:
    """What asks the console of that folder."""
    from console_client import open_client

    with open_client(folder) as client:
        yield client
