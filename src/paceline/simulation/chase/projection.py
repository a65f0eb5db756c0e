"""Rectangular faces placed on a road and projected into a chase camera."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array, Image, Indices
from paceline.simulation.chase import rasterizer
from paceline.simulation.chase.motion import RoadPose
from paceline.simulation.chase.vehicles import Face
from paceline.simulation.road import POLYGON_STEP_M, Axis
from paceline.simulation.textures import Texture

MIN_FACE_DEPTH_M = 0.3  # m ahead of the camera, before which a face is left out


class TextureAtlas:
    """The pyramids of all textures in one array, for `rasterizer.draw_rectangles`."""

    def __init__(self) -> None:
        self._known: dict[int, int] = {}
        self._textures: list[Texture] = []

    def add(self, texture: Texture) -> int:
        if id(texture) not in self._known:
            self._known[id(texture)] = len(self._textures)
            self._textures.append(texture)  # kept, so that its id stays its own
        return self._known[id(texture)]

    def pack(self) -> None:
        """All added textures: ``pixels`` (T, 2), and ``levels`` (textures, levels, 3): start, rows, columns."""
        levels = [t.pyramid for t in self._textures]
        shapes = np.array([[level.shape[:2] for level in pyramid] for pyramid in levels], np.int64)
        sizes = shapes.prod(-1).ravel()
        starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).reshape(shapes.shape[:2])
        self.levels: Indices = np.concatenate([starts[..., None], shapes], axis=-1)
        self.pixels: Image = np.concatenate([level.reshape(-1, 2) for pyramid in levels for level in pyramid])
        for texture in self._textures:
            del texture.__dict__["pyramid"]  # the copies are enough


@dataclass(frozen=True, eq=False)
class Faces:
    """N faces: in their object's axes (right, down, ahead of its foot, m) and the object's pose."""

    corner: Array  # (N, 3)
    across: Array  # (N, 3)
    down: Array  # (N, 3)
    texture: Indices  # (N,)
    x: Array  # (N,) m, the object's foot in plan
    y: Array
    heading: Array  # (N,) rad, of the object
    along: Array  # (N,) rad, of the road beside it
    arc: Array  # (N,) m
    lateral: Array

    def __len__(self) -> int:
        return len(self.texture)

    def __getitem__(self, selection: NDArray[np.bool_] | Indices | slice) -> Faces:
        return Faces(*(getattr(self, f.name)[selection] for f in fields(self)))


def place_faces(faces: tuple[Face, ...], atlas: TextureAtlas, road: Axis, pose: RoadPose) -> Faces:
    """The ``faces`` of an object at ``pose``."""
    n = len(faces)
    vectors = np.array([[f.corner, f.across, f.down] for f in faces], float).reshape(n, 3, 3)
    along = float(road.frame(pose.arc)[2])
    pose_values = (pose.x, pose.y, pose.heading, along, pose.arc, pose.lateral)
    texture = np.array([atlas.add(f.texture) for f in faces], np.int64)
    return Faces(vectors[:, 0], vectors[:, 1], vectors[:, 2], texture, *(np.full(n, w, float) for w in pose_values))


def move_faces(faces: Faces, road: Axis, pose: RoadPose) -> Faces:
    """The faces of one object, at another state."""
    along = float(road.frame(pose.arc)[2])
    pose_values = (pose.x, pose.y, pose.heading, along, pose.arc, pose.lateral)
    return Faces(
        faces.corner, faces.across, faces.down, faces.texture, *(np.full(len(faces), w, float) for w in pose_values)
    )


def join_faces(groups: list[Faces]) -> Faces:
    return Faces(*(np.concatenate([getattr(g, f.name) for g in groups]) for f in fields(Faces)))


@dataclass(frozen=True, eq=False)
class Sun:
    """Light from ``azimuth`` (rad, counter-clockwise from x) and ``elevation``: in sun 1, in shade ``ambient`` on level
    ground."""

    azimuth: float
    elevation: float
    ambient: float

    @property
    def direct(self) -> float:
        """Direct light on a face perpendicular to it."""
        return float((1 - self.ambient) / np.sin(self.elevation))

    def direction(self, heading: float) -> Array:
        """(3,) right, down, ahead towards the sun for an observer with a ``heading``."""
        turn, c = self.azimuth - heading, np.cos(self.elevation)
        return np.array([-np.sin(turn) * c, -np.sin(self.elevation), np.cos(turn) * c])


@dataclass(frozen=True, eq=False)
class CameraPose:
    """A chase camera at one time: ``height`` metres above (x, y), its ``heading`` in plan; ``R`` (3, 3) takes right,
    down, ahead of that heading to the camera's axes, and ``K`` those to pixels."""

    K: Array
    R: Array
    height: float
    x: float
    y: float
    heading: float

    def to_level(self, x: Array | float, y: Array | float) -> tuple[Array, Array]:
        """Right and ahead (m) of points in plan."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        dx, dy = np.asarray(x) - self.x, np.asarray(y) - self.y
        return dx * s - dy * c, dx * c + dy * s

    def to_camera(self, points: Array) -> Array:
        """Camera axes (…, 3) of points right, down (from the ground), ahead of the eye's foot."""
        return np.asarray((points + np.array([0.0, self.height, 0.0])) @ self.R.T)


