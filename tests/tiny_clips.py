"""A small clip for the console: a car 40 m away, five frames, drawn as a person would."""

from __future__ import annotations

import shutil
from functools import lru_cache
from pathlib import Path

from paceline.simulation.stereo.clip import RenderedClip, Scene, Vehicle, render, write

CAR = Vehicle("v0", 18.0, start_distance=40.0)
SCENE = Scene(31, (CAR,), image_size=(640, 480), focal=1400.0, frames=5)


@lru_cache
def rendered() -> RenderedClip:
    return render(SCENE)


def put_clip(root: Path, name: str = "road") -> Path:
    """A clip of this ``name`` below ``root``; returns its folder."""
    write(rendered(), root / name)
    (root / name / "truth.json").unlink()
    return root / name


def copy_of(clip: Path, name: str) -> Path:
    return Path(shutil.copytree(clip, clip.parent / name))
