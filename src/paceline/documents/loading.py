"""Loads rig.yaml, clip.yaml, camera.yaml, target.yaml and follow.yaml, and checks them.

The results are plain: a :class:`~paceline.cameras.StereoRig`, a :class:`Clip` whose pixels are ideal ones
(undistorted), a :class:`FollowClip` whose pixels are those of the images as recorded.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from paceline.arrays import Array, Indices
from paceline.cameras import Camera, Quantity, RigUncertainty, StereoRig
from paceline.documents import plausibility
from paceline.documents.assumed_calibration import with_assumed_uncertainty
from paceline.documents.models import (
    CameraModel,
    ClipModel,
    ExactModel,
    FollowModel,
    PathModel,
    QuantityModel,
    RigModel,
    SiteModel,
    TargetModel,
    UncertaintyModel,
    VehicleModel,
    read_document,
    suggestion,
)
from paceline.errors import UnusableInput
from paceline.units import parse_speed

EXACTLY_ZERO = Quantity(0.0)


@dataclass(frozen=True, eq=False)
class PathDocument:
    """A drawn path: ``left`` (N, 2) and ``right`` (M, 2) ideal pixels, or ``points`` (K, 3) in metres."""

    name: str
    shape: Literal["line", "curve"]
    left: Array | None
    right: Array | None
    lateral_offset: float  # m, from the drawn line to the vehicle's centre line, positive to the right of travel
    points: Array | None
    limit: float | None = None  # m/s, the posted one on this path; None: that of the recording


@dataclass(frozen=True, eq=False)
class VehicleDocument:
    """A vehicle outlined in its first ``frame``: ``left`` and ``right`` (4, 2) ideal pixels, tl, tr, br, bl.

    ``displacement`` (3,) m is how far it moves from the left exposure of that frame to the right one.
    """

    id: str
    path: str | None
    frame: int
    left: Array
    right: Array
    plane: Literal["front", "side", "free"]
    speed: float | None  # m/s, a first guess
    displacement: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class Clip:
    """One stereo recording to measure, as clip.yaml describes it."""

    path: Path
    left: Path  # a folder, a pattern or a video
    right: Path
    rate: float | None  # frames per second
    times: Path | None
    tolerance: float | None  # s, between a left frame and its right one
    bit_depth: int | None  # bits used in 16-bit images
    rig: StereoRig
    paths: dict[str, PathDocument]
    vehicles: list[VehicleDocument]
    addresses: tuple[str, str]  # of both views, as live sources
    offset: Quantity | None = None  # s, to add to the right view's times; None where it is not known
    drawn_on: int | None = None  # the frame on which the paths were drawn; None: the first one
    rate_override: bool = False  # whether the rate is used in place of a video's own time stamps
    limit: float | None = None  # m/s, the posted one where a path states none of its own

    def with_limit(self, limit: float) -> Clip:
        """This clip with one ``limit`` (m/s) on all paths, whatever the files state."""
        paths = {name: replace(path, limit=None) for name, path in self.paths.items()}
        return replace(self, limit=limit, paths=paths)

    def limit_on(self, path: str | None) -> float | None:
        """The posted limit on the ``path`` of this name, m/s; None where none is stated."""
        drawn = self.paths.get(path or "")
        return self.limit if drawn is None or drawn.limit is None else drawn.limit


@dataclass(frozen=True, eq=False)
class TargetDocument:
    """The line model of a vehicle's rear: ``corners`` (C, 2) in metres, and ``segments`` (S, 2), two corners each."""

    name: str
    nominal_range: float  # m, the range at which the scale is 1
    corners: Array
    segments: Indices
    tolerance: float = 0.0  # m, standard deviation of the width that the lines have together
    width_assumed: bool = False  # whether nobody has stated how uncertain the width is

    @property
    def ends(self) -> Array:
        """Where the segments end, shape (2 S, 2), metres from the target's centre."""
        return self.corners[self.segments].reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class FollowClip:
    """One chase-camera recording, as follow.yaml describes it, with the operator's start."""

    path: Path
    video: str  # a folder, a pattern, a video file, a device or an address, relative paths resolved
    rate: float | None  # frames per second
    bit_depth: int | None  # bits used in 16-bit images
    camera: Camera
    target: TargetDocument
    frame: int  # the first frame to use
    center: Array  # (2,) pixels of the image as recorded
    scale: float
    odometry: Path | None
    wheelbase: float | None  # m, of the chase vehicle
    camera_ahead: float | None = None  # m from its rear axle to the camera
    lookahead: float | None = None  # s of driving to the point of the path that is pursued
    rate_override: bool = False  # whether the rate is used in place of a video's own time stamps


