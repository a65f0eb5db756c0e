"""ViSP's model-based trackers on the frames that Paceline sees: a C++ program, compiled where ViSP is installed."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from paceline.cameras import Camera
from paceline.targets.line_model import Target

SOURCE = Path(__file__).with_suffix(".cpp")


def compiled(folder: Path) -> Path | None:
    """The program, made in ``folder``; None where ViSP's headers, pkg-config or a compiler are missing."""
    if shutil.which("c++") is None or shutil.which("pkg-config") is None:
        return None
    flags = subprocess.run(["pkg-config", "--cflags", "--libs", "visp"], capture_output=True, text=True)
    if flags.returncode:
        return None
    program = folder / SOURCE.stem
    subprocess.run(["c++", "-O2", str(SOURCE), "-o", str(program), *flags.stdout.split()], check=True)
    return program


def cao(target: Target) -> str:
    """The target as a model of ViSP: its lines, and a face around them for keypoints, in the plane z = 0."""
    (left, top), (right, bottom) = target.corners.min(0), target.corners.max(0)
    around = [[left, top], [left, bottom], [right, bottom], [right, top]]  # counter-clockwise for the camera
    points = [f"{x:.6f} {y:.6f} 0" for x, y in [*target.corners.tolist(), *around]]
    lines = [f"{a} {b}" for a, b in target.segments.tolist()]
    n = len(target.corners)
    face = f"4 {n} {n + 1} {n + 2} {n + 3} name=rear"
    # points, lines, faces of lines, faces of points, cylinders, circles
    return "\n".join(["V1", str(len(points)), *points, str(len(lines)), *lines, "0", "1", face, "0", "0", ""])


@dataclass(frozen=True, eq=False)
class Step:
    """One frame's answer: whether ViSP tracked it, position (3,) in metres, projection error in degrees, CPU time."""

    tracked: bool
    position: NDArray[np.float64]
    projection_error: float
    seconds: float


class EdgeTracker:
    """The program at work; ``kind`` is "pose" or "position", ``start`` (3,) the target's first place in metres."""

    def __init__(self, program: Path, kind: str, camera: Camera, target: Target, start: NDArray[np.float64]) -> None:
        self._folder = TemporaryDirectory()
        model = Path(self._folder.name) / "target.cao"
        model.write_text(cao(target))
        K = camera.K
        numbers = (*camera.image_size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], *start)
        command = [str(program), str(model), kind, *(str(n) for n in numbers)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def track(self, image: NDArray[np.uint8]) -> Step:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(image.tobytes())
        self._process.stdin.flush()
        tracked, x, y, z, error, seconds = (float(word) for word in self._process.stdout.readline().split())
        return Step(bool(tracked), np.array([x, y, z]), error, seconds)
