"""The overlay video: both views side by side with outlines, particles, paths and speeds drawn over them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Indices, to_8_bit
from paceline.number_format import NO_VALUE
from paceline.progress import Progress, with_progress
from paceline.recordings.stereo import StereoFrame, StereoRecording
from paceline.reports.common.drawing import (
    DARK_BGR,
    WHITE_BGR,
    Box,
    Color,
    Picture,
    draw_dots,
    draw_label,
    draw_line,
    draw_outline,
    draw_text,
    scale_points,
)
from paceline.reports.common.formatting import format_compliance, format_measurement
from paceline.reports.common.plots import lane_color
from paceline.reports.common.video import VideoWriter, pad_to_even
from paceline.speed.choices import OverlayChoice
from paceline.speed.results import ClipResult, Measurement, Track

Grey = NDArray[np.uint8]  # (H, W)

MAX_OVERLAY_S = 60.0  # of a recording, up to which all of it is in the video unless stated otherwise
MAX_VIDEO_WIDTH_PX = 1920
VIEWS_HEADER_HEIGHT_PX = 40  # of the strip above the views

LOST_COLOR: Color = (190, 190, 190)
OUTSIDE_GREY_LEVEL = 96  # in stills, outside the image
PARTICLE_COLOR: Color = (90, 220, 250)

STILL_SIZE_PX = (400, 300)  # width and height
STILL_OUTLINE_WIDTHS = 2.2  # width of a still in widths of the outline
MIN_STILL_WIDTH_PX = 48.0  # in pixels of the recording
PARTICLE_RADIUS_PX = 9 / 16  # px
PARTICLE_OPACITY = 0.6


@dataclass(frozen=True)
class StereoStill:
    """One vehicle at one frame, cropped from both views, as JPEG."""

    frame: int
    time: float
    left: bytes
    right: bytes


def middle_still(stills: Sequence[StereoStill]) -> StereoStill:
    """The still in which a vehicle is recognised: neither the farthest one nor one at the image's edge."""
    return stills[len(stills) // 2]


def join_stills(stills: Sequence[StereoStill]) -> bytes:
    """All ``stills`` of a vehicle beside each other, the left view above the right one, as JPEG."""
    views = ([still.left for still in stills], [still.right for still in stills])
    return _encode_jpeg(np.vstack([np.hstack([_decode_jpeg(jpeg) for jpeg in view]) for view in views]))


@dataclass
class Overlay:
    """What `write_overlay` returns: stills by vehicle, whether there is a video, and notices about it."""

    stills: dict[str, list[StereoStill]]
    has_video: bool
    notices: list[str] = field(default_factory=list)


def write_overlay(
    result: ClipResult,
    recording: StereoRecording,
    file: Path,
    unit: str,
    colors: dict[str, str],
    choice: OverlayChoice,
    progress: Progress | None = None,
) -> Overlay:
    """Writes the overlay video in one pass over ``recording``, and returns a few stills of every vehicle.

    The video has the frames of this ``choice``; where these are none, no ``file`` is written, and only the frames of
    the stills are read. They keep the recording's presentation times, without the time of those that are left out.
    ``colors`` gives each vehicle's colour as ``#rrggbb``. A notice is given where no H.264 encoder is available and the
    video is MPEG-4 instead.
    """
    layers = [_Layer(m, _parse_color(colors[m.vehicle])) for m in result.measurements]
    recording = recording.with_lag(result.lag) if result.lag else recording
    if choice == "auto":
        choice = "all" if np.ptp(recording.times) <= MAX_OVERLAY_S else "none"
    times = _video_times(recording, _frames_in_video(recording, layers, choice))
    overlay = Overlay({layer.track.vehicle: [] for layer in layers}, has_video=bool(times))
    stills = [frame for layer in layers for frame in layer.track.frame[sorted(layer.still_rows)].tolist()]
    frames = np.intersect1d(recording.indices, [*times, *stills])
    with VideoWriter(file, _usual_step(recording.times)) if times else nullcontext() as video:
        for frame in with_progress(recording.selected(frames), len(frames), progress):
            views = to_8_bit(frame.left), to_8_bit(frame.right)
            for layer in layers:
                row = layer.rows.get(frame.index)
                if row is not None and row in layer.still_rows:
                    overlay.stills[layer.track.vehicle].append(_crop_still(views, layer, row, frame.time))
            if video is not None and frame.index in times:
                video.add(_draw(result, layers, frame, views, unit), times[frame.index])
    if video is not None:
        overlay.notices += video.notices
    return overlay


def _frames_in_video(recording: StereoRecording, layers: Sequence[_Layer], choice: OverlayChoice) -> Indices:
    """The indices (N,) of the frames of this ``choice``."""
    if choice == "all":
        return recording.indices
    rejected = [layer.track.frame for layer in layers if layer.rejected] if choice == "rejected" else []
    return np.intersect1d(recording.indices, np.concatenate([np.zeros(0, np.int64), *rejected]))


def _video_times(recording: StereoRecording, frames: Indices) -> dict[int, float]:
    """When (s) a video shows ``frames`` (N,): as they were taken, without the time of those that it leaves out."""
    places = np.searchsorted(recording.indices, frames)
    steps = np.where(np.diff(places) == 1, np.diff(recording.times[places]), _usual_step(recording.times))
    return dict(zip(frames.tolist(), np.cumsum([0.0, *steps]).tolist(), strict=False))


def _usual_step(times: Array) -> float:
    """The median (s) of the steps between frames at ``times`` (N,) s, 1 where it is not positive."""
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    return step if step > 0 else 1.0


class _Layer:
    """The drawing of one vehicle."""

    def __init__(self, measurement: Measurement, color: Color) -> None:
        self.measurement = measurement
        self.track: Track = measurement.track
        self.color = color
        self.rejected = measurement.verdict != "measured"
        self.rows = {int(frame): row for row, frame in enumerate(self.track.frame)}
        self.appearance = self.track.appearance
        rows = np.flatnonzero(self.track.counted).tolist()  # frames that show the vehicle
        self.still_rows = {rows[i] for i in (0, len(rows) // 2, -1)} if rows else set()

    def outline_color(self, row: int) -> Color:
        return self.color if self.appearance[row] == "tracking" else LOST_COLOR


def format_label(measurement: Measurement, status: str, unit: str) -> str:
    """The vehicle's speed, the same in every frame, and whether it keeps the limit; or, in a frame of another
    ``status`` than ``tracking``, that, such as ``hidden``."""
    if status != "tracking" or measurement.verdict != "measured":
        return f"{measurement.vehicle}  {status if status != 'tracking' else measurement.verdict}"
    text = f"{measurement.vehicle}  {format_measurement(measurement, unit)} {unit}"
    compliance = format_compliance(measurement.compliance, measurement.limit, unit)
    return text if compliance == NO_VALUE else f"{text}, {compliance}"


def _draw(result: ClipResult, layers: list[_Layer], frame: StereoFrame, views: tuple[Grey, Grey], unit: str) -> Picture:
    """One picture of the video: a strip with frame and time above the two views."""
    total = sum(view.shape[1] for view in views)
    scale = min(1.0, MAX_VIDEO_WIDTH_PX / total)
    panels = [_draw_view(result, layers, frame, view, side, scale, unit) for side, view in enumerate(views)]
    height, width = max(p.shape[0] for p in panels), sum(p.shape[1] for p in panels)
    canvas = np.zeros((VIEWS_HEADER_HEIGHT_PX + height, width, 3), np.uint8)
    canvas[:VIEWS_HEADER_HEIGHT_PX] = DARK_BGR
    x = 0
    for panel, name in zip(panels, ("left", "right"), strict=True):
        canvas[VIEWS_HEADER_HEIGHT_PX : VIEWS_HEADER_HEIGHT_PX + panel.shape[0], x : x + panel.shape[1]] = panel
        draw_text(canvas, name, (x + 14, 27), 17, (200, 190, 180))
        x += panel.shape[1]
    canvas[:, panels[0].shape[1] - 1 : panels[0].shape[1] + 1] = DARK_BGR
    note = "   repeated frame" if frame.duplicate else ""
    draw_text(canvas, f"frame {frame.index}   {frame.time:.3f} s{note}", (80, 27), 17, WHITE_BGR)
    return pad_to_even(canvas)


def _draw_view(
    result: ClipResult,
    layers: list[_Layer],
    frame: StereoFrame,
    view: Grey,
    side: int,
    scale: float,
    unit: str,
) -> Picture:
    size = max(2, round(view.shape[1] * scale)), max(2, round(view.shape[0] * scale))
    picture = _to_bgr(cv2.resize(view, size, interpolation=cv2.INTER_AREA) if scale < 1 else view)
    for i, path in enumerate(result.paths):
        _draw_path(picture, scale_points((path.left, path.right)[side], scale), _parse_color(lane_color(i)))
    labels: list[tuple[str, Array, Color]] = []
    for layer in layers:
        row = layer.rows.get(frame.index)
        if row is None or layer.track.status[row] == "ended":
            continue
        corners = scale_points((layer.track.left, layer.track.right)[side][row], scale)
        if not np.isfinite(corners).all():
            continue
        color = layer.outline_color(row)
        _draw_particles(
            picture, scale_points((layer.track.particles_left, layer.track.particles_right)[side][row], scale)
        )
        draw_outline(picture, corners, color, thickness=1 if layer.rejected else 2)
        labels.append((format_label(layer.measurement, layer.appearance[row], unit), corners, color))
    label_boxes: list[Box] = []
    for text, corners, color in labels:  # last, so that no outline crosses a label
        above = float(corners[:, 0].min() + corners[:, 0].max()) / 2, float(corners[:, 1].min())
        label_boxes.append(draw_label(picture, text, above, color, label_boxes))
    return picture


def _draw_path(picture: Picture, points: Array, color: Color) -> None:
    """A path as a thin line; parts that are not finite or far outside the picture are left out."""
    height, width = picture.shape[:2]
    near_image = (np.isfinite(points) & (points > -width - height) & (points < 2 * (width + height))).all(axis=1)
    for a, b, drawn in zip(points[:-1], points[1:], near_image[:-1] & near_image[1:], strict=True):
        if drawn:
            draw_line(picture, a, b, color)


def _draw_particles(picture: Picture, points: Array) -> None:
    clear = picture.copy()
    draw_dots(picture, points, PARTICLE_COLOR, PARTICLE_RADIUS_PX)
    cv2.addWeighted(picture, PARTICLE_OPACITY, clear, 1 - PARTICLE_OPACITY, 0, dst=picture)


def _crop_still(views: tuple[Grey, Grey], layer: _Layer, row: int, time: float) -> StereoStill:
    crops = [_crop(v, c[row], layer.color) for v, c in zip(views, (layer.track.left, layer.track.right), strict=True)]
    return StereoStill(int(layer.track.frame[row]), time, *crops)


def _crop(view: Grey, corners: Array, color: Color) -> bytes:
    """The surroundings of the outline ``corners`` (4, 2), enlarged to the size of a still, as JPEG."""
    width, height = STILL_SIZE_PX
    extent = np.ptp(corners, axis=0)
    scale = width / max(STILL_OUTLINE_WIDTHS * max(extent[0], extent[1] * width / height), MIN_STILL_WIDTH_PX)
    shift = np.array([width / 2, height / 2]) - scale * corners.mean(axis=0)
    transform = np.column_stack([np.eye(2) * scale, shift])
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    picture = _to_bgr(cv2.warpAffine(view, transform, STILL_SIZE_PX, flags=method, borderValue=OUTSIDE_GREY_LEVEL))
    draw_outline(picture, scale * corners + shift, color, thickness=2)
    return _encode_jpeg(picture)


def _decode_jpeg(jpeg: bytes) -> Picture:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def _encode_jpeg(picture: cv2.typing.MatLike) -> bytes:
    encoded, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert encoded
    return bytes(jpeg)


def _to_bgr(grey: cv2.typing.MatLike) -> Picture:
    """A copy to draw on in colour."""
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), np.uint8)


def _parse_color(color: str) -> Color:
    return int(color[5:7], 16), int(color[3:5], 16), int(color[1:3], 16)
