"""What a rolling shutter does to the images of a camera that vibrates on its vehicle: rows are exposed one after
another while the camera turns."""

from __future__ import annotations

from math import hypot

from paceline.cameras import Camera, Quantity

TURN_RATE = 0.3  # rad/s RMS: vibration of 3e-3 rad at 15 Hz, between wheels on their springs and an engine at idle
UNSTATED = Quantity(0.0, 0.015, "assumed")  # s, of a readout: most of ordinary cameras' are below 0.03 s


def stretch_deviation(camera: Camera) -> float:
    """Relative standard deviation by which heights are stretched, in each image anew."""
    return _shift(camera) / (camera.image_size[1] - 1)


def displacement_deviation(camera: Camera, row: float) -> float:
    """Standard deviation, px and in either direction, of what a ``row`` shows from where it is at the frame's time."""
    return _shift(camera) * abs(row / (camera.image_size[1] - 1) - 0.5)


def _shift(camera: Camera) -> float:
    """By how many px an image moves from the first row's exposure to the last one's, RMS."""
    readout = camera.readout or UNSTATED
    return TURN_RATE * float(camera.K[1, 1]) * hypot(readout.value, readout.std)