def load_rig(path: str | Path) -> StereoRig:
    """The rig that a rig.yaml describes; raises UnusableInput, naming the key, for one that cannot be."""
    path = Path(path)
    model = read_document(RigModel, path)
    left, right = _camera(path, "left.", model.left), _camera(path, "right.", model.right)
    _refuse(path, "rotation", plausibility.check_rotation(model.rotation))
    R = plausibility.nearest_rotation(model.rotation)
    rig = StereoRig(left, right, R, model.translation, scene_points=model.scene_points or 0)
    _refuse(path, "translation", plausibility.check_baseline(rig))
    if model.uncertainty is None:
        return with_assumed_uncertainty(rig)
    return replace(rig, uncertainty=_uncertainty(model.uncertainty))


def load_clip(path: str | Path) -> Clip:
    """The clip that a clip.yaml describes, with its rig; raises UnusableInput, naming the key, where it cannot be.

    Outlines of a vehicle in views that may not be exposed at the same instants are not compared with each other.
    """
    return clip_from_model(Path(path), read_document(ClipModel, Path(path)))


def clip_from_model(path: Path, model: ClipModel) -> Clip:
    """As `load_clip`, of the ``model`` that the file at ``path`` holds, or is to hold."""
    site, rig = _site(path, model)
    clip = _recording(path, model, rig)
    paths = {name: _path(path, clip.rig, name, p) for name, p in (model.paths or {}).items()}
    if model.site is not None and site is not None and site.paths:
        for name, p in site.paths.items():
            if name in paths:
                raise UnusableInput(f"{path}: paths.{name}: {model.site} has a path of this name; expected another")
            paths[name] = _path(path.parent / model.site, clip.rig, name, p)
    vehicles: list[VehicleDocument] = []
    for i, m in enumerate(model.vehicles or []):
        if any(m.id == v.id for v in vehicles):
            raise UnusableInput(f"{path}: vehicles[{i}].id: {m.id!r} occurs twice; expected one of its own")
        vehicle = _vehicle(path, clip.rig, paths, f"vehicles[{i}]", m)
        if model.synchronised:
            require_same_part(path, clip.rig, i, vehicle)
        vehicles.append(vehicle)
    limit = _limit(model.limit or (None if site is None else site.limit))
    return replace(clip, paths=paths, vehicles=vehicles, limit=limit)


def load_clip_recording(path: str | Path, rig: Path | None = None) -> Clip:
    """The clip of a clip.yaml without paths and vehicles, with its own rig or another: where a rig has moved, outlines
    drawn in both views contradict each other."""
    path = Path(path)
    model = read_document(ClipModel, path)
    return _recording(path, model, rig or _site(path, model)[1])


def rig_file(path: str | Path) -> Path:
    """The rig.yaml of a clip.yaml, its own or its site's."""
    path = Path(path)
    return _site(path, read_document(ClipModel, path))[1]


