"""Numba kernels that draw the images of a chase camera: the ground, and textured rectangles over it.

Edges of rectangles are anti-aliased exactly (by the part of a pixel's square that lies inside), so their position is
exact to a few thousandths of a pixel. Pixel centres have integer coordinates.
"""

from __future__ import annotations

import math

from paceline.arrays import Array, Image, Indices
from paceline.numba_cache import cached_njit

SHADE_CELL_M = 0.05  # m, a texel of a shade map
MIN_PAINTED_SLOPE = 0.004  # slope below the horizon from which on the ground is painted
CHASE_SHOULDER_WIDTH_M = 0.45  # m of asphalt beside the lanes


@cached_njit(fastmath=True)
def sample_periodic(table: Image, y: float, x: float) -> float:
    """``table``, which repeats in both directions and whose sides are powers of two, at a place between its cells."""
    rows, columns = table.shape[0] - 1, table.shape[1] - 1
    j, i = math.floor(y), math.floor(x)
    b, a = y - j, x - i
    j0, i0 = int(j) & rows, int(i) & columns
    j1, i1 = (j0 + 1) & rows, (i0 + 1) & columns
    upper = table[j0, i0] * (1 - a) + table[j0, i1] * a
    lower = table[j1, i0] * (1 - a) + table[j1, i1] * a
    return float(upper * (1 - b) + lower * b)


@cached_njit(fastmath=True)
def _sample_shade(shade: Image, arc: float, lateral: float, scale: float) -> float:
    """The light, 0–1, at road coordinates in metres, from a map with ``scale`` texels a metre."""
    return sample_periodic(shade, arc * scale - 0.5, lateral * scale - 0.5)


@cached_njit(fastmath=True)
def _edge_coverage(distance: float, other: float) -> float:
    """The covered part of a pixel that lies ``distance`` pixels inside one edge and ``other`` inside the opposite."""
    return max(0.0, min(0.5, distance) + min(0.5, other))


@cached_njit(fastmath=True)
def draw_rectangles(
    canvas: Image,
    inverse: Array,
    boxes: Indices,
    levels: Indices,
    atlas: Image,
    light: Array,
    shadow: Array,
    shade: Image,
) -> None:
    """Draws N rectangles over ``canvas`` (h, w, 2), premultiplied grey and coverage, in their order.

    ``inverse`` (N, 3, 3) takes canvas pixels to the unit square of each rectangle, ``boxes`` (N, 4) are x0, y0, x1,
    y1; ``levels`` (N, 3) say where in ``atlas`` (T, 2), premultiplied grey and coverage, a texture begins, and its
    rows and columns. ``light`` (N, 2): ambient, and direct where the ``shade`` map, read at ``shadow`` (N, 2, 3) ·
    (u, v, 1), is 1.
    """
    for k in range(len(inverse)):
        m, s = inverse[k], shadow[k]
        start, rows, columns = levels[k]
        ambient, direct = light[k]
        for y in range(boxes[k, 1], boxes[k, 3]):
            for x in range(boxes[k, 0], boxes[k, 2]):
                w = m[2, 0] * x + m[2, 1] * y + m[2, 2]
                if w <= 0:
                    continue
                u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / w
                v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / w
                across = math.sqrt((m[0, 0] - u * m[2, 0]) ** 2 + (m[0, 1] - u * m[2, 1]) ** 2) / w
                down = math.sqrt((m[1, 0] - v * m[2, 0]) ** 2 + (m[1, 1] - v * m[2, 1]) ** 2) / w
                cover = _edge_coverage(u / across, (1 - u) / across) * _edge_coverage(v / down, (1 - v) / down)
                if cover <= 0:
                    continue
                a = min(max(u * columns - 0.5, 0.0), columns - 1.001)
                b = min(max(v * rows - 0.5, 0.0), rows - 1.001)
                i, j = int(a), int(b)
                a, b = a - i, b - j
                p = start + j * columns + i
                q = p + columns
                w00, w01, w10, w11 = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
                grey = w00 * atlas[p, 0] + w01 * atlas[p + 1, 0] + w10 * atlas[q, 0] + w11 * atlas[q + 1, 0]
                alpha = w00 * atlas[p, 1] + w01 * atlas[p + 1, 1] + w10 * atlas[q, 1] + w11 * atlas[q + 1, 1]
                if alpha <= 0:
                    continue
                lit = ambient
                if direct > 0:
                    arc, lateral = s[0, 0] * u + s[0, 1] * v + s[0, 2], s[1, 0] * u + s[1, 1] * v + s[1, 2]
                    lit += direct * _sample_shade(shade, arc, lateral, 1 / SHADE_CELL_M)
                canvas[y, x, 0] = canvas[y, x, 0] * (1 - alpha * cover) + grey * lit * cover
                canvas[y, x, 1] = canvas[y, x, 1] * (1 - alpha * cover) + alpha * cover


