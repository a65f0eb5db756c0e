"""The overlay video: both views side by side with outlines, particles, paths and speeds drawn over them."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.recordings import StereoFrame, StereoRecording
from paceline.reports.wording import speed_at
from paceline.speed.results import Array, ClipResult, Measurement, Track
from paceline.units import format_speed

Picture = NDArray[np.uint8]  # (H, W, 3), BGR
Color = tuple[int, int, int]  # BGR
Box = tuple[int, int, int, int]  # left, top, right, bottom

MAX_WIDTH = 1920
HEADER = 40  # height of the strip above the pictures, pixels
CLOCK = 60000  # time stamps per second; MPEG-4 allows 65535
CODECS = ["libx264", "libopenh264"]  # both write H.264, which browsers play
FALLBACK = "mpeg4"
FONT = cv2.FontFace("sans")

PATH_COLOR: Color = (240, 226, 180)
LOST_COLOR: Color = (190, 190, 190)
DARK: Color = (36, 28, 22)
WHITE: Color = (255, 255, 255)
BEYOND_COLOR: Color = (96, 96, 96)  # in stills, outside the picture
PARTICLE_COLOR: Color = (90, 220, 250)
SUBPIXEL = 4  # fractional bits of the coordinates given to OpenCV

STILL = (400, 300)  # width and height, pixels
STILL_MARGIN = 2.2  # width of a still in widths of the outline
MIN_STILL_WIDTH = 48.0  # pixels of the recording
PARTICLE_RADIUS = 9  # sixteenths of a pixel
PARTICLE_OPACITY = 0.6
LABEL_SIZE, LABEL_WEIGHT = 16, 500


@dataclass(frozen=True)
class Still:
    """One vehicle at one frame, cropped from both views, as JPEG."""

    frame: int
    time: float
    left: bytes
    right: bytes


@dataclass
class Overlay:
    stills: dict[str, list[Still]]
    notices: list[str] = field(default_factory=list)


def write_overlay(
    result: ClipResult, recording: StereoRecording, file: Path, unit: str, colors: dict[str, str]
) -> Overlay:
    """Writes the overlay video in one pass over ``recording`` and returns a few stills of every vehicle.

    The frames keep the recording's presentation times. ``colors`` gives each vehicle's colour as ``#rrggbb``. A notice
    says so where no H.264 encoder is at hand and the video is MPEG-4 instead.
    """
    layers = [_Layer(m, _bgr(colors[m.vehicle])) for m in result.measurements]
    overlay = Overlay({layer.track.vehicle: [] for layer in layers})
    codec = next((name for name in CODECS if name in av.codecs_available), FALLBACK)
    if codec == FALLBACK:
        overlay.notices.append("overlay.mp4 is MPEG-4 because no H.264 encoder was found; a browser may not play it.")
    times = np.asarray(recording.times, float)
    step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    step = step if step > 0 else 1.0
    with av.open(str(file), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream: av.VideoStream | None = None
        start, last = 0.0, -1
        for frame in recording:
            views = _grey(frame.left), _grey(frame.right)
            for layer in layers:
                row = layer.rows.get(frame.index)
                if row is not None and row in layer.still_rows:
                    overlay.stills[layer.track.vehicle].append(_still(views, layer, row, frame.time))
            picture = _draw(result, layers, frame, views, unit)
            if stream is None:
                stream = _add_stream(container, codec, picture, step)
                start = frame.time
            image = av.VideoFrame.from_ndarray(picture, format="bgr24")
            last = max(round((frame.time - start) * CLOCK), last + 1)
            image.pts, image.time_base, image.duration = last, Fraction(1, CLOCK), round(step * CLOCK)
            container.mux(stream.encode(image))
        if stream is not None:
            container.mux(stream.encode())
    return overlay


def _add_stream(container: av.container.OutputContainer, codec: str, picture: Picture, step: float) -> av.VideoStream:
    options = {"preset": "veryfast", "crf": "20"} if codec == "libx264" else {}
    rate = Fraction(1 / step).limit_denominator(1000)
    stream = container.add_stream(codec, rate=rate or 1, options=options)
    assert isinstance(stream, av.VideoStream)
    stream.height, stream.width = picture.shape[:2]
    stream.pix_fmt = "yuv420p"
    stream.codec_context.time_base = Fraction(1, CLOCK)
    if codec != "libx264":
        stream.bit_rate = 8_000_000
    return stream


class _Layer:
    """What is drawn for one vehicle."""

    def __init__(self, measurement: Measurement, color: Color) -> None:
        self.track: Track = measurement.track
        self.color = color
        self.rejected = measurement.verdict != "measured"
        self.rows = {int(frame): row for row, frame in enumerate(self.track.frame)}
        seen = [row for row, status in enumerate(self.track.status) if status == "tracking"]
        self.still_rows = {seen[i] for i in (0, len(seen) // 2, -1)} if seen else set()

    def label(self, row: int, unit: str) -> str:
        if self.track.status[row] != "tracking":
            return f"{self.track.vehicle}  {self.track.status[row]}"
        speed, half = speed_at(self.track, row)
        text = f"{self.track.vehicle}  {format_speed(speed, half, unit)}"
        return text + "  (rejected)" if self.rejected else text

    def outline_color(self, row: int) -> Color:
        return self.color if self.track.status[row] == "tracking" else LOST_COLOR


def _draw(
    result: ClipResult, layers: list[_Layer], frame: StereoFrame, views: tuple[Picture, Picture], unit: str
) -> Picture:
    """One picture of the video: a strip with frame and time above the two views."""
    total = sum(view.shape[1] for view in views)
    scale = min(1.0, MAX_WIDTH / total)
    panels = [_draw_view(result, layers, frame, view, side, scale, unit) for side, view in enumerate(views)]
    height, width = max(p.shape[0] for p in panels), sum(p.shape[1] for p in panels)
    # Chroma is subsampled by two, so both sides are even.
    canvas = np.zeros((HEADER + height + height % 2, width + width % 2, 3), np.uint8)
    canvas[:HEADER] = DARK
    x = 0
    for panel, name in zip(panels, ("left", "right"), strict=True):
        canvas[HEADER : HEADER + panel.shape[0], x : x + panel.shape[1]] = panel
        _text(canvas, name, (x + 14, 27), 17, (200, 190, 180))
        x += panel.shape[1]
    canvas[:, panels[0].shape[1] - 1 : panels[0].shape[1] + 1] = DARK
    note = "   repeated picture" if frame.duplicate else ""
    _text(canvas, f"frame {frame.index}   {frame.time:.3f} s{note}", (80, 27), 17, WHITE)
    return canvas


def _draw_view(
    result: ClipResult,
    layers: list[_Layer],
    frame: StereoFrame,
    view: Picture,
    side: int,
    scale: float,
    unit: str,
) -> Picture:
    size = max(2, round(view.shape[1] * scale)), max(2, round(view.shape[0] * scale))
    picture = np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_AREA) if scale < 1 else view.copy(), np.uint8)
    for path in result.paths:
        _draw_path(picture, _scaled((path.left, path.right)[side], scale))
    labels: list[tuple[str, Array, Color]] = []
    for layer in layers:
        row = layer.rows.get(frame.index)
        if row is None or layer.track.status[row] == "ended":
            continue
        corners = _scaled((layer.track.left, layer.track.right)[side][row], scale)
        if not np.isfinite(corners).all():
            continue
        color = layer.outline_color(row)
        _draw_particles(picture, _scaled((layer.track.particles_left, layer.track.particles_right)[side][row], scale))
        _draw_outline(picture, corners, color, thickness=1 if layer.rejected else 2)
        labels.append((layer.label(row, unit), corners, color))
    taken: list[Box] = []
    for text, corners, color in labels:  # last, so that no outline crosses a label
        taken.append(_draw_label(picture, text, corners, color, taken))
    return picture


def _draw_path(picture: Picture, points: Array) -> None:
    """A path as a thin line; parts that are not finite or far outside the picture are left out."""
    height, width = picture.shape[:2]
    near = (np.isfinite(points) & (points > -width - height) & (points < 2 * (width + height))).all(axis=1)
    for a, b, drawn in zip(_fixed(points[:-1]), _fixed(points[1:]), near[:-1] & near[1:], strict=True):
        if drawn:
            cv2.line(picture, _pair(a), _pair(b), PATH_COLOR, 1, cv2.LINE_AA, SUBPIXEL)


def _draw_particles(picture: Picture, points: Array) -> None:
    clear = picture.copy()
    for point in _fixed(points[np.isfinite(points).all(axis=1)]):
        cv2.circle(picture, _pair(point), PARTICLE_RADIUS, PARTICLE_COLOR, cv2.FILLED, cv2.LINE_AA, SUBPIXEL)
    cv2.addWeighted(picture, PARTICLE_OPACITY, clear, 1 - PARTICLE_OPACITY, 0, dst=picture)


def _draw_outline(picture: Picture, corners: Array, color: Color, thickness: int) -> None:
    outline = [_fixed(corners)]
    cv2.polylines(picture, outline, True, DARK, thickness + 2, cv2.LINE_AA, SUBPIXEL)
    cv2.polylines(picture, outline, True, color, thickness, cv2.LINE_AA, SUBPIXEL)


def _draw_label(picture: Picture, text: str, corners: Array, color: Color, taken: list[Box]) -> Box:
    """Writes ``text`` above the outline, inside the picture and clear of the labels in ``taken``; returns its box."""
    height, width = picture.shape[:2]
    w = int(cv2.getTextSize((0, 0), text, (0, 0), FONT, LABEL_SIZE, LABEL_WEIGHT)[2]) + 18
    h = LABEL_SIZE + 10
    x = int(np.clip((corners[:, 0].min() + corners[:, 0].max() - w) / 2, 2, max(2, width - w - 2)))
    y = int(np.clip(corners[:, 1].min() - h - 10, 2, max(2, height - h - 2)))
    while any(x < r and left < x + w and y < b and top < y + h for left, top, r, b in taken) and y > h:
        y -= h + 4
    cv2.rectangle(picture, (x, y), (x + w, y + h), DARK, cv2.FILLED)
    cv2.rectangle(picture, (x, y), (x + 4, y + h), color, cv2.FILLED)
    _text(picture, text, (x + 11, y + h - 8), LABEL_SIZE, WHITE, LABEL_WEIGHT)
    return x, y, x + w, y + h


def _still(views: tuple[Picture, Picture], layer: _Layer, row: int, time: float) -> Still:
    crops = [_crop(v, c[row], layer.color) for v, c in zip(views, (layer.track.left, layer.track.right), strict=True)]
    return Still(int(layer.track.frame[row]), time, *crops)


def _crop(view: Picture, corners: Array, color: Color) -> bytes:
    """The surroundings of the outline ``corners`` (4, 2), enlarged to the size of a still, as JPEG."""
    width, height = STILL
    extent = np.ptp(corners, axis=0)
    scale = width / max(STILL_MARGIN * max(extent[0], extent[1] * width / height), MIN_STILL_WIDTH)
    shift = np.array([width / 2, height / 2]) - scale * corners.mean(axis=0)
    transform = np.column_stack([np.eye(2) * scale, shift])
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    picture = np.asarray(cv2.warpAffine(view, transform, STILL, flags=method, borderValue=BEYOND_COLOR), np.uint8)
    _draw_outline(picture, scale * corners + shift, color, thickness=2)
    done, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    assert done
    return bytes(jpeg)


def _text(picture: Picture, text: str, at: tuple[int, int], size: int, color: Color, weight: int = 400) -> None:
    cv2.putText(picture, text, at, color, FONT, size, weight)


def _grey(image: NDArray[np.float32]) -> Picture:
    """``image`` (H, W), 0..255, as a grey picture to draw on in colour."""
    return np.asarray(cv2.cvtColor(np.clip(np.rint(image), 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR), np.uint8)


def _scaled(points: Array, scale: float) -> Array:
    """Pixels of the scaled picture; the pixels' edges, not their centres, keep their place at zero."""
    return (points + 0.5) * scale - 0.5


def _fixed(points: Array) -> NDArray[np.int32]:
    """``points`` in OpenCV's fixed-point coordinates; what is not finite becomes 0 and is left to the caller."""
    limited = np.clip(np.nan_to_num(points, posinf=0, neginf=0), -1e5, 1e5)
    return np.asarray(np.rint(limited * (1 << SUBPIXEL)), np.int32)


def _pair(point: NDArray[np.int32]) -> tuple[int, int]:
    return int(point[0]), int(point[1])


def _bgr(color: str) -> Color:
    return int(color[5:7], 16), int(color[3:5], 16), int(color[1:3], 16)