def _site(path: Path, model: ClipModel) -> tuple[SiteModel | None, Path]:
    """The site.yaml that a clip names, if any, and the rig.yaml of either. Raises UnusableInput unless one names it."""
    if model.site is None:
        if model.rig is None:
            raise UnusableInput(f"{path}: rig: missing; expected a rig.yaml, or a site that names one")
        return None, path.parent / model.rig
    if model.rig is not None:
        raise UnusableInput(f"{path}: rig and site: expected one of them, as a site names its own rig; found both")
    file = path.parent / model.site
    site = read_document(SiteModel, file)
    return site, file.parent / site.rig


def _recording(path: Path, model: ClipModel, rig: Path) -> Clip:
    if model.rate is not None and model.times is not None:
        raise UnusableInput(f"{path}: rate and times: expected one of them, found both")
    return Clip(
        path=path,
        left=path.parent / model.left,
        right=path.parent / model.right,
        rate=None if model.rate is None else model.rate.value,
        rate_override=model.rate is not None and model.rate.override,
        times=None if model.times is None else path.parent / model.times,
        tolerance=model.time_tolerance,
        bit_depth=model.bit_depth,
        rig=load_rig(rig),
        paths={},
        vehicles=[],
        addresses=(_address(path, model.left), _address(path, model.right)),
        offset=_offset(path, model),
        drawn_on=model.drawn_on,
    )


def _limit(stated: str | None) -> float | None:
    return None if stated is None else parse_speed(stated)


def _offset(path: Path, model: ClipModel) -> Quantity | None:
    """What to add to the right view's times, s; None where no key tells it."""
    stated = _quantity(model.offset)
    if model.synchronised and stated not in (None, EXACTLY_ZERO):
        _refuse(path, "offset", f"synchronised: true means exactly 0; {_found(stated)}")
    if stated is None and (model.synchronised or model.times is not None):
        return EXACTLY_ZERO
    return stated


def _address(path: Path, video: str) -> str:
    """Where a view can be reached: an address as it stands, anything else relative to the file that names it."""
    return video if "://" in video else str(path.parent / video)


def load_camera(path: str | Path) -> Camera:
    """The camera that a camera.yaml describes; raises UnusableInput, naming the key, for one that cannot be."""
    path = Path(path)
    return _camera(path, "", read_document(CameraModel, path))


def load_target(path: str | Path) -> TargetDocument:
    """The line model that a target.yaml describes; raises UnusableInput, naming the key, for one that cannot be."""
    path = Path(path)
    model = read_document(TargetModel, path)
    for i, (a, b) in enumerate(model.segments):
        _refuse(path, f"segments[{i}]", plausibility.check_segment(a, b, model.corners))
    place = {name: i for i, name in enumerate(model.corners)}
    corners = np.array(list(model.corners.values())).reshape(-1, 2)
    segments = np.array([[place[a], place[b]] for a, b in model.segments], np.int64).reshape(-1, 2)
    _refuse(path, "segments", plausibility.check_target(corners[segments]))
    assumed = model.tolerance is None or model.width_assumed is True
    return TargetDocument(model.name, model.nominal_range, corners, segments, model.tolerance or 0.0, assumed)


def load_follow(path: str | Path) -> FollowClip:
    """The chase-camera recording that a follow.yaml describes, with its camera and its target.

    Raises UnusableInput, naming the key, where it cannot be.
    """
    path = Path(path)
    model = read_document(FollowModel, path)
    camera = load_camera(path.parent / model.camera)
    target = load_target(path.parent / model.target)
    start = model.start
    ends = target.ends * camera.K[[0, 1], [0, 1]] / target.nominal_range
    if wrong := plausibility.check_start(start.center, start.scale, ends, camera.image_size):
        _refuse(path, f"start.{wrong[0]}", wrong[1])
    return FollowClip(
        path=path,
        video=_address(path, model.video),
        rate=None if model.rate is None else model.rate.value,
        rate_override=model.rate is not None and model.rate.override,
        bit_depth=model.bit_depth,
        camera=camera,
        target=target,
        frame=start.frame,
        center=start.center,
        scale=start.scale,
        odometry=None if model.odometry is None else path.parent / model.odometry,
        wheelbase=model.wheelbase,
        camera_ahead=model.camera_ahead,
        lookahead=model.lookahead,
    )