@cached_njit(fastmath=True)
def _box_coverage(value: float, low: float, high: float, width: float) -> float:
    """The part of [value ± width / 2] that lies within [low, high]."""
    return max(0.0, min(high, value + width / 2) - max(low, value - width / 2)) / width


@cached_njit(fastmath=True)
def road_coordinates(ahead: float, right: float, road: Array, step: float) -> tuple[float, float]:
    """Arc length from the camera and lateral position (m) of a point ``ahead`` and to the ``right`` of the camera.

    ``road`` (M, 4) lists the road's axis by distance ahead, every ``step`` metres: how far it lies to the right, the
    sine and cosine of its direction, and arc length.
    """
    along, lateral = ahead, 0.0
    for _ in range(3):
        k = min(max(along / step, 0.0), len(road) - 1.001)
        i = int(k)
        f = k - i
        x = road[i, 0] * (1 - f) + road[i + 1, 0] * f
        sine = road[i, 1] * (1 - f) + road[i + 1, 1] * f
        cosine = road[i, 2] * (1 - f) + road[i + 1, 2] * f
        lateral = (right - x) * cosine - (ahead - along) * sine
        along = ahead + lateral * sine
    k = min(max(along / step, 0.0), len(road) - 1.001)
    i = int(k)
    return road[i, 3] + (along / step - i) * (road[i + 1, 3] - road[i, 3]), lateral


@cached_njit(fastmath=True)
def draw_sky(
    image: Image, rays: Array, heading: float, focal: float, appearance: Array, skylines: Array, noise: Image
) -> None:
    """Draw sky and far skylines, down to a little below the horizon, into ``image`` (h, w, 2).

    ``rays`` as in `draw_ground`. ``appearance``: grey level at the horizon, its change upwards, that of the clouds,
    the sun's azimuth; ``skylines`` (2, A + 1) are the slopes of two skylines over a full turn, then their grey levels
    in the last column.
    """
    rows, columns = image.shape[:2]
    turns = skylines.shape[1] - 1
    for y in range(rows):
        for x in range(columns):
            right = rays[0, 0] * x + rays[0, 1] * y + rays[0, 2]
            down = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
            ahead = rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]
            up = -down / ahead
            if up < -2 * MIN_PAINTED_SLOPE:
                continue
            azimuth = heading - math.atan(right / ahead)
            grey = appearance[0] + appearance[1] * up + 30 * math.cos(azimuth - appearance[3])
            if up > 0.01:
                grey += appearance[2] * sample_periodic(noise, 6 / (up + 0.1), azimuth * (64 / (2 * math.pi)))
            place = azimuth % (2 * math.pi) * (turns / (2 * math.pi))
            k = int(place)
            part = place - k
            for r in range(2):
                top = skylines[r, k % turns] * (1 - part) + skylines[r, (k + 1) % turns] * part
                covered = min(max(0.5 + (top - up) * focal, 0.0), 1.0)
                spot = noise[int(up * 300) & 255, int(place * 2) & 255]
                grey += (skylines[r, turns] * (1 + 0.12 * spot) - grey) * covered
            image[y, x, 0] = grey
            image[y, x, 1] = 1.0


@cached_njit(fastmath=True)
def _modulo(value: float, period: float) -> float:
    return value - period * math.floor(value / period)


