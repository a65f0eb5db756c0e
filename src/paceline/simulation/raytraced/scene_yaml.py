"""scene.yaml: worlds to render, read and checked. Metres, seconds, radians and pixels."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AliasChoices, Field, model_validator

from paceline.documents.models import Document, Name, Rate, Size, UncertaintyModel, read_document
from paceline.simulation.camera_errors import CameraErrors, StereoErrors
from paceline.simulation.operator import OPERATOR_NOISE
from paceline.simulation.vehicle_catalogue import RaytracedKind

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0)]
Angle = Annotated[float, Field(ge=-0.1, le=0.1)]
Pixels = Annotated[float, Field(ge=-100, le=100)]


class RoadModel(Document):
    """`simulation.road.RoadShape`, the road's ``length`` and what draws its wear."""

    kind: Literal["straight", "circle", "clothoid", "winding"] = "straight"
    radius: float | None = None
    grade: float = 0.0
    bank: float = 0.0
    crest_radius: float | None = None
    lanes: Count = 2
    lane_width: Positive = 3.6
    shoulder: Annotated[float, Field(ge=0)] = 1.5
    markings: Literal["dashed", "solid", "none"] = "dashed"
    wear: Share = 0.3
    length: Annotated[float, Field(ge=20, le=20000)] = 250.0


class LightModel(Document):
    """The sun's ``azimuth``, counted to the left of the road's first direction, and ``elevation``; ``clouds`` from 0
    to 1."""

    azimuth: float = 2.4
    elevation: Annotated[float, Field(ge=0.02, le=1.5708)] = 0.75
    clouds: Share = 0.15


class SceneryModel(Document):
    """`scenery.placement.Scenery`: how densely things stand beside the road."""

    trees: Share = 0.35
    poles: Share = 0.3
    buildings: Share = 0.15
    parapet: bool = False


class LaneChangeModel(Document):
    """A move by ``shift``, positive to the right of growing arc length."""

    start: float
    duration: Positive
    shift: float


class VehicleModel(Document):
    """A vehicle: its ``lane`` counted from the left of growing arc length, its ``offset`` to the right of that lane's
    middle, the arc length ``start`` at time 0. ``oncoming`` drives it to smaller arc length. ``measured`` ones stand in
    clip.yaml, with a first ``initial_speed`` of their speed where one is given."""

    id: Name
    kind: RaytracedKind = "saloon"
    seed: Seed = 0
    lane: Annotated[int, Field(ge=0)] = 0
    offset: float = 0.0
    start: float
    speed: Annotated[float, Field(ge=0, le=100)]
    acceleration: Annotated[float, Field(ge=-12, le=12)] = 0.0
    acceleration_start: Annotated[float, Field(validation_alias=AliasChoices("acceleration_start", "after"))] = 0.0
    acceleration_duration: Annotated[
        Positive | None, Field(validation_alias=AliasChoices("acceleration_duration", "lasting"))
    ] = None
    lane_change: LaneChangeModel | None = None
    oncoming: Annotated[bool, Field(validation_alias=AliasChoices("oncoming", "towards"))] = False
    measured: bool = True
    initial_speed: Annotated[Positive | None, Field(validation_alias=AliasChoices("initial_speed", "guess"))] = None


class PositionModel(Document):
    """A place by arc length, lateral position to the right of the road's axis, and height above its surface."""

    along: float
    right: float
    height: float


class RigSceneModel(Document):
    """Two cameras ``baseline`` apart. The left one stands at ``eye`` and looks at ``target``; the right one does so up
    to random rotations of ``misalignment`` (standard deviation, rad). ``rig_error_std`` are standard deviations of the
    parameters in rig.yaml from the true ones; with ``states_uncertainty`` rig.yaml states them, too, or that there are
    none."""

    image_size: Annotated[list[Size], Field(min_length=2, max_length=2)] = [1024, 768]
    focal: Positive = 2200.0
    baseline: Positive = 0.5
    eye: PositionModel
    target: PositionModel
    misalignment: Annotated[float, Field(ge=0, le=0.05)] = 0.004
    distortion: list[float] = []
    rig_error_std: Annotated[
        UncertaintyModel | None, Field(validation_alias=AliasChoices("rig_error_std", "written"))
    ] = None
    states_uncertainty: Annotated[bool, Field(validation_alias=AliasChoices("states_uncertainty", "stated"))] = True

    @model_validator(mode="after")
    def _count_coefficients(self) -> RigSceneModel:
        if len(self.distortion) not in (0, 4, 5):
            raise ValueError(f"distortion: expected 4 or 5 coefficients, found {len(self.distortion)}")
        return self


