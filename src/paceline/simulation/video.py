"""Videos of rendered pictures: H.264 with the time stamps that they are given."""

from __future__ import annotations

import os
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

TICKS_PER_SECOND = 90000  # per second, of a video's time stamps
TIME_BASE = Fraction(1, TICKS_PER_SECOND)
KEY_FRAME_INTERVAL_S = 2.0  # as cameras that stream have it


def write_h264(
    path: Path, pictures: Iterable[NDArray[np.uint8]], times: list[float], crf: int, streamed: bool = False
) -> None:
    """Writes ``pictures``, (H, W) grey or (H, W, 3) blue, green, red, as H.264 of the quality ``crf``, 0 (best) to 51,
    with their ``times`` (s) as time stamps, counted from the first. A ``streamed`` one has a key frame every
    `KEY_FRAME_INTERVAL_S` and no B frames, as those of surveillance cameras."""
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    rate = round(len(times) / max(times[-1] - times[0], 1e-3)) or 1
    options: dict[str, object] = {"crf": str(crf), "preset": "medium"}
    if streamed:
        options |= {"bf": "0", "g": str(max(1, round(KEY_FRAME_INTERVAL_S * rate)))}
    with av.open(str(partial), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.pix_fmt, stream.options = "yuv420p", options
        stream.time_base = stream.codec_context.time_base = TIME_BASE
        for k, (picture, time) in enumerate(zip(pictures, times, strict=True)):
            if k == 0:
                height, width = picture.shape[:2]
                stream.width, stream.height = width - width % 2, height - height % 2
            frame = av.VideoFrame.from_ndarray(picture, format="gray" if picture.ndim == 2 else "bgr24")
            frame.pts, frame.time_base = round((time - times[0]) * TICKS_PER_SECOND), TIME_BASE
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    os.replace(partial, path)
