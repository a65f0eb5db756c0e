"""``paceline warm-up``: compiles what the other commands need, so that their first run does not have to."""

from __future__ import annotations

import sys
import tempfile
from typing import Annotated

import typer

from paceline.commands.progress_output import progress_bar
from paceline.exit_status import EXIT_DONE
from paceline.progress import COMPILING_ACTIVITY


def warm_up(
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> int:
    """Compile what speed, vehicles and follow need, and keep it: otherwise the first run does that."""
    from paceline.numba_cache import compilations

    if not quiet:
        print("compiling what speed, vehicles and follow need; it takes up to a minute", flush=True)
    with compilations() as compiled, progress_bar(COMPILING_ACTIVITY, sys.stderr.isatty() and not quiet):
        _measure_simulated()
    if not quiet:
        what = f"{compiled.count} functions compiled" if compiled.count else "nothing to compile"
        print(f"{what}: they start without from now on")
    return EXIT_DONE


def _measure_simulated() -> None:
    """Finds and measures a simulated vehicle, on and off its path, and follows another one."""
    import numpy as np

    from paceline.detection.search import find_vehicles
    from paceline.documents.loading import load_clip
    from paceline.follow.tracker import warm_up as warm_up_following
    from paceline.path_following.pure_pursuit import goal_point, to_camera
    from paceline.recordings.odometry import Pose
    from paceline.recordings.stereo import open_recording
    from paceline.simulation.stereo.clip import Scene, Vehicle, render, write
    from paceline.speed.configuration import SpeedConfiguration
    from paceline.survey.recording import measure_clip

    vehicle = Vehicle("v0", speed=20.0, start_distance=60.0)
    scene = Scene(seed=5, vehicles=(vehicle,), image_size=(640, 480), focal=1400.0, frames=10)
    with tempfile.TemporaryDirectory() as folder:
        clip = load_clip(write(render(scene), folder, states_cameras=False))
        find_vehicles(clip, open_recording(clip))
        for motion in ("auto", "free"):
            measure_clip(clip, SpeedConfiguration(motion=motion))
    warm_up_following()
    goal_point(to_camera(Pose(0.0, 0.0, 0.0), np.array([[1.0, 0.0], [2.0, 0.0]])), 1.5)  # of a path, by odometry