def _camera(file: Path, prefix: str, m: CameraModel) -> Camera:
    readout = _quantity(m.readout)
    if m.shutter == "global":
        if readout not in (None, EXACTLY_ZERO):
            _refuse(file, f"{prefix}readout", f"shutter: global means exactly 0; {_found(readout)}")
        readout = EXACTLY_ZERO
    camera = Camera((m.image_size[0], m.image_size[1]), m.K, np.array(m.distortion, float), readout)
    _refuse(file, f"{prefix}K", plausibility.check_intrinsics(camera))
    return camera


def _quantity(m: QuantityModel | None) -> Quantity | None:
    return None if m is None else Quantity(m.value, m.std)


def _found(quantity: Quantity) -> str:
    spread = f" ± {quantity.std:g}" if quantity.std else ""
    return f"expected one of them, found {quantity.value:g}{spread} as well"


def _uncertainty(u: UncertaintyModel) -> RigUncertainty | None:
    if isinstance(u, ExactModel):
        return None
    (a, b, c), (x, y, z) = u.rotation_rad, u.translation_m
    return RigUncertainty(u.focal_length_px, u.principal_point_px, (a, b, c), (x, y, z), u.covariance)


def _path(file: Path, rig: StereoRig, name: str, m: PathModel) -> PathDocument:
    key = f"paths.{name}"
    if m.points is not None:
        if m.left is not None or m.right is not None:
            raise UnusableInput(f"{file}: {key}: expected either points or left and right, found both")
        _refuse(file, f"{key}.points", plausibility.check_path_points(m.points))
        return PathDocument(name, m.shape, None, None, m.lateral_offset, m.points, _limit(m.limit))
    if m.left is None or m.right is None:
        drawn_sides = [side for side, drawn in (("left", m.left), ("right", m.right)) if drawn is not None]
        problem = f"drawn in the {drawn_sides[0]} view only" if drawn_sides else "not drawn"
        raise UnusableInput(f"{file}: {key}: {problem}; expected the same road line in both views, or points")
    for side, drawn in (("left", m.left), ("right", m.right)):
        _refuse(file, f"{key}.{side}", plausibility.check_drawing(drawn, m.shape))
    left, right = rig.left.undistort_points(m.left), rig.right.undistort_points(m.right)
    return PathDocument(name, m.shape, left, right, m.lateral_offset, None, _limit(m.limit))


def _vehicle(
    file: Path, rig: StereoRig, paths: Mapping[str, PathDocument], key: str, m: VehicleModel
) -> VehicleDocument:
    if m.path is not None and m.path not in paths:
        raise UnusableInput(f"{file}: {key}.path: no path is called {m.path!r}; {suggestion(m.path, list(paths))}")
    for side, corners, camera in (("left", m.left, rig.left), ("right", m.right, rig.right)):
        _refuse(file, f"{key}.{side}", plausibility.check_quadrilateral(corners, camera.image_size))
    left, right = rig.left.undistort_points(m.left), rig.right.undistort_points(m.right)
    plane = m.plane or ("free" if m.path is None else "front")
    return VehicleDocument(m.id, m.path, m.frame, left, right, plane, m.speed)


def require_same_part(file: Path, rig: StereoRig, i: int, vehicle: VehicleDocument) -> None:
    """Raise UnusableInput where both outlines of ``vehicle``, the ``i``-th in ``file``, cannot be of the same part."""
    apparent = rig.displaced(vehicle.displacement)
    _refuse(file, f"vehicles[{i}]", plausibility.check_views(apparent, vehicle.left, vehicle.right))


def _refuse(file: Path, key: str, complaint: str | None) -> None:
    if complaint is not None:
        raise UnusableInput(f"{file}: {key}: {complaint}")