def axis_ahead(road: Axis, s0: float, x0: float, y0: float, heading: float, reach: float) -> Array:
    """The axis as seen by an observer beside ``s0``: rows (right, sine, cosine, arc - s0) every
    `POLYGON_STEP_M` ahead, for `rasterizer.draw_ground`."""
    s = np.arange(s0 - 4.0, s0 + 1.3 * reach, POLYGON_STEP_M)
    x, y, h = road.frame(s)
    turn = np.clip(heading - h, -1.3, 1.3)  # beyond, the road is out of view
    z = (x - x0) * np.cos(heading) + (y - y0) * np.sin(heading)
    right = (x - x0) * np.sin(heading) - (y - y0) * np.cos(heading)
    z = np.maximum.accumulate(z)
    distances = np.arange(0.0, reach, POLYGON_STEP_M)
    return np.column_stack([np.interp(distances, z, c) for c in (right, np.sin(turn), np.cos(turn), s - s0)])


def camera_rotation(pitch: float, roll: float) -> Array:
    """From right, down, ahead to the axes of a camera that looks down by ``pitch`` and leans right by ``roll``, rad."""
    c, s = np.cos(pitch), np.sin(pitch)
    a, b = np.cos(roll), np.sin(roll)
    lean = np.array([[a, b, 0], [-b, a, 0], [0, 0, 1]])
    return np.asarray(lean @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]))


def _turn_left(vectors: Array, angle: Array) -> Array:
    """``vectors`` (N, …, 3) right, down, ahead of axes turned by ``angle`` (N,) to the left, in unturned axes."""
    shape = (-1, *(1,) * (vectors.ndim - 2))
    c, s = np.cos(angle).reshape(shape), np.sin(angle).reshape(shape)
    r, d, a = np.moveaxis(vectors, -1, 0)
    return np.stack([r * c - a * s, d, r * s + a * c], axis=-1)


def face_vectors(faces: Faces, camera: CameraPose) -> Array:
    """(N, 3, 3): corner, across and down of each face, right, down, ahead of the eye's foot."""
    vectors = _turn_left(np.stack([faces.corner, faces.across, faces.down], axis=1), faces.heading - camera.heading)
    vectors[:, 0, ::2] += np.column_stack(camera.to_level(faces.x, faces.y))
    return vectors


