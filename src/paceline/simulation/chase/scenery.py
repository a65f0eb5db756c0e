"""The objects beside the road of a chase, and the shadows on the road."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from paceline.arrays import Image
from paceline.simulation import textures
from paceline.simulation.chase.rasterizer import SHADE_CELL_M
from paceline.simulation.chase.vehicles import AntialiasedCanvas, Face, make_vehicle
from paceline.simulation.textures import Canvas, Texture
from paceline.simulation.vehicle_catalogue import RASTERIZED_KINDS

LANE_WIDTH_M = 3.5  # m; the vehicles' lane lies around lateral 0, the other one to its left
RIGHT_EDGE_M, LEFT_EDGE_M = LANE_WIDTH_M / 2, -1.5 * LANE_WIDTH_M
BLOCK_LENGTH_M = 40.0  # m of road that are furnished at a time
SHADE_LENGTH_M, SHADE_WIDTH_M = 409.6, 25.6  # m along and across the road, after which shadows repeat


@dataclass(frozen=True, eq=False)
class RoadsideObject:
    """Upright faces at a position beside the road; their axes are right, down, ahead of the foot."""

    faces: tuple[Face, ...]
    arc: float
    lateral: float
    turn: float = 0.0  # rad, to the left of the road's direction


def place_roadside(seed: int, length: float, object_density: float, parallel_share: float) -> list[RoadsideObject]:
    """Objects along ``length`` metres of road in its order; an ``object_density`` of about 1 is a busy street.

    ``parallel_share`` (0–1) is the share of poles, gables and parapets close beside the road, whose edges are parallel
    to those of a vehicle. A longer road begins as a shorter one does.
    """
    rng = np.random.default_rng([seed, 53])
    makers = {
        "tree": [_make_tree(rng) for _ in range(5)],
        "hedge": [_make_hedge(rng) for _ in range(3)],
        "pole": [_make_pole(rng) for _ in range(4)],
        "building": [_make_building(rng) for _ in range(6)],
        "sign": [_make_sign(rng) for _ in range(4)],
        "parked": [_make_parked_vehicle(rng) for _ in range(4)],
    }
    walls, bridge = [_make_wall(rng) for _ in range(3)], _make_bridge(rng)
    # per 10 m of road and side: how many, and how far from the road's edge
    densities = {
        "tree": (0.35 * (1 - 0.5 * parallel_share), (1.5, 16.0)),
        "hedge": (0.15, (0.6, 7.0)),
        "pole": (0.12 + 0.5 * parallel_share, (0.6, 3.0)),
        "building": (0.12 + 0.35 * parallel_share, (3.0 - 2.0 * parallel_share, 18.0 - 12.0 * parallel_share)),
        "sign": (0.06 + 0.1 * parallel_share, (0.6, 2.5)),
        "parked": (0.06, (0.3, 1.2)),
    }
    things: list[RoadsideObject] = []
    for block in range(int(length / BLOCK_LENGTH_M)):
        rng, start = np.random.default_rng([seed, 59, block]), BLOCK_LENGTH_M * block
        for side, edge in ((-1, -LEFT_EDGE_M), (1, RIGHT_EDGE_M)):
            for kind, (density, (near, far)) in densities.items():
                for arc in start + BLOCK_LENGTH_M * rng.random(
                    rng.poisson(object_density * density * BLOCK_LENGTH_M / 10)
                ):
                    make = makers[kind][int(rng.integers(len(makers[kind])))]
                    lateral = side * (edge + rng.uniform(near, far) + make.half)
                    things.append(RoadsideObject(make(side), float(arc), float(lateral), float(rng.normal(0, 0.02))))
            if rng.random() < 0.12 * object_density + 0.4 * parallel_share:
                make, lateral = walls[int(rng.integers(len(walls)))], side * (edge + rng.uniform(0.8, 4.0))
                things += [
                    RoadsideObject(make(side), start + 4.0 * j, float(lateral)) for j in range(int(BLOCK_LENGTH_M / 4))
                ]
        if block % 6 == 3 and rng.random() < 0.5 + 0.5 * parallel_share:
            things.append(RoadsideObject(bridge, start + 20.0, (RIGHT_EDGE_M + LEFT_EDGE_M) / 2))
    return sorted(things, key=lambda thing: thing.arc)


class _ObjectFaces:
    """Faces for a thing that is ``half`` metres wide to either side; called with the side of the road, -1 left or 1
    right, towards whose middle ``inward`` faces look."""

    def __init__(self, faces: tuple[Face, ...], inward: tuple[Face, ...] = (), half: float = 0.0) -> None:
        self.faces, self.inward, self.half = faces, inward, half

    def __call__(self, side: int) -> tuple[Face, ...]:
        mirrored = tuple(_mirror_face(f) for f in self.inward) if side < 0 else self.inward
        return (*self.faces, *mirrored)


def _mirror_face(face: Face) -> Face:
    """The face on the other side of the thing, seen from there."""
    (x, y, z), (ax, ay, az), down = face.corner, face.across, face.down
    return Face(face.texture, (-x - ax, y + ay, z + az), (ax, -ay, -az), down)


def upright_face(
    texture: Texture, width: float, height: float, x: float = 0.0, foot: float = 0.0, z: float = 0.0
) -> Face:
    """A face that looks back along the road, its lower edge ``foot`` metres above the ground."""
    return Face(texture, (x - width / 2, -foot - height, z), (width, 0, 0), (0, height, 0))


def _make_tree(rng: np.random.Generator) -> _ObjectFaces:
    width, height = rng.uniform(3.5, 8), rng.uniform(5, 11)
    return _ObjectFaces((upright_face(textures.tree_texture(rng, width, height), width, height),))


def _make_hedge(rng: np.random.Generator) -> _ObjectFaces:
    width, height = rng.uniform(2, 4), rng.uniform(0.8, 2.0)
    c = Canvas(width, height, 0.0, alpha=0.0, density=100)
    for x in np.linspace(0.12, 0.88, 14) * width:
        c.ellipse(x, 0.6 * height, 0.12 * width, 0.45 * height * rng.uniform(0.7, 1), rng.uniform(35, 60))
    c.mottle(rng, 0.3, 0.25)
    c.mottle(rng, 0.2, 0.08)
    return _ObjectFaces((upright_face(c.finish(), width, height),), half=width / 2)


def _make_pole(rng: np.random.Generator) -> _ObjectFaces:
    width, height = rng.uniform(0.12, 0.34), rng.uniform(4.5, 9)
    texture = textures.pole_texture(rng, width, height)
    arm = AntialiasedCanvas(1.6, 0.1, 70, density=40).finish()
    faces = [upright_face(texture, width, height)]
    if rng.random() < 0.5:
        faces.append(upright_face(arm, 1.6, 0.1, foot=height - 0.4))
    return _ObjectFaces(tuple(faces))


def _make_building(rng: np.random.Generator) -> _ObjectFaces:
    """A gable towards the traffic, a front towards the road, a pale parapet along both."""
    width, height, depth = rng.uniform(7, 13), rng.uniform(3.5, 10), rng.uniform(8, 12)
    gable, front = textures.building_texture(rng, width, height), textures.building_texture(rng, depth, height)
    rim = AntialiasedCanvas(width, 0.35, rng.uniform(120, 220), density=20).finish()
    half = width / 2
    return _ObjectFaces(
        (upright_face(gable, width, height), upright_face(rim, width, 0.35, foot=height - 0.1)),
        (
            Face(front, (-half, -height, depth), (0, 0, -depth), (0, height, 0)),
            Face(rim, (-half, -height - 0.25, depth), (0, 0, -depth), (0, 0.35, 0)),
        ),
        half,
    )


def _make_sign(rng: np.random.Generator) -> _ObjectFaces:
    width, height, foot = rng.uniform(0.6, 2.4), rng.uniform(0.5, 1.4), rng.uniform(0.6, 2.2)
    board = AntialiasedCanvas(width, height, rng.uniform(90, 235), density=120)
    ink = rng.uniform(20, 70)
    for y in np.arange(0.2, 0.75, 0.25) * height:
        board.box(0.12 * width, float(y), rng.uniform(0.4, 0.75) * width, 0.1 * height, ink)
    post = AntialiasedCanvas(0.08, foot, 75, density=200).finish()
    return _ObjectFaces(
        (upright_face(post, 0.08, foot), upright_face(board.finish(), width, height, foot=foot)), half=width / 2
    )


def _make_wall(rng: np.random.Generator) -> _ObjectFaces:
    """Four metres of wall, fence or crash barrier along the road."""
    height, foot, grey = rng.uniform(0.5, 1.5), float(rng.choice([0.0, 0.35])), rng.uniform(60, 210)
    c = AntialiasedCanvas(4.0, height, grey, density=64)
    c.mottle(rng, 0.08, 0.4)
    c.box(0, 0, 4.0, 0.12, 0.6 * grey)
    c.box(0.0, 0, 0.1, height, 0.5 * grey)
    return _ObjectFaces((), (Face(c.finish(), (0, -foot - height, 4.0), (0, 0, -4.0), (0, height, 0)),))


def _make_parked_vehicle(rng: np.random.Generator) -> _ObjectFaces:
    body = make_vehicle(rng, str(rng.choice(RASTERIZED_KINDS[:3])), float(rng.choice([35, 60, 120, 190])))
    return _ObjectFaces(stand_on_ground(body.faces + body.lamps, body.clearance + body.height / 2), half=body.width / 2)


def stand_on_ground(faces: tuple[Face, ...], height: float) -> tuple[Face, ...]:
    """``faces`` about a centre ``height`` metres above the ground, about its foot instead."""
    return tuple(Face(f.texture, (f.corner[0], f.corner[1] - height, f.corner[2]), f.across, f.down) for f in faces)


def oncoming_faces(rng: np.random.Generator) -> tuple[Face, ...]:
    """The front of an oncoming car, about its foot."""
    width, height = rng.uniform(1.65, 1.85), rng.uniform(0.6, 0.75)
    parts = textures.front_parts(rng, width, height, 0.04)
    faces = tuple(
        Face(p.texture, (p.x - p.width / 2, p.y - p.height / 2, p.depth), (p.width, 0, 0), (0, p.height, 0))
        for p in parts
    )
    return stand_on_ground(faces, 0.65)


def _make_bridge(rng: np.random.Generator) -> tuple[Face, ...]:
    """A deck across the road on two pillars, with a parapet."""
    span, tall, foot = 18.0, rng.uniform(0.9, 1.6), rng.uniform(4.6, 5.6)
    deck = AntialiasedCanvas(span, tall, rng.uniform(80, 170), density=24)
    deck.mottle(rng, 0.06, 0.8)
    deck.box(0, 0, span, 0.12, 210)
    deck.box(0, 0.8 * tall, span, 0.2 * tall, 45)
    pillar = AntialiasedCanvas(0.8, foot, rng.uniform(70, 140), density=40).finish()
    sides = (upright_face(pillar, 0.8, foot, x) for x in (-6.2, 6.2))
    return (*sides, upright_face(deck.finish(), span, tall, foot=foot))


def shade_map(rng: np.random.Generator, density: float, sun: float) -> Image:
    """The part of the sun's direct light, 0–1, that reaches the ground: rows along the road, columns across it.

    Crowns of trees with gaps of light, poles and eaves with hard edges; those of poles lie along the sun's direction
    ``sun`` (rad to the right of the road) or at any angle, those of roofs and bridges across the road.
    ``density`` about 1 shades a third of the road.
    """
    rows, columns = int(SHADE_LENGTH_M / SHADE_CELL_M), int(SHADE_WIDTH_M / SHADE_CELL_M)
    light: Image = np.ones((rows, columns), np.float32)
    for _ in range(rng.poisson(26 * density)):
        _draw_crown_shadow(light, rng)
    for _ in range(rng.poisson(40 * density)):
        angle = float(rng.choice([sun, 0.0, np.pi / 2, rng.uniform(0, np.pi)]))
        _draw_bar_shadow(light, rng, angle, rng.uniform(0.1, 0.45), rng.uniform(6, 14))
    for _ in range(rng.poisson(7 * density)):
        _draw_bar_shadow(light, rng, np.pi / 2 + rng.normal(0, 0.1), rng.uniform(2.5, 9.0), 40.0)
    for _ in range(rng.poisson(6 * density)):
        _draw_bar_shadow(light, rng, rng.normal(0, 0.05), rng.uniform(1.0, 5.0), rng.uniform(6, 15))
    return np.asarray(cv2.GaussianBlur(light, (0, 0), 0.025 / SHADE_CELL_M), np.float32)


def _draw_crown_shadow(light: Image, rng: np.random.Generator) -> None:
    """Darken an ellipse of leaves, with flecks of light."""
    size = rng.uniform(2.0, 5.0, 2) / SHADE_CELL_M
    centre = rng.uniform(0, 1, 2) * light.shape[::-1]
    (x0, y0) = np.maximum(centre - size, 0).astype(int)
    (x1, y1) = np.minimum(centre + size, light.shape[::-1]).astype(int)
    if x1 - x0 < 8 or y1 - y0 < 8:
        return
    y, x = np.mgrid[y0:y1, x0:x1]
    inside = 1 - np.hypot((x - centre[0]) / size[0], (y - centre[1]) / size[1])
    noise = np.zeros(inside.shape, np.float32)
    for grain in (0.9, 0.35, 0.15):
        cells = max(2, int((y1 - y0) * SHADE_CELL_M / grain)), max(2, int((x1 - x0) * SHADE_CELL_M / grain))
        coarse = rng.standard_normal(cells).astype(np.float32)
        noise += cv2.resize(coarse, (x1 - x0, y1 - y0), interpolation=cv2.INTER_CUBIC) * np.float32(grain**0.4)
    leaves = np.clip((3.0 * inside - 0.4 + 0.8 * noise) * 3, 0, 1)
    light[y0:y1, x0:x1] *= 1 - 0.95 * leaves.astype(np.float32)


def _draw_bar_shadow(light: Image, rng: np.random.Generator, angle: float, width: float, length: float) -> None:
    """Darken a straight bar that runs at ``angle`` to the right of the road's direction."""
    centre = rng.uniform(0, 1, 2) * light.shape[::-1]
    if length < 20:
        centre[0] = (0.5 + rng.uniform(-0.35, 0.35)) * light.shape[1]
    along = np.array([np.sin(angle), np.cos(angle)]) * length / 2 / SHADE_CELL_M
    across = np.array([np.cos(angle), -np.sin(angle)]) * width / 2 / SHADE_CELL_M
    corners = centre + np.array([-along - across, along - across, along + across, across - along])
    cv2.fillConvexPoly(light, np.round(corners * 16).astype(np.int32), 0.0, shift=4)
