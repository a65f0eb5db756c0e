"""Renders the bundled chase clip again: python examples/make_chase_clip.py [DIRECTORY]

Twelve seconds behind a van on a winding road, with the shadows of trees and a lorry that crosses between.
"""

from __future__ import annotations

import shutil
import sys
from fractions import Fraction
from pathlib import Path

import av
import cv2
import yaml

import paceline

OUT = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "chase"
QUALITY = "20"  # of H.264; losses at 18 are hard to see

lorry = paceline.ChaseOcclusion(time=7.0, duration=0.7, kind="vehicle")
scene = paceline.random_chase_scene(11, frames=180, kind="van", occlusions=(lorry,))
follow = paceline.write_chase_clip(scene, OUT)
frames = OUT / "frames"
with av.open(str(OUT / "frames.mp4"), "w") as container:
    stream = container.add_stream("libx264", rate=Fraction(scene.rate).limit_denominator(1000))
    stream.width, stream.height = scene.image_size
    stream.pix_fmt = "yuv420p"
    stream.options = {"crf": QUALITY, "preset": "slow"}
    for file in sorted(frames.iterdir()):
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p")):
            container.mux(packet)
    for packet in stream.encode():
        container.mux(packet)
shutil.rmtree(frames)
document = yaml.safe_load(follow.read_text()) | {"video": "frames.mp4"}
del document["rate"]  # the video carries its own times
follow.write_text(yaml.safe_dump(document, sort_keys=False))
