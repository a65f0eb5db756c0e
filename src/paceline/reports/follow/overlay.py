"""The overlay video of a run: model lines, window, accepted edge points, range and status over the camera's view."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.follow.results import FollowEstimate
from paceline.number_format import NO_VALUE, format_number, format_uncertain
from paceline.recordings.monocular import CameraFrame
from paceline.reports.common.drawing import (
    DARK_BGR,
    WHITE_BGR,
    Color,
    Picture,
    draw_dots,
    draw_label,
    draw_line,
    draw_text,
    scale_points,
)
from paceline.reports.common.video import pad_to_even
from paceline.units import COVERAGE_95

VIDEO_WIDTHS_PX = (768, 1920)  # of the video: small images are magnified, large ones reduced
HEADER_HEIGHT_PX = 40  # of the strip above the image
STATUS_COLORS: dict[str, Color] = {"tracking": (80, 220, 120), "coasting": (40, 170, 255), "lost": (190, 190, 190)}
POINT_COLOR: Color = (250, 220, 90)
WINDOW_COLOR: Color = (150, 130, 120)
MAX_EDGE_POINTS = 400  # drawn

STILL_SIZE_PX = (400, 300)  # width and height
STILL_TARGET_WIDTHS = 1.8  # width of a still in widths of the target
MAX_SPREAD_STILLS = 6
MAX_LOSS_STILLS = 2


@dataclass(frozen=True)
class TargetStill:
    """The target at one frame, as JPEG."""

    frame: int
    time: float
    caption: str
    jpeg: bytes


def draw_frame(frame: CameraFrame, image: NDArray[np.uint8], e: FollowEstimate) -> Picture:
    """One picture of the video: a strip with time, range and status above ``image`` (H, W) with what was found."""
    width = image.shape[1]
    scale = min(max(1, int(np.ceil(VIDEO_WIDTHS_PX[0] / width))), VIDEO_WIDTHS_PX[1] / width)
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    grey = image if scale == 1 else cv2.resize(image, None, fx=scale, fy=scale, interpolation=method)
    view = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    draw_estimate(view, e, scale)
    canvas = np.empty((HEADER_HEIGHT_PX + view.shape[0], view.shape[1], 3), np.uint8)
    canvas[:HEADER_HEIGHT_PX] = DARK_BGR
    canvas[HEADER_HEIGHT_PX:] = view
    note = "   no image" if frame.image is None else ""
    draw_text(canvas, f"frame {frame.index}   {frame.time:.3f} s{note}", (14, 27), 17, WHITE_BGR)
    draw_text(
        canvas, format_status(e), (min(300, view.shape[1] // 3), 27), 17, STATUS_COLORS.get(e.status, WHITE_BGR), 500
    )
    return pad_to_even(canvas)


def format_status(e: FollowEstimate) -> str:
    """The status and, unless tracking, the reason."""
    return f"{e.status}: {e.reason}" if e.reason else e.status


def format_range(e: FollowEstimate) -> str:
    """For example ``10.583 ± 0.052 m``, half of a 95 % interval; predicted values are marked."""
    distance, half = float(e.position[2]), COVERAGE_95 * float(e.position_std[2])
    if not np.isfinite(distance):
        return NO_VALUE
    if e.status != "tracking":
        return f"about {format_number(distance, 1)} m, not measured"
    return f"{format_uncertain(distance, half)} m"


def draw_estimate(view: Picture, e: FollowEstimate, scale: float, shift: Array | None = None) -> None:
    """Draws onto a ``view`` magnified by ``scale`` and then moved by ``shift`` (2,) pixels."""
    moved = np.zeros(2) if shift is None else shift
    color = STATUS_COLORS.get(e.status, WHITE_BGR)
    x0, y0, x1, y1 = e.window
    corners = scale_points(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]], float), scale) + moved
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        draw_line(view, a, b, WINDOW_COLOR)
    lines = scale_points(np.asarray(e.lines, float), scale) + moved
    for a, b in lines:  # thinner than a pixel of the recording, so that the edge stays visible
        draw_line(view, a, b, color, 2 if scale > 2 else 1)
    points = np.asarray(e.points, float)[:: len(e.points) // MAX_EDGE_POINTS + 1]
    draw_dots(view, scale_points(points, scale) + moved, POINT_COLOR, 0.3 * max(scale, 2))
    known = lines[np.isfinite(lines).all(axis=(1, 2))]
    if len(known) and e.status != "lost":
        top = known.reshape(-1, 2)
        draw_label(view, format_range(e), (float(top[:, 0].mean()), float(top[:, 1].min())), color)


@dataclass
class StillSelection:
    """Selects stills of a run of unknown length: some spread evenly (every second one is dropped when there are too
    many), and the first frames in which tracking was lost."""

    evenly_spread: list[TargetStill] = field(default_factory=list)
    losses: list[TargetStill] = field(default_factory=list)
    stride: int = 1
    count: int = 0
    tracked: bool = False  # in the frame before

    @property
    def selected(self) -> list[TargetStill]:
        return sorted(
            {still.frame: still for still in self.evenly_spread + self.losses}.values(), key=lambda s: s.frame
        )

    def add(self, image: NDArray[np.uint8] | None, e: FollowEstimate) -> None:
        left, self.tracked = self.tracked and e.status != "tracking", e.status == "tracking"
        if image is None or not np.isfinite(e.lines).all() or e.status == "lost":
            return
        if left and len(self.losses) < MAX_LOSS_STILLS:
            self.losses.append(_crop_still(image, e))
        if self.count % self.stride == 0:
            if len(self.evenly_spread) == MAX_SPREAD_STILLS:
                self.evenly_spread = self.evenly_spread[::2]
                self.stride *= 2
            if self.count % self.stride == 0:
                self.evenly_spread.append(_crop_still(image, e))
        self.count += 1


def _crop_still(image: NDArray[np.uint8], e: FollowEstimate) -> TargetStill:
    """The surroundings of the target, magnified to the size of a still."""
    width, height = STILL_SIZE_PX
    points = e.lines.reshape(-1, 2)
    extent = np.ptp(points, axis=0)
    scale = width / (STILL_TARGET_WIDTHS * max(extent[0], extent[1] * width / height, 1.0))
    shift = np.array([width / 2, height / 2]) - scale_points(points.mean(axis=0), scale)
    to_still = np.column_stack([np.eye(2) * scale, shift + 0.5 * scale - 0.5])
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    grey = cv2.warpAffine(image, to_still, STILL_SIZE_PX, flags=method, borderMode=cv2.BORDER_REPLICATE)
    view = np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)
    draw_estimate(view, e, scale, shift)
    done, jpeg = cv2.imencode(".jpg", view, [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert done
    return TargetStill(e.frame, e.time, format_status(e), bytes(jpeg))
