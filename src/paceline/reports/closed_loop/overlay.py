"""The video of a drive: the follower's overlay, with gauges for speed, gap, steering and pedals below."""

from __future__ import annotations

import cv2
import numpy as np

from paceline.number_format import format_number
from paceline.recordings.monocular import CameraFrame
from paceline.reports.common.drawing import DARK_BGR, WHITE_BGR, Color, Picture, draw_text
from paceline.reports.common.video import pad_to_even
from paceline.reports.follow.overlay import draw_frame
from paceline.simulation.closed_loop.loop import LoopStep
from paceline.simulation.closed_loop.vehicle_dynamics import VehicleParameters

PANEL_HEIGHT_PX = 64  # height of the strip below the image
COMMAND_COLOR: Color = (60, 160, 235)
WHEEL_COLOR: Color = (80, 220, 120)
BRAKE_COLOR: Color = (70, 70, 235)
BAR_FRAME_COLOR: Color = (110, 100, 90)
FULL_PEDAL_MPS2 = 4.0  # acceleration that fills a pedal bar


def draw_step(step: LoopStep, vehicle: VehicleParameters) -> Picture:
    """One picture of the video (H, W, 3), BGR."""
    view = draw_frame(CameraFrame(step.frame, step.time, step.image), step.image, step.estimate)
    panel: Picture = np.full((PANEL_HEIGHT_PX, view.shape[1], 3), DARK_BGR, np.uint8)
    texts = (
        f"{format_number(3.6 * step.chase.speed, 1)} km/h",
        f"gap {format_number(step.gap, 1)} of {format_number(step.desired_gap, 1)} m"
        if step.lead_present
        else "lead not visible",
        f"path {format_number(step.path_error, 2)} m",
    )
    for text, x in zip(texts, (14, 160, 390), strict=True):
        draw_text(panel, text, (x, 26), 17, WHITE_BGR)
    _draw_bar(panel, (14, 40), 340, step.command.steering / vehicle.steering_limit, COMMAND_COLOR, "steering command")
    _draw_bar(panel, (14, 52), 340, step.chase.steering / vehicle.steering_limit, WHEEL_COLOR, "wheels")
    pedal = step.chase.acceleration / FULL_PEDAL_MPS2
    _draw_bar(panel, (500, 46), 150, pedal, WHEEL_COLOR if pedal >= 0 else BRAKE_COLOR, "brake, throttle")
    return pad_to_even(np.vstack([view, panel]))


def _draw_bar(panel: Picture, position: tuple[int, int], width: int, value: float, color: Color, name: str) -> None:
    """A bar from the middle of a scale from −1 to 1."""
    x, y = position
    middle, end = x + width // 2, x + width // 2 + round(float(np.clip(value, -1, 1)) * width / 2)
    cv2.rectangle(panel, (x, y), (x + width, y + 7), BAR_FRAME_COLOR, 1)
    cv2.rectangle(panel, (min(middle, end), y), (max(middle, end), y + 7), color, cv2.FILLED)
    draw_text(panel, name, (x + width + 8, y + 8), 12, WHITE_BGR)