@cached_njit(fastmath=True)
def draw_ground(
    image: Image,
    rays: Array,
    height: float,
    road: Array,
    step: float,
    arc0: float,
    appearance: Array,
    noise: Image,
    shade: Image,
    coarse: Image,
    shadow_edges: Array,
    occlusion: Array,
) -> None:
    """Draw the ground below the horizon of ``image`` (h, w, 2).

    ``rays`` (3, 3) takes (x, y, 1) to a direction right, down, ahead of a camera ``height`` metres above the ground;
    ``road`` and ``step`` as in `road_coordinates`, ``arc0`` the arc length beside the camera. ``appearance``: asphalt,
    verge and paint in grey levels, ambient and direct light, distance between crossroads and the first, and half a
    lane's width. ``shadow_edges`` (C, E, 3) outline the shadows of vehicles by E edges: (ahead, right, 1) · edge is the
    distance of a point inside, m; ``occlusion`` (C, 2) is the share of ambient light that each occludes, too, and the
    width of its soft border, m.
    """
    asphalt, verge, paint, ambient, direct, crossing_every, crossing_at, half = appearance
    rows, columns = image.shape[:2]
    for y in range(rows):
        for x in range(columns):
            down = rays[1, 0] * x + rays[1, 1] * y + rays[1, 2]
            if down < MIN_PAINTED_SLOPE:
                continue
            depth = height / down
            ahead = depth * (rays[2, 0] * x + rays[2, 1] * y + rays[2, 2])
            right = depth * (rays[0, 0] * x + rays[0, 1] * y + rays[0, 2])
            across = depth * rays[0, 0]  # metres per pixel
            pixel_length = across * depth / height
            s, lateral = road_coordinates(ahead, right, road, step)
            arc = arc0 + s
            k = min(int(max(ahead, 0.0) / step), len(road) - 1)
            sine, cosine = abs(road[k, 1]), abs(road[k, 2])
            sideways = across * cosine + pixel_length * abs(sine - abs(right) / max(ahead, 1.0) * cosine) + 1e-3
            lengthways = pixel_length * cosine + across * sine + 1e-3

            paved = _box_coverage(lateral, -3 * half - CHASE_SHOULDER_WIDTH_M, half + CHASE_SHOULDER_WIDTH_M, sideways)
            junction = _box_coverage(_modulo(arc - crossing_at, crossing_every), 0.0, 6.5, lengthways)
            paved = max(paved, junction)
            grey = verge + (asphalt - verge) * paved
            for wavelength, amplitude in ((5.0, 0.06), (0.8, 0.05), (0.13, 0.07)):
                blur = pixel_length / wavelength
                if blur < 2.0:
                    keep = amplitude * (2.5 - 1.5 * paved) / (1 + blur**4)
                    grey *= 1 + keep * sample_periodic(noise, arc * (2 / wavelength), lateral * (2 / wavelength))
            lane = math.floor((lateral + half) / (2 * half))
            patch = noise[int(math.floor(arc / 7.3)) & 255, int(lane) & 255]  # repairs
            grey *= 1 + 0.05 * patch * paved * (1 - junction) / (1 + pixel_length)
            marks = 0.0
            if paved > 0:
                dash = _box_coverage(_modulo(arc, 9.0), 2.0, 5.0, lengthways)
                marks = dash * _box_coverage(lateral, -half - 0.06, -half + 0.06, sideways)
                marks += _box_coverage(lateral, half - 0.12, half, sideways)
                marks += _box_coverage(lateral, -3 * half, -3 * half + 0.12, sideways)
                stop = _box_coverage(_modulo(arc - crossing_at + 1.2, crossing_every), 0.0, 0.4, lengthways)
                marks = max(marks * (1 - junction), stop * _box_coverage(lateral, -half, half - 0.12, sideways))
                grey += (paint - grey) * 0.9 * min(marks, 1.0)

            lit = 0.0
            if pixel_length < 0.15:
                lit = _sample_shade(shade, arc, lateral, 1 / SHADE_CELL_M)
            else:
                for part in range(3):  # along the pixel's long footprint
                    lit += (
                        _sample_shade(coarse, arc + (part - 1) * 0.33 * pixel_length, lateral, 0.25 / SHADE_CELL_M) / 3
                    )
            sky = ambient
            for c in range(len(shadow_edges)):
                inside = 1e9
                for e in range(shadow_edges.shape[1]):
                    inside = min(
                        inside, shadow_edges[c, e, 0] * ahead + shadow_edges[c, e, 1] * right + shadow_edges[c, e, 2]
                    )
                covered = min(max(0.5 + inside / (occlusion[c, 1] + across), 0.0), 1.0)
                lit *= 1 - covered
                sky *= 1 - occlusion[c, 0] * covered
            image[y, x, 0] = grey * (sky + direct * lit)
            image[y, x, 1] = 1.0
