"""Materials of vehicles: paint and its colours, glass, plastic, rubber, number plates.

`renderer` has the BSDF of each kind of material.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from paceline.simulation.raytraced.meshes import Material, Texture
from paceline.simulation.raytraced.road_textures import mottle

PAINT_COLORS = {  # linear reflectance, share among cars and among buses and lorries
    "white": ((0.70, 0.70, 0.68), 0.24, 0.40),
    "black": ((0.012, 0.012, 0.013), 0.18, 0.02),
    "grey": ((0.10, 0.105, 0.11), 0.18, 0.05),
    "silver": ((0.36, 0.37, 0.38), 0.14, 0.08),
    "blue": ((0.02, 0.05, 0.20), 0.11, 0.14),
    "red": ((0.32, 0.016, 0.018), 0.09, 0.14),
    "green": ((0.02, 0.07, 0.035), 0.03, 0.08),
    "yellow": ((0.52, 0.30, 0.02), 0.01, 0.09),
    "beige": ((0.42, 0.36, 0.26), 0.02, 0.0),
}


def vehicle_materials(rng: np.random.Generator, fleet: bool = False) -> dict[str, Material]:
    """What the named parts of a vehicle are made of, in a colour drawn as on the road; buses and lorries are a
    ``fleet``."""
    names = list(PAINT_COLORS)
    share = np.array([PAINT_COLORS[n][2 if fleet else 1] for n in names])
    coat = np.array(PAINT_COLORS[str(rng.choice(names, p=share / share.sum()))][0]) * rng.uniform(0.85, 1.1)
    trim = rng.uniform(0.015, 0.045)
    return {
        "paint": Material("paint", _rgb(coat), roughness=0.03),
        "bumper": Material("paint", _rgb(coat if rng.random() < 0.7 else np.full(3, trim)), roughness=0.05),
        "plastic": Material("paint", (trim,) * 3, roughness=0.35),
        "seam": Material("matte", (0.008,) * 3),
        "dark": Material("matte", (0.012,) * 3),
        "rubber": Material("matte", (0.022, 0.022, 0.023)),
        "glass": Material("glass", (0.012, 0.015, 0.015), roughness=0.01),
        "housing": Material("paint", (rng.uniform(0.10, 0.3),) * 3, roughness=0.06),
        "chrome": Material("metal", (0.65, 0.66, 0.68), roughness=0.2),
        "rim": Material("metal", (rng.uniform(0.3, 0.6),) * 3, roughness=0.35),
        "red": Material("paint", (0.22, 0.008, 0.008), roughness=0.02),
        "amber": Material("paint", (0.40, 0.13, 0.01), roughness=0.02),
        "white": Material("paint", (0.55,) * 3, roughness=0.03),
        "cloth": Material("matte", _rgb(rng.uniform(0.01, 0.08) * rng.uniform(0.6, 1.4, 3))),
        "front plate": Material("paint", (0.6,) * 3, plate_texture(rng, (0.62, 0.62, 0.6)), roughness=0.2),
        "rear plate": Material("paint", (0.6,) * 3, plate_texture(rng, (0.62, 0.62, 0.6)), roughness=0.2),
    }


def _rgb(values: ArrayLike) -> tuple[float, float, float]:
    r, g, b = np.asarray(values, float).tolist()
    return r, g, b


def plate_texture(rng: np.random.Generator, ground: tuple[float, float, float]) -> Texture:
    """A number plate's face (64, 296, 3) with characters and a rim."""
    face = np.full((64, 296), 255, np.uint8)
    cv2.rectangle(face, (2, 2), (293, 61), 0, 2)
    text = "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ"), 2)) + "".join(rng.choice(list("0123456789"), 2))
    text += " " + "".join(rng.choice(list("ABCDEFGHJKLMNPRSTUVWXYZ"), 3))
    (w, h), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.5, 5)
    cv2.putText(face, text, ((296 - w) // 2, (64 + h) // 2), cv2.FONT_HERSHEY_SIMPLEX, 1.5, 0, 5, cv2.LINE_AA)
    light = face[..., None].astype(np.float32) / 255
    return np.asarray(
        0.02 + light * (np.array(ground) - 0.02) * (1 + 0.02 * mottle(rng, face.shape, 20.0)[..., None]), np.float32
    )