class SensorModel(Document):
    """`sensor.Sensor` and `sensor.Shutter`, its exposure ``shutter_s``; the lens's ``blur_sigma`` (px); how pictures
    are kept: ``png``, ``jpeg`` or ``h264``, with ``quality`` from 1 to 100."""

    exposure: Positive = 1.2
    full_well: Positive = 8000.0
    read_noise: Annotated[float, Field(ge=0)] = 12.0
    vignetting: Share = 0.15
    gamma: Annotated[float, Field(ge=1, le=4)] = 2.2
    color: bool = False
    blur_sigma: Annotated[float, Field(ge=0.3, le=5)] = 0.55
    shutter_s: Annotated[float, Field(validation_alias=AliasChoices("shutter_s", "open_for"), ge=0, le=1)] = 0.001
    steps: Count = 1
    readout: Annotated[float, Field(ge=0, le=1)] = 0.0
    bands: Count = 1
    image_format: Annotated[
        Literal["png", "jpeg", "h264"], Field(validation_alias=AliasChoices("image_format", "keep"))
    ] = "png"
    quality: Annotated[int, Field(ge=1, le=100)] = 90


class CameraErrorsModel(Document):
    """`camera_errors.CameraErrors` of one camera. A ``readout`` that is not given is that of `SensorModel`; one that is
    given is rendered in as many bands as it takes."""

    readout: Annotated[float, Field(ge=-1, le=1)] | None = None
    zoom: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.0
    turn: Annotated[list[Angle], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]
    drift: Annotated[list[Pixels], Field(min_length=2, max_length=2)] = [0.0, 0.0]
    knock: Annotated[list[Pixels], Field(min_length=2, max_length=2)] = [0.0, 0.0]
    knock_frame: Annotated[int, Field(ge=0)] = 0
    dirt: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    rain: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    exposure_step: Annotated[float, Field(gt=-1, le=4)] = 0.0
    exposure_frame: Annotated[int, Field(ge=0)] = 0

    def errors(self, readout: float) -> CameraErrors:
        """As a dataclass, with the sensor's ``readout`` where there is none."""
        values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in self.model_dump().items()}
        return CameraErrors(**values | ({"readout": readout} if self.readout is None else {}))


class StereoErrorsModel(Document):
    """`camera_errors.StereoErrors`: what is not ideal about the cameras, and no file of the clip says."""

    left: CameraErrorsModel = CameraErrorsModel()
    right: CameraErrorsModel = CameraErrorsModel()
    offset: Annotated[float, Field(ge=-2, le=2)] = 0.0
    rate_ppm: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    sway: Annotated[float, Field(ge=0, le=0.02)] = 0.0
    crf: Annotated[int, Field(ge=0, le=51)] | None = None

    @staticmethod
    def of(errors: StereoErrors) -> StereoErrorsModel:
        return StereoErrorsModel.model_validate(asdict(errors), strict=False)

    def errors(self, readout: float) -> StereoErrors:
        """As a dataclass, with the sensor's ``readout`` for cameras that have none."""
        left, right = (camera.errors(readout) for camera in (self.left, self.right))
        return StereoErrors(left, right, self.offset, self.rate_ppm, self.sway, self.crf)


class OperatorNoiseModel(Document):
    """Standard deviations (px) of drawn corners and of the drawn points of a line, and the number of these points."""

    corner: Annotated[float, Field(ge=0, le=20)] = OPERATOR_NOISE.corner_px
    line: Annotated[float, Field(ge=0, le=20)] = OPERATOR_NOISE.line_px
    points: Annotated[int, Field(ge=4)] = 20