def draw_faces(
    canvas: Image,
    faces: Faces,
    atlas: TextureAtlas,
    camera: CameraPose,
    sun: Sun,
    shade: Image,
    to_canvas: Array,
    emission: float = 0.0,
) -> None:
    """Draws ``faces`` over ``canvas`` (h, w, 2) in their order, as ``camera`` sees them.

    ``to_canvas`` (3, 3) takes image pixels to those of the canvas; ``emission`` is light of the faces' own.
    """
    vectors = face_vectors(faces, camera)
    ahead = camera.to_camera(vectors[:, 0])
    M = np.stack([vectors[:, 1] @ camera.R.T, vectors[:, 2] @ camera.R.T, ahead], axis=-1)  # unit square -> camera
    corners = M @ np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1.0]])
    M = to_canvas @ camera.K @ M
    is_visible = (corners[:, 2].min(1) > MIN_FACE_DEPTH_M) & (np.linalg.det(M) > 0)
    quads = M @ np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1.0]])
    quads = quads[:, :2] / np.where(is_visible[:, None, None], quads[:, 2:], 1.0)
    size = np.array(canvas.shape[1::-1])
    low = np.maximum(np.floor(quads.min(2)).astype(np.int64) - 1, 0)
    high = np.minimum(np.ceil(quads.max(2)).astype(np.int64) + 2, size)
    is_visible &= (low < high).all(1)
    if not is_visible.any():
        return
    faces, vectors, M, quads = faces[is_visible], vectors[is_visible], M[is_visible], quads[is_visible]
    light, shadow = _face_light(faces, vectors, camera, sun)
    light[:, 0] += emission
    rasterizer.draw_rectangles(
        canvas,
        np.linalg.inv(M),
        np.concatenate([low[is_visible], high[is_visible]], axis=1),
        _select_levels(faces.texture, quads, atlas),
        atlas.pixels,
        light,
        shadow,
        shade,
    )


def _select_levels(texture: Indices, quads: Array, atlas: TextureAtlas) -> Indices:
    """The pyramid level of each face whose texels are nearest to canvas pixels in size."""
    sides = np.linalg.norm(np.roll(quads, -1, axis=2) - quads, axis=1)  # top, right, bottom, left
    texels = atlas.levels[texture, 0, 1:]
    ratio = np.maximum(
        texels[:, 1] / np.maximum(sides[:, ::2].max(1), 1e-6), texels[:, 0] / np.maximum(sides[:, 1::2].max(1), 1e-6)
    )
    level = np.clip(np.rint(np.log2(ratio)), 0, atlas.levels.shape[1] - 1).astype(int)
    return np.ascontiguousarray(atlas.levels[texture, level])


def _face_light(faces: Faces, vectors: Array, camera: CameraPose, sun: Sun) -> tuple[Array, Array]:
    """Ambient and direct light (N, 2) on faces, and where on the road (N, 2, 3) their shade is to be read."""
    normal = np.cross(vectors[:, 2], vectors[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    towards = sun.direction(camera.heading)
    sky = 0.75 - 0.25 * normal[:, 1]  # a face that looks up sees the whole of it
    light = np.column_stack([sun.ambient * sky, sun.direct * np.maximum(normal @ towards, 0.0)])
    # Light that reaches a point above the road would have reached the road farther from the sun.
    fall = -towards[::2] / towards[1]  # horizontal metres towards the sun per metre up
    relative = vectors[:, :, ::2].copy()
    relative[:, 0] -= np.column_stack(camera.to_level(faces.x, faces.y))
    relative += vectors[:, :, 1:2] * fall
    turn = (faces.along - camera.heading)[:, None]
    c, s = np.cos(turn), np.sin(turn)
    r, a = relative[..., 0], relative[..., 1]
    lateral, arc = r * c + a * s, a * c - r * s
    arc[:, 0] += faces.arc
    lateral[:, 0] += faces.lateral
    shadow = np.stack([arc, lateral], axis=1)[:, :, [1, 2, 0]]  # for (u, v, 1)
    return light, np.ascontiguousarray(shadow)
