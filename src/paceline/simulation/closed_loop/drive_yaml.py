"""drive.yaml: the description of a closed loop and its requirements, read and checked."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AliasChoices, Field, model_validator

from paceline.documents.models import Document, read_document, suggestion
from paceline.errors import UnusableInput
from paceline.simulation.closed_loop.named_scenes import NAMED_SCENES
from paceline.simulation.vehicle_catalogue import RasterizedKind

Seconds = Annotated[float, Field(ge=0, le=7200)]
Metres = Annotated[float, Field(ge=0)]
Pairs = list[Annotated[list[float], Field(min_length=2, max_length=2)]]

MIN_TIME_STEP_S, MAX_LEAD_SPEED_MPS = 1e-3, 60.0  # s, the least between two speeds; m/s


class RoadModel(Document):
    """A winding road without turns tighter than ``radius``, or ``pieces``: metres, and radius to the right (0:
    straight)."""

    radius: Annotated[float, Field(ge=12)] | None = None
    pieces: Pairs | None = None
    blend: Annotated[float, Field(gt=0, le=200)] = 8.0

    @model_validator(mode="after")
    def _one_of_both(self) -> RoadModel:
        if (self.radius is None) == (self.pieces is None):
            raise ValueError("expected one of radius and pieces")
        for metres, radius in self.pieces or []:
            if metres <= 0 or (radius != 0 and abs(radius) < 12):
                raise ValueError(
                    f"pieces: expected metres above 0 and a radius of 12 m or more, found {[metres, radius]}"
                )
        return self


class LaneChangeModel(Document):
    """A move by ``shift`` m to the right, begun at time ``at`` and taking ``duration`` s at the speed there."""

    at: Seconds
    duration: Annotated[float, Field(ge=0.5, le=60)]
    shift: Annotated[float, Field(ge=-8, le=8)]


class WeaveModel(Document):
    """Swings of ``amplitude`` m to either side, ``period`` s each at the mean speed, from ``start`` to ``stop``, s."""

    start: Seconds
    stop: Seconds
    amplitude: Annotated[float, Field(ge=0, le=4)]
    period: Annotated[float, Field(ge=2, le=60)]


class LeadModel(Document):
    kind: RasterizedKind | None = None  # drawn otherwise
    speed: Pairs
    max_acceleration: Annotated[
        float, Field(validation_alias=AliasChoices("max_acceleration", "haste"), gt=0, le=5)
    ] = 2.0  # m/s², its strongest acceleration
    max_lateral_acceleration: Annotated[
        float, Field(validation_alias=AliasChoices("max_lateral_acceleration", "bends"), gt=0, le=5)
    ] = 1.8  # m/s² to the side, that it slows down to
    lane_changes: list[LaneChangeModel] = []
    weaves: list[WeaveModel] = []
    vanishes: Seconds | None = None

    @model_validator(mode="after")
    def _check_speeds(self) -> LeadModel:
        if not self.speed:
            raise ValueError("speed: expected at least one [seconds, metres per second]")
        times = [t for t, _ in self.speed]
        if any(b - a < MIN_TIME_STEP_S for a, b in zip(times, times[1:], strict=False)):
            raise ValueError("speed: expected times that increase")
        if not all(0 <= v <= MAX_LEAD_SPEED_MPS for _, v in self.speed):
            raise ValueError(f"speed: expected 0 to {MAX_LEAD_SPEED_MPS:g} m/s")
        return self


class CutInModel(Document):
    """A vehicle that overtakes, comes in between at ``at``, s, and goes away at ``until``; ``behind`` the lead, m."""

    at: Seconds
    until: Seconds
    kind: RasterizedKind = "van"
    duration: Annotated[float, Field(ge=1, le=20)] = 2.5
    behind: Annotated[float, Field(ge=1, le=60)] = 3.0


class CrossingModel(Document):
    at: Seconds
    duration: Annotated[float, Field(gt=0, le=10)] = 1.0
    kind: Literal["vehicle", "post"] = "vehicle"


class AppearanceModel(Document):
    """How the world looks, as in `ChaseScene`; what is not given is drawn by the seed."""

    paint: Annotated[float, Field(ge=0, le=255)] | None = None
    shadows: Annotated[float, Field(ge=0, le=3)] | None = None
    ambient: Annotated[float, Field(gt=0, le=1)] | None = None
    parallel_share: Annotated[
        Annotated[float, Field(ge=0, le=1)] | None, Field(validation_alias=AliasChoices("parallel_share", "parallel"))
    ] = None
    object_density: Annotated[
        Annotated[float, Field(ge=0, le=3)] | None, Field(validation_alias=AliasChoices("object_density", "crowding"))
    ] = None
    shake_px: Annotated[
        Annotated[float, Field(ge=0, le=10)] | None, Field(validation_alias=AliasChoices("shake_px", "bounce"))
    ] = None
    traffic: bool | None = None


class RequirementsModel(Document):
    """What must hold; null for what need not. No vehicle may be touched in any drive."""

    clearance: Annotated[float, Field(gt=0)] = 0.5  # m, least distance between the bodies
    rms_path_error: Metres | None = 0.3  # m
    max_path_error: Metres | None = 1.0
    rms_gap_error: Metres | None = None  # m, from the policy's desired gap
    max_gap: Metres | None = None
    lost: Annotated[int, Field(ge=0)] | None = 0  # times that the lead may be lost
    tracked: Annotated[float, Field(ge=0, le=1)] | None = 0.95  # least share of the frames that show the lead
    wrong: Annotated[int, Field(ge=0)] | None = 0  # frames in which something else may be followed
    stops_within: Metres | None = None  # m after it vanished
    ends: Literal["tracking", "standing", "either"] = "tracking"


class DriveModel(Document):
    """drive.yaml."""

    name: Annotated[str, Field(min_length=1, max_length=60)] = "drive"
    camera: Literal["nist", "hd"] = "nist"
    duration: Annotated[float, Field(ge=1, le=7200)]
    throttle: Literal["gap", "manual"] = "gap"
    headway: Annotated[float, Field(ge=0.4, le=5)] | None = None
    road: RoadModel
    lead: LeadModel
    cut_ins: list[CutInModel] = []
    crossings: list[CrossingModel] = []
    appearance: Annotated[AppearanceModel, Field(validation_alias=AliasChoices("appearance", "look"))] = (
        AppearanceModel()
    )
    requirements: Annotated[RequirementsModel, Field(validation_alias=AliasChoices("requirements", "must"))] = (
        RequirementsModel()
    )

    @model_validator(mode="after")
    def _fits(self) -> DriveModel:
        if not any(v > 0 for _, v in self.lead.speed):
            raise ValueError("lead.speed: expected a lead that moves")
        if self.requirements.stops_within is not None and self.lead.vanishes is None:
            raise ValueError("requirements.stops_within: expected a lead that vanishes (lead.vanishes)")
        return self


def load_drive(path: str | Path) -> DriveModel:
    """The closed loop that a drive.yaml describes; raises UnusableInput, naming the key, for one that cannot be."""
    return read_document(DriveModel, Path(path))


def resolve_drive(text: str, seed: int) -> DriveModel:
    """A named scene, or the document of that path. Raises UnusableInput for what is neither."""
    if text in NAMED_SCENES:
        return DriveModel.model_validate({"name": text, **NAMED_SCENES[text](np.random.default_rng([seed, 71]))})
    path = Path(text)
    if path.suffix in (".yaml", ".yml") or path.exists():
        return load_drive(path / "drive.yaml" if path.is_dir() else path)
    raise UnusableInput(f"{text}: no such scene; {suggestion(text, list(NAMED_SCENES))}")


def drive_document(model: DriveModel) -> dict[str, Any]:
    """The contents of a drive.yaml that says the same, without what is left to the defaults."""
    return model.model_dump(exclude_defaults=True)