class SceneModel(Document):
    """What every scene has. ``samples`` are rays per pixel."""

    seed: Seed = 0
    frames: Annotated[int, Field(ge=1)]
    rate: Rate
    samples: Annotated[int, Field(ge=1, le=4096)] = 16
    road: RoadModel = RoadModel()
    light: LightModel = LightModel()
    scenery: SceneryModel = SceneryModel()
    sensor: SensorModel = SensorModel()


class SpeedScene(SceneModel):
    """A stereo rig beside a road. Pictures of the ticks ``dropped`` are missing; the right camera fires ``skew`` s
    after the left, and ``camera_errors`` are what no file of the clip says."""

    kind: Literal["speed"]
    vehicles: Annotated[list[VehicleModel], Field(min_length=1)]
    rig: RigSceneModel
    operator_noise: Annotated[OperatorNoiseModel, Field(validation_alias=AliasChoices("operator_noise", "clicks"))] = (
        OperatorNoiseModel()
    )
    dropped: list[Annotated[int, Field(ge=0)]] = []
    skew: Annotated[float, Field(ge=-0.1, le=0.1)] = 0.0
    camera_errors: StereoErrorsModel = StereoErrorsModel()

    @property
    def is_video(self) -> bool:
        """Whether pictures are kept as videos, whose time stamps are those of the clip."""
        return self.sensor.image_format == "h264" or self.camera_errors.crf is not None

    @model_validator(mode="after")
    def _check(self) -> SpeedScene:
        for i, car in enumerate(self.vehicles):
            if car.lane >= self.road.lanes:
                raise ValueError(f"vehicles[{i}].lane: expected one of 0 to {self.road.lanes - 1}, found {car.lane}")
            if any(car.id == other.id for other in self.vehicles[:i]):
                raise ValueError(f"vehicles[{i}].id: {car.id!r} occurs twice; expected one of its own")
        if self.rig.distortion:
            if self.sensor.readout:
                raise ValueError("sensor.readout and rig.distortion: expected one of them at most")
            if self.camera_errors.left.readout or self.camera_errors.right.readout:
                raise ValueError("camera_errors and rig.distortion: expected no readout of a lens with distortion")
        if not any(car.measured for car in self.vehicles):
            raise ValueError("vehicles: none is measured; expected at least one")
        return self


class LeadModel(Document):
    """The vehicle ahead: it keeps within ``gap`` (m) of the camera and weaves by up to ``weave`` (m)."""

    kind: RaytracedKind = "van"
    seed: Seed = 0
    gap: Annotated[list[Positive], Field(min_length=2, max_length=2)] = [5.0, 15.0]
    weave: Annotated[float, Field(ge=0, le=3)] = 0.5


class ChaseModel(Document):
    """The vehicle that carries the camera, at half of ``top_speed`` (m/s) to the whole of it; ``shake_px`` as in
    `chase.scene.ChaseScene`."""

    image_size: Annotated[list[Size], Field(min_length=2, max_length=2)] = [256, 242]
    focal: Positive = 300.0
    height: Positive = 2.1
    tilt: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.05
    top_speed: Annotated[float, Field(gt=0, le=60)] = 9.7
    shake_px: Annotated[float, Field(validation_alias=AliasChoices("shake_px", "bounce"), ge=0, le=20)] = 3.0


class FollowScene(SceneModel):
    """A camera on a vehicle that drives behind another."""

    kind: Literal["follow"]
    lead: LeadModel = LeadModel()
    chase: ChaseModel = ChaseModel()
    samples: Annotated[int, Field(ge=1, le=4096)] = 8

    @model_validator(mode="after")
    def _check(self) -> FollowScene:
        if self.lead.gap[0] >= self.lead.gap[1]:
            raise ValueError(f"lead.gap: expected a smaller and a larger distance, found {self.lead.gap}")
        return self


def load_speed_scene(path: str | Path) -> SpeedScene:
    """The speed scene in a file; raises UnusableInput, naming the key, for anything else."""
    return read_document(SpeedScene, Path(path))


def load_follow_scene(path: str | Path) -> FollowScene:
    """The follow scene in a file; raises UnusableInput, naming the key, for anything else."""
    return read_document(FollowScene, Path(path))
