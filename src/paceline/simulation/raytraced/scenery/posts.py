"""Slender objects beside a road: lamp posts, utility poles, markers, signs.

Each has its foot at the origin; x is the road's direction and y points away from the road.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from paceline.simulation.raytraced.mesh_builders import NamedMesh, box, boxes, join_meshes, quads, revolve, tube
from paceline.simulation.raytraced.meshes import Texture


def lamp_post(rng: np.random.Generator) -> list[NamedMesh]:
    """A steel post with an arm over the road."""
    high, reach = rng.uniform(7.0, 9.5), rng.uniform(1.2, 2.2)
    bend = np.linspace(0, np.pi / 2, 6)
    arm = np.column_stack([0 * bend, -reach * (1 - np.cos(bend)), high - 0.8 + 0.8 * np.sin(bend)])
    post = revolve([[0.11, -0.6], [0.11, 1.0], [0.075, 1.15], [0.05, high - 0.8]], 12)
    head = box([0.22, 0.6, 0.12], [0, -reach - 0.25, high])
    return [("steel", join_meshes([post, tube(arm, 0.04, 8)])), ("white", head)]


def utility_pole(rng: np.random.Generator) -> list[NamedMesh]:
    """A wooden pole with a cross arm and insulators."""
    high = rng.uniform(7.5, 9.5)
    pole = revolve([[0.16, -1.0], [0.12, high]], 10)
    arm = box([0.12, 2.2, 0.12], [0.1, 0, high - 0.5])
    caps = [
        revolve([[0.04, 0.0], [0.05, 0.08], [0.0, 0.16]], 8).transformed([0.1, y, high - 0.44])
        for y in (-1, -0.4, 0.4, 1)
    ]
    return [("timber", join_meshes([pole, arm])), ("white", join_meshes(caps))]


def marker(rng: np.random.Generator) -> list[NamedMesh]:
    """A delineator post, white with a dark band."""
    body = box([0.12, 0.05, 1.3], [0, 0, 0.4])
    band = box([0.124, 0.054, 0.22], [0, 0, 0.85])
    return [("white", body), ("black", band)]


def sign(rng: np.random.Generator) -> list[NamedMesh]:
    """A sign that faces those who come along growing x, on one post or two."""
    if rng.random() < 0.6:
        size = rng.uniform(0.6, 0.8)
        name, half, bottom = "round sign", np.array([size / 2, size / 2]), 2.0
        posts = boxes([[0.06, 0.06, bottom + size + 0.5]], [[0.04, 0, (bottom + size - 0.5) / 2]])
    else:
        half, bottom = np.array([rng.uniform(0.6, 1.2), rng.uniform(0.4, 0.7)]), rng.uniform(0.9, 1.6)
        name = "board"
        high = bottom + 2 * half[1]
        posts = boxes([[0.07, 0.07, high + 0.5]] * 2, [[0.05, s * 0.6 * half[0], (high - 0.5) / 2] for s in (-1, 1)])
    y, z0, z1 = half[0], bottom, bottom + 2 * half[1]
    face = quads([[[0, y, z1], [0, -y, z1], [0, -y, z0], [0, y, z0]]])
    rear = box([0.004, 2 * y, z1 - z0], [0.006, 0, (z0 + z1) / 2])
    return [(name, face), ("steel", join_meshes([posts, rear]))]


def round_sign_texture(rng: np.random.Generator) -> Texture:
    """A speed limit (128, 128, 3)."""
    ring, ink = np.zeros((128, 128), np.uint8), np.zeros((128, 128), np.uint8)
    cv2.circle(ring, (64, 64), 54, 255, 18, cv2.LINE_AA)
    text = str(rng.choice(["30", "50", "60", "70"]))
    cv2.putText(ink, text, (29, 80), cv2.FONT_HERSHEY_SIMPLEX, 1.8, 255, 7, cv2.LINE_AA)
    ground = np.full((128, 128, 3), 0.6, np.float32)
    return _inked(_inked(ground, ring, (0.45, 0.01, 0.02)), ink, (0.01, 0.01, 0.01))


def board_texture(rng: np.random.Generator) -> Texture:
    """Two rows of words on a coloured board (96, 192, 3)."""
    color = [(0.01, 0.10, 0.05), (0.01, 0.04, 0.22), (0.5, 0.5, 0.5)][rng.integers(3)]
    ink = np.zeros((96, 192), np.uint8)
    cv2.rectangle(ink, (4, 4), (187, 91), 255, 2, cv2.LINE_AA)
    for y in (40, 80):
        word = "".join(rng.choice(list("ABDEGHLMNORSTUW"), int(rng.integers(4, 8))))
        cv2.putText(ink, word, (14, y), cv2.FONT_HERSHEY_SIMPLEX, 1.0, 255, 3, cv2.LINE_AA)
    light = (0.55, 0.55, 0.55) if max(color) < 0.3 else (0.02, 0.02, 0.02)
    return _inked(np.full((96, 192, 3), color, np.float32), ink, light)


def _inked(face: Texture, ink: NDArray[np.uint8], color: tuple[float, float, float]) -> Texture:
    cover = ink[..., None] / np.float32(255)
    return np.asarray(face * (1 - cover) + cover * np.array(color, np.float32), np.float32)
