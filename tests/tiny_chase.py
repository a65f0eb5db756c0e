"""A tiny chase-camera recording with exact truth, drawn with OpenCV: a light van with dark glass on a grey road."""

from __future__ import annotations

from pathlib import Path

import av
import cv2
import numpy as np
import yaml

SIZE = (256, 242)
F, CX, CY = 300.0, 127.5, 120.5
NOMINAL = 10.0
FINE = 8  # edges lie on eighths of a pixel
CAMERA = {"image_size": list(SIZE), "K": [[F, 0.0, CX], [0.0, F, CY], [0.0, 0.0, 1.0]], "shutter": "global"}
BOXES = {  # left, top, right, bottom in metres, and grey level
    "body": (-1.0, -0.75, 1.0, 0.75, 190),
    "glass": (-0.72, -0.5, 0.72, 0.0, 40),
    "bumper": (-1.0, 0.45, 1.0, 0.75, 95),
}
TARGET = {
    "name": "small van",
    "nominal_range": NOMINAL,
    "corners": {
        "a": [-1.0, -0.75], "b": [1.0, -0.75], "c": [1.0, 0.75], "d": [-1.0, 0.75],
        "e": [-0.72, -0.5], "f": [0.72, -0.5], "g": [0.72, 0.0], "h": [-0.72, 0.0],
        "i": [-1.0, 0.45], "j": [1.0, 0.45],
    },
    "segments": [
        ["a", "b"], ["b", "c"], ["c", "d"], ["d", "a"], ["e", "f"], ["f", "g"], ["g", "h"], ["h", "e"], ["i", "j"],
    ],
}  # fmt: skip


def truth(frame: int, rate: float = 15.0) -> np.ndarray:
    """Position (3,) of the centre of the rear, camera axes, metres."""
    t = frame / rate
    return np.array([0.4 * np.sin(1.1 * t), 0.1 + 0.03 * np.sin(5.0 * t), 8.5 + 1.5 * np.sin(0.9 * t)])


def picture(frame: int, seed: int = 3) -> np.ndarray:
    """The image (H, W), uint8, of one frame, drawn by the share of each pixel that a box covers."""
    width, height = SIZE
    behind = np.where(np.arange(height) < 115, 150.0, 120.0)[:, None]  # the sky, and the road below it
    image = np.repeat(behind, width, axis=1)
    x, y, z = truth(frame)
    for left, top, right, bottom, grey in BOXES.values():
        across = covered(width, *(CX + 0.5 + F * (x + side) / z for side in (left, right)))
        down = covered(height, *(CY + 0.5 + F * (y + side) / z for side in (top, bottom)))
        image += down[:, None] * across * (grey - behind)
        behind = np.array(BOXES["body"][4])  # what comes after the body lies on it
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.6)
    image += np.random.default_rng([seed, frame]).normal(0, 1.5, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def covered(pixels: int, first: float, last: float) -> np.ndarray:
    """The share (N,) of each of ``pixels`` that lies between two places, which are rounded to 1/FINE of a pixel."""
    first, last = round(first * FINE) / FINE, round(last * FINE) / FINE
    edges = np.clip(np.arange(pixels + 1), first, last)
    return np.diff(edges)


def start(frame: int = 0) -> dict[str, object]:
    x, y, z = truth(frame)
    return {"frame": frame, "center": [float(CX + F * x / z), float(CY + F * y / z)], "scale": float(NOMINAL / z)}


def write(folder: Path, frames: int = 30) -> Path:
    """Writes the recording as a folder of images; returns its follow.yaml."""
    (folder / "frames").mkdir(parents=True)
    for k in range(frames):
        cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), picture(k))
    document = {"video": "frames", "rate": 15, "camera": "camera.yaml", "target": "target.yaml", "start": start()}
    for name, content in (("camera", CAMERA), ("target", TARGET), ("follow", document)):
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return folder / "follow.yaml"


def damaged(packet: av.Packet, stream: av.VideoStream) -> av.Packet:
    """The first third of a video's ``packet``, in its place."""
    part = av.Packet(bytes(packet)[: packet.size // 3])
    part.stream, part.pts, part.dts, part.time_base = stream, packet.pts, packet.dts, packet.time_base
    return part
