"""Images of meshes by path tracing: Mitsuba behind three calls, in the camera model of `paceline.cameras`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.cameras import PosedCamera
from paceline.simulation.raytraced.light import Light
from paceline.simulation.raytraced.meshes import Material, Placement, SceneMesh
from paceline.simulation.raytraced.mitsuba_variant import default_variant, load_mitsuba
from paceline.simulation.raytraced.ray_generation import Radiance, Window, window_renderer

__all__ = ["PosedCamera", "Radiance", "Renderer", "Window", "merge_meshes"]


MAX_BOUNCES = 3  # what comes after lights no place that a picture shows
MAX_SUN_SAMPLING_SHARE = 0.75  # share of the rays towards lights that go to the sun
SAMPLES_PER_PASS = 16  # samples per pixel rendered at once, a power of two so that they always add up in the same order
TEXTURE_FILTER = "bilinear"


class Renderer:
    """A world ready to be rendered: solids that stand still, and groups of solids that move as one.

    Lamps may only be among what stands still. Raises UnusableInput where the renderer is not installed.
    """

    def __init__(
        self,
        still: Iterable[SceneMesh],
        moving: Sequence[Iterable[SceneMesh]],
        light: Light,
        variant: str | None = None,
    ) -> None:
        self.variant = variant or default_variant()
        mi = load_mitsuba(self.variant)
        scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": MAX_BOUNCES + 1}}
        scene["sky"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(light.sky_radiance()),
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),  # from its up, y, to ours
        }
        if light.elevation > 0 and light.clouds < 1:
            # Every place asks one light, sun or sky. Asked as often as it gives, the noise of sunlit paint is least;
            # the sky a little oftener, for the shade.
            sun_share = min(1 - light.sky_irradiance / light.level_irradiance, MAX_SUN_SAMPLING_SHARE)
            scene["sky"]["sampling_weight"] = 1 - sun_share
            towards = {"direction": (-light.direction).tolist()}
            irradiance = {"irradiance": _rgb(light.sun_irradiance), "sampling_weight": sun_share}
            scene["sun"] = {"type": "directional", **towards, **irradiance}
        solids = merge_meshes(still)
        scene |= {f"lamp{k}": _mesh(mi, f"lamp{k}", s) for k, s in enumerate(solids) if s.material.kind == "glow"}
        scene |= _instance(mi, "still", [s for s in solids if s.material.kind != "glow"])
        for g, group in enumerate(moving):
            scene |= _instance(mi, f"moving{g}", merge_meshes(group))
        self._moving = [f"moving{g}.to_world" for g in range(len(moving))]
        self._scene = mi.load_dict(scene)
        self._parameters = mi.traverse(self._scene)
        self._parameters.keep(self._moving)
        self._take = window_renderer(mi, self._scene)
        self._placed: Array = np.empty(0)

    def place(self, placements: Sequence[Placement]) -> None:
        """Moves each group to its placement."""
        matrices = np.array([np.column_stack(placement) for placement in placements])
        if np.array_equal(matrices, self._placed):
            return
        mi, self._placed = load_mitsuba(self.variant), matrices
        for key, place in zip(self._moving, matrices, strict=True):
            self._parameters[key] = mi.ScalarTransform4f(np.vstack([place, [0.0, 0.0, 0.0, 1.0]]))
        self._parameters.update()

    def render(self, view: PosedCamera, samples: int, seed: int, window: Window | None = None) -> Radiance:
        """Radiance (H, W, 3), linear, mean over each pixel's square, of the world as placed; of a ``window`` only.

        Lens distortion is left out: see `paceline.simulation.raytraced.sensor`. The same seed gives the same picture.
        """
        load_mitsuba(self.variant)
        window = window or (0, 0, *view.camera.image_size)
        passes = [SAMPLES_PER_PASS] * (samples // SAMPLES_PER_PASS) + [
            n for n in (8, 4, 2, 1) if samples % SAMPLES_PER_PASS & n
        ]
        seeds = np.random.SeedSequence(seed).generate_state(len(passes))
        total: Radiance | float = 0.0
        for count, pass_seed in zip(passes, seeds, strict=True):
            picture = self._take(view.camera, view.R, view.t, window, count, int(pass_seed))
            total = total + picture * np.float32(count / samples)
        return np.asarray(total, np.float32)

    def distance(self, origin: Array, points: Array) -> Array:
        """Distance (N,) in metres from ``origin`` (3,) to the first surface towards each of ``points`` (N, 3);
        infinite where there is none."""
        mi = load_mitsuba(self.variant)
        towards = points - origin
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        if self.variant.startswith("scalar"):
            hits = [self._scene.ray_intersect_preliminary(mi.Ray3f(origin.tolist(), d.tolist())) for d in towards]
            return np.array([hit.t if hit.is_valid() else np.inf for hit in hits], float)
        rays = mi.Ray3f(mi.Point3f(*origin.tolist()), mi.Vector3f(*towards.T.astype(np.float32)))
        hit = self._scene.ray_intersect_preliminary(rays)
        return np.asarray(np.where(np.array(hit.is_valid()), np.array(hit.t), np.inf), float)


def merge_meshes(solids: Iterable[SceneMesh]) -> list[SceneMesh]:
    """The same surfaces in as few solids as their materials allow."""
    groups: dict[tuple[int, bool, bool], list[SceneMesh]] = {}
    for solid in solids:
        groups.setdefault((id(solid.material), solid.smooth, solid.uv is None), []).append(solid)
    return [_merge_group(group) for group in groups.values()]


def _merge_group(group: list[SceneMesh]) -> SceneMesh:
    first = group[0]
    offsets = np.cumsum([0] + [len(s.vertices) for s in group[:-1]])
    triangles = np.concatenate([s.triangles + o for s, o in zip(group, offsets, strict=True)])
    uv = None if first.uv is None else np.concatenate([s.uv for s in group if s.uv is not None])
    vertices = np.concatenate([s.vertices for s in group])
    return SceneMesh(first.name, vertices, triangles, first.material, uv, first.smooth)


def _instance(mi: Any, name: str, solids: Sequence[SceneMesh]) -> dict[str, Any]:
    """Entries of a scene for solids that move as one."""
    if not solids:
        return {}
    meshes = {f"{name}-{k}": _mesh(mi, f"{name}-{k}", solid) for k, solid in enumerate(solids)}
    shape = {"type": "ref", "id": f"{name}-shape"}
    return {f"{name}-shape": {"type": "shapegroup", **meshes}, name: {"type": "instance", "shape": shape}}


def _mesh(mi: Any, name: str, solid: SceneMesh) -> Any:
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_bsdf(mi, solid.material, solid.uv is not None))
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
    parameters["faces"] = _flatten(solid.triangles, np.uint32)
    parameters["vertex_positions"] = _flatten(solid.vertices)
    if solid.uv is not None:
        parameters["vertex_texcoords"] = _flatten(solid.uv)
    parameters.update()
    return mesh


def _flatten(values: NDArray[Any], kind: type = np.float32) -> NDArray[Any]:
    return np.ascontiguousarray(values, kind).ravel()


def _bsdf(mi: Any, material: Material, textured: bool) -> dict[str, Any]:
    """The Mitsuba BSDF of a material, the same from both sides; `Material` describes the kinds.

    Vehicles, roads and scenery share these kinds: "paint" is any coat under clear varnish, also plastic, and "glass" is
    the same BSDF, of a dark color. `vehicles.materials` has the parameters of the vehicles' materials.
    """
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
