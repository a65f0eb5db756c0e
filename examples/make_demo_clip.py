"""Makes the bundled demo clip, examples/straight: two cars that approach on a straight road, at 45 and 38 mph.

python examples/make_demo_clip.py [DIRECTORY]
"""

from __future__ import annotations

import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import yaml
from numpy.typing import NDArray

import paceline

MILE_PER_HOUR = 0.44704
TIME_BASE = Fraction(1, 1000)

SCENE = paceline.StereoScene(
    seed=3,
    vehicles=(
        paceline.StereoVehicle("v0", 45 * MILE_PER_HOUR, start_distance=76.0, lane=-1.85, texture_seed=6, relief=0.03),
        paceline.StereoVehicle("v1", 38 * MILE_PER_HOUR, start_distance=64.0, lane=1.85, texture_seed=7, relief=0.03),
    ),
    camera_height=2.6,
    tilt=0.025,
    road_direction=0.015,
    road_depth=40.0,
    noise_sigma=0.8,
    gain_drift=0.02,
    frames=14,
)

# What a careful calibration of such a rig with a large board reaches.
UNCERTAINTY = {
    "focal_length_px": 1.0,
    "principal_point_px": 0.05,
    "rotation_rad": [2e-5, 2e-5, 2e-5],
    "translation_m": [2e-4, 1e-4, 1e-4],
}


def write_video(path: Path, images: list[NDArray[np.uint8]], times: NDArray[np.float64], rate: float) -> None:
    """Encode grey ``images`` (H, W) shown at ``times`` in seconds."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = "yuv420p"
        stream.time_base = TIME_BASE
        stream.options = {"crf": "16", "preset": "slow", "bf": "0"}
        for image, time in zip(images, times, strict=True):
            frame = av.VideoFrame.from_ndarray(image, format="gray")
            frame.pts, frame.time_base = round(time / TIME_BASE), TIME_BASE
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def main(directory: Path) -> None:
    rendered = paceline.render_stereo_clip(SCENE)
    directory.mkdir(parents=True, exist_ok=True)
    write_video(directory / "left.mp4", rendered.left, rendered.times, SCENE.rate)
    write_video(directory / "right.mp4", rendered.right, rendered.right_times, SCENE.rate)
    paceline.write_stereo_documents(rendered, directory)
    rig = yaml.safe_load((directory / "rig.yaml").read_text())
    (directory / "rig.yaml").write_text(yaml.safe_dump({**rig, "uncertainty": UNCERTAINTY}, sort_keys=False))
    clip = {**rendered.clip, "left": "left.mp4", "right": "right.mp4"}
    del clip["rate"]  # a video brings its own time stamps
    (directory / "clip.yaml").write_text(yaml.safe_dump(clip, sort_keys=False))


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "straight")
