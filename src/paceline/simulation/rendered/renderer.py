"""Pictures of solids by path tracing: Mitsuba behind three calls, in the camera model of `paceline.cameras`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from paceline.cameras import Camera
from paceline.simulation.rendered.engine import default_variant, mitsuba
from paceline.simulation.rendered.light import Light
from paceline.simulation.rendered.solids import Array, Material, Solid

Radiance = NDArray[np.float32]
Placement = tuple[Array, Array]  # R (3, 3) and t (3,): world = R X + t
Window = tuple[int, int, int, int]  # pixels x0, y0, x1, y1 of a part of a picture, the last two beyond it

BOUNCES = 3  # what comes after lights no place that a picture shows
OFTENEST = 0.75  # share of the rays towards lights that go to the sun
PASS = 16  # samples per pixel rendered at once, a power of two so that they always add up in the same order
TEXTURE_FILTER = "bilinear"


@dataclass(frozen=True, eq=False)
class View:
    """A camera and where it is: ``X_camera = R X_world + t``."""

    camera: Camera
    R: Array
    t: Array

    def project(self, points: Array) -> Array:
        """Ideal pixels (…, 2) of world ``points`` (…, 3)."""
        return self.camera.project(self.to_camera(points))

    def to_camera(self, points: Array) -> Array:
        """World ``points`` (…, 3) in camera axes."""
        return np.asarray(np.asarray(points) @ self.R.T + self.t)

    @property
    def centre(self) -> Array:
        return np.asarray(-self.R.T @ self.t)


class Renderer:
    """A world ready to be rendered: solids that stand still, and groups of solids that move as one.

    Raises UnusableInput where the renderer is not installed.
    """

    def __init__(
        self,
        still: Iterable[Solid],
        moving: Sequence[Iterable[Solid]],
        light: Light,
        variant: str | None = None,
    ) -> None:
        self.variant = variant or default_variant()
        mi = mitsuba(self.variant)
        scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": BOUNCES + 1}}
        scene["sky"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(light.sky()),
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),  # from its up, y, to ours
        }
        if light.elevation > 0 and light.clouds < 1:
            # Every place asks one light, sun or sky. Asked as often as it gives, the noise of sunlit paint is least;
            # the sky a little oftener, for the shade.
            asked = min(1 - light.sky_irradiance / light.level_irradiance, OFTENEST)
            scene["sky"]["sampling_weight"] = 1 - asked
            towards = {"direction": (-light.direction).tolist()}
            irradiance = {"irradiance": _rgb(light.sun), "sampling_weight": asked}
            scene["sun"] = {"type": "directional", **towards, **irradiance}
        standing: dict[str, Any] = {}
        lamps: dict[str, Any] = {}
        for k, solid in enumerate(joined(still)):
            (lamps if solid.material.kind == "glow" else standing)[f"still{k}"] = _mesh(mi, f"still{k}", solid)
        scene |= lamps
        if standing:  # as one instance it is sorted for the rays once, and not whenever something moves
            scene["still"] = {"type": "shapegroup", **standing}
            scene["standing"] = {"type": "instance", "group": {"type": "ref", "id": "still"}}
        self._groups = [[(f"moving{g}_{k}", s) for k, s in enumerate(joined(group))] for g, group in enumerate(moving)]
        for name, solid in (pair for group in self._groups for pair in group):
            scene[name] = _mesh(mi, name, solid)
        self._scene = mi.load_dict(scene)
        self._parameters = mi.traverse(self._scene)

    def place(self, placements: Sequence[Placement]) -> None:
        """Moves each group to its placement."""
        mitsuba(self.variant)
        for group, (R, t) in zip(self._groups, placements, strict=True):
            for name, solid in group:
                key = f"{name}.vertex_positions"
                self._parameters[key] = _flat(solid.vertices @ np.asarray(R).T + t)
        self._parameters.update()

    def render(self, view: View, samples: int, seed: int, window: Window | None = None) -> Radiance:
        """Radiance (H, W, 3), linear, mean over each pixel's square, of the world as placed; of a ``window`` only.

        Lens distortion is left out: see `paceline.simulation.rendered.sensor`. The same seed gives the same picture.
        """
        mi = mitsuba(self.variant)
        sensor = self._sensor(mi, view, window or (0, 0, *view.camera.image_size))
        passes = [PASS] * (samples // PASS) + [n for n in (8, 4, 2, 1) if samples % PASS & n]
        seeds = np.random.SeedSequence(seed).generate_state(len(passes))
        total: Radiance | float = 0.0
        for count, own in zip(passes, seeds, strict=True):
            picture = mi.render(self._scene, sensor=sensor, spp=count, seed=int(own))
            total = total + np.array(picture, np.float32) * np.float32(count / samples)
        return np.asarray(total, np.float32)

    def distance(self, origin: Array, points: Array) -> Array:
        """Distance (N,) in metres from ``origin`` (3,) to the first surface towards each of ``points`` (N, 3);
        infinite where there is none."""
        mi = mitsuba(self.variant)
        towards = points - origin
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        if self.variant.startswith("scalar"):
            hits = [self._scene.ray_intersect_preliminary(mi.Ray3f(origin.tolist(), d.tolist())) for d in towards]
            return np.array([hit.t if hit.is_valid() else np.inf for hit in hits], float)
        rays = mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(*towards.T.astype(np.float32)))
        hit = self._scene.ray_intersect_preliminary(rays)
        return np.asarray(np.where(np.array(hit.is_valid()), np.array(hit.t), np.inf), float)

    def _sensor(self, mi: Any, view: View, window: Window) -> Any:
        (width, height), K = view.camera.image_size, view.camera.K
        to_world = np.eye(4)
        to_world[:3, :3], to_world[:3, 3] = view.R.T, view.centre
        film = {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "crop_offset_x": window[0],
            "crop_offset_y": window[1],
            "crop_width": window[2] - window[0],
            "crop_height": window[3] - window[1],
            "pixel_format": "rgb",
            "component_format": "float32",
            "rfilter": {"type": "box"},  # others add up in an order that differs from run to run
        }
        return mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(width / (2 * K[0, 0])))),
                "fov_axis": "x",
                "principal_point_offset_x": -(K[0, 2] + 0.5 - width / 2) / width,
                "principal_point_offset_y": -(K[1, 2] + 0.5 - height / 2) / height,
                "near_clip": 0.05,
                "far_clip": 1e5,
                "to_world": mi.ScalarTransform4f(to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])),
                "film": film,
                "sampler": {"type": "independent"},
            }
        )


def joined(solids: Iterable[Solid]) -> list[Solid]:
    """The same surfaces in as few solids as their materials allow."""
    alike: dict[tuple[int, bool, bool], list[Solid]] = {}
    for solid in solids:
        alike.setdefault((id(solid.material), solid.smooth, solid.uv is None), []).append(solid)
    return [_join(group) for group in alike.values()]


def _join(group: list[Solid]) -> Solid:
    first = group[0]
    offsets = np.cumsum([0] + [len(s.vertices) for s in group[:-1]])
    triangles = np.concatenate([s.triangles + o for s, o in zip(group, offsets, strict=True)])
    uv = None if first.uv is None else np.concatenate([s.uv for s in group if s.uv is not None])
    vertices = np.concatenate([s.vertices for s in group])
    return Solid(first.name, vertices, triangles, first.material, uv, first.smooth)


def _mesh(mi: Any, name: str, solid: Solid) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_surface(mi, solid.material, solid.uv is not None))
    if solid.material.kind == "glow":
        # Weight 0: it shines where it is seen, and is too weak beside the sun to be looked for as a source of light.
        emitter = {"type": "area", "radiance": _rgb(solid.material.color), "sampling_weight": 0.0}
        properties["emitter"] = mi.load_dict(emitter)
    mesh = mi.Mesh(
        name,
        len(solid.vertices),
        len(solid.triangles),
        has_vertex_normals=solid.smooth,
        has_vertex_texcoords=solid.uv is not None,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["faces"] = _flat(solid.triangles, np.uint32)
    parameters["vertex_positions"] = _flat(solid.vertices)
    if solid.uv is not None:
        parameters["vertex_texcoords"] = _flat(solid.uv)
    parameters.update()
    return mesh


def _flat(values: NDArray[Any], kind: type = np.float32) -> NDArray[Any]:
    return np.ascontiguousarray(values, kind).ravel()


def _surface(mi: Any, material: Material, textured: bool) -> dict[str, Any]:
    """The Mitsuba BSDF of a material, the same from both sides."""
    color: dict[str, Any] = _rgb(material.color)
    if textured and material.texture is not None:
        color = _bitmap(mi, material.texture)
    alpha = max(material.roughness, 0.02)
    kinds: dict[str, dict[str, Any]] = {
        "matte": {"type": "diffuse", "reflectance": color},
        "paint": {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": color, "distribution": "ggx"},
        "glass": {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": color, "distribution": "ggx"},
        "metal": {"type": "roughconductor", "alpha": alpha, "specular_reflectance": color, "material": "none"},
        "glow": {"type": "diffuse", "reflectance": _rgb((0.0, 0.0, 0.0))},
    }
    surface: dict[str, Any] = {"type": "twosided", "inner": kinds[material.kind]}
    if textured and material.alpha is not None:
        return {"type": "mask", "opacity": _bitmap(mi, material.alpha[..., None]), "inner": surface}
    return surface


def _rgb(color: Sequence[float] | Array) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(c) for c in color]}


def _bitmap(mi: Any, texture: NDArray[np.float32]) -> dict[str, Any]:
    return {
        "type": "bitmap",
        "data": mi.TensorXf(np.ascontiguousarray(texture, np.float32)),
        "raw": True,
        "filter_type": TEXTURE_FILTER,
        "wrap_mode": "repeat",
    }
