"""Every knob of car following in one validated place: [NIST]'s constants, and one switch per remedy."""

from __future__ import annotations

from dataclasses import fields

from pydantic import BaseModel, ConfigDict, Field

from paceline.path_following.pure_pursuit import SteeringSettings
from paceline.path_following.steering_goal import SteeringGoal

# The settings of steering that a vehicle's own values replace, by what is steered for, with their keys of follow.yaml
VEHICLE_KEYS = {"wheelbase": "wheelbase", "camera_ahead": "camera_ahead", "lookahead_time": "lookahead"}
ASSUMED_FOR: dict[SteeringGoal, tuple[str, ...]] = {
    "path": tuple(VEHICLE_KEYS), "lead": ("wheelbase", "camera_ahead"), "none": (),
}  # fmt: skip


class FollowConfiguration(BaseModel):
    """How to follow. The resolved configuration is written beside the results.

    The paper prints the edge threshold, the direction's tolerance, the 0.3 of a length and the variance of 0.1; the
    gate and the decay it leaves open.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    # the remedies, each of which may be switched off
    subpixel: bool = True  # edge points between pixels
    polarity: bool = True  # learn for each feature which side of it is the brighter one
    wide_search: bool = True  # look for the whole model before its features, farther than the motion models reach
    predicted_gates: bool = True  # association gates from the predicted uncertainty instead of a constant
    competing_lines: bool = True  # several candidate lines per feature, robustly fitted
    faint_lines: bool = True  # features too faint for edge points, by the mean profile across them
    foreshortening: bool = True  # a target at an angle looks narrower
    rolling_shutter: bool = True  # the readout stretches heights while a vibrating camera nods
    adaptive_decay: bool = True  # two decays per parameter, weighed by how well they predicted of late
    probation: bool = True  # follow other places in which the model may lie, until one stands out
    appearance: bool = True  # learn what the target looks like, and do not believe what looks otherwise
    steady_scale: bool = True  # the size by the picture, and by the edges only what size that has
    keepsake: bool = True  # a picture learned long ago tells when the lock has slid along other edges
    snapshot: bool = True  # where too few features show, what the target looked like once tells where it is
    continuity: bool = True  # do not believe what leaps or flies

    # the method
    edge_threshold: float = Field(4.0, ge=0, le=255)  # grey levels of 255
    direction_tolerance: float = Field(25.0, gt=0, lt=45)  # δ of (7), degrees
    gate: float = Field(5.0, gt=0)  # ζ, px: the constant one, and where nothing is known yet
    minimum_share: float = Field(0.3, gt=0, le=1)  # of a feature's predicted length that must be matched
    variance_floor: float = Field(0.1, gt=0)  # px², (14)
    model_tolerance: float = Field(0.01, ge=0)  # m by which a feature's true place may differ from the model's
    relief_tolerance: float = Field(0.2, ge=0)  # m by which horizontal ones, as a bumper, may stand off the rear plane
    decay: float = Field(0.8, gt=0, lt=1)  # λ of (18) for c_x and c_y, for each 1/15 s
    scale_decay: float = Field(0.85, gt=0, lt=1)  # λ for the scale
    slow_decay: float = Field(0.95, gt=0, lt=1)  # λ of the second models, where the decay is adaptive
    slow_scale_decay: float = Field(0.95, gt=0, lt=1)

    # when to believe
    coast_limit: float = Field(2.0, ge=0)  # s without a sight of the target before it is lost
    jump_limit: float = Field(1.0, gt=0)  # s between two frames beyond which nothing is predicted

    # steering
    steering: SteeringGoal | None = (
        None  # along the lead's path or towards the lead; None: the path if there is odometry
    )
    wheelbase: float = Field(2.8, gt=0)  # m, of the chase vehicle
    camera_ahead: float = 1.5  # m from its rear axle to the camera
    lookahead_time: float = Field(0.8, ge=0)  # s of driving to the point that is pursued
    lookahead_min: float = Field(3.0, gt=0)  # m
    lookahead_max: float = Field(20.0, gt=0)  # m
    steering_limit: float = Field(0.6, gt=0, lt=1.5)  # rad

    def steering_settings(self) -> SteeringSettings:
        """What of it steers."""
        return SteeringSettings(**{field.name: getattr(self, field.name) for field in fields(SteeringSettings)})

    def assumed(self) -> dict[str, float]:
        """The defaults that the steering angle depends on and nobody has stated, by their keys of follow.yaml, SI."""
        names = ASSUMED_FOR[self.steering or "path"]
        return {VEHICLE_KEYS[name]: getattr(self, name) for name in names if name not in self.model_fields_set}

    @classmethod
    def as_published(cls) -> FollowConfiguration:
        """The paper's method, with every remedy off."""
        return cls(
            edge_threshold=8.0,
            direction_tolerance=15.0,
            subpixel=False,
            polarity=False,
            wide_search=False,
            predicted_gates=False,
            competing_lines=False,
            faint_lines=False,
            foreshortening=False,
            rolling_shutter=False,
            adaptive_decay=False,
            probation=False,
            appearance=False,
            steady_scale=False,
            keepsake=False,
            snapshot=False,
            continuity=False,
        )
