"""The closed loop: the simulated vehicle carries the camera, and the tracker's estimates steer and brake it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array
from paceline.follow.configuration import FollowConfiguration
from paceline.follow.results import FollowEstimate
from paceline.follow.tracker import FollowTracker
from paceline.simulation.chase.clip import ChaseTruth, start_document, target_document, truth_of
from paceline.simulation.chase.motion import RoadPose as Placed
from paceline.simulation.chase.renderer import Renderer
from paceline.simulation.chase.scene import ChaseScene
from paceline.simulation.chase.vehicles import Body
from paceline.simulation.chase.world import WorldState
from paceline.simulation.closed_loop.clearance import outline_distance, vehicle_outline
from paceline.simulation.closed_loop.drive_yaml import DriveModel
from paceline.simulation.closed_loop.gap_control import GapController
from paceline.simulation.closed_loop.human_throttle import HumanThrottle
from paceline.simulation.closed_loop.odometer import Odometer, OdometerErrors
from paceline.simulation.closed_loop.scene import DriveScene
from paceline.simulation.closed_loop.vehicle_dynamics import Command, VehicleDynamics, VehicleParameters, VehicleState
from paceline.targets.line_model import Target

LATENCY_S = 0.128  # s from picture to command, [NIST] section 3
VISIBILITY_MARGIN_M = 1.0  # m by which a person keeps farther off than the whole rear needs to be in view
MAX_HUMAN_GAP_M = {"nist": 15.0, "hd": 45.0}  # m, the longest that a driver keeps


@dataclass(frozen=True, eq=False)
class LoopStep:
    """One cycle of the loop: the picture, what was made of it, and how things really were. SI units."""

    frame: int
    time: float
    image: NDArray[np.uint8]
    estimate: FollowEstimate
    truth: ChaseTruth
    chase: VehicleState
    lead: Placed
    lead_speed: float
    command: Command  # of this picture, and when it takes effect
    gap: float  # from the camera to the lead's rear, along the camera's axis
    desired_gap: float  # by the throttle, at this speed
    path_error: float  # of the rear axle, to the right of the lead's path
    clearance: float  # between the bodies: to the lead, or to another vehicle that is nearer
    lead_present: bool  # the lead is there to be seen


class ClosedLoop:
    """``for step in ClosedLoop(model, seed).steps(): ...``; nothing is kept of the cycles before."""

    def __init__(
        self,
        model: DriveModel,
        seed: int,
        latency: float = LATENCY_S,
        vehicle: VehicleParameters | None = None,
        configuration: FollowConfiguration | None = None,
        errors: OdometerErrors | None = None,
    ) -> None:
        self.vehicle = vehicle or VehicleParameters()
        self.model, self.seed, self.latency = model, seed, latency
        self.scene = DriveScene(model, seed, self.vehicle)
        v = self.vehicle
        vehicle_settings = {
            "wheelbase": v.wheelbase,
            "camera_ahead": v.camera_ahead,
            "steering_limit": v.steering_limit,
        }
        self.configuration = (configuration or FollowConfiguration()).model_copy(update=vehicle_settings)
        self.errors = errors or OdometerErrors()

    @property
    def frames(self) -> int:
        return self.scene.chase_scene.frames

    def settings(self) -> dict[str, object]:
        """Everything that was set, resolved."""
        return {
            "latency": self.latency,
            "vehicle": asdict(self.vehicle),
            "gap_policy": asdict(self.scene.policy),
            "odometer_errors": asdict(self.errors),
            "follow": self.configuration.model_dump(),
        }

    def steps(self) -> Iterator[LoopStep]:
        """Every cycle, in order."""
        placed, scene = self.scene, self.scene.chase_scene
        rng = np.random.default_rng([self.seed, 79])
        plant, renderer = VehicleDynamics(self.vehicle, placed.start()), Renderer(placed.world)
        odometer = Odometer(self.errors, rng, plant.state.speed)
        controller = GapController(placed.policy)
        nearest = placed.policy.standstill + VISIBILITY_MARGIN_M
        operator = HumanThrottle(placed.policy, (nearest, MAX_HUMAN_GAP_M[self.model.camera]), rng)
        manual = self.model.throttle == "manual"
        tracker: FollowTracker | None = None
        lead_arc = placed.lead.start
        for frame in range(scene.frames):
            time = frame / scene.rate
            chase = plant.advance(time)
            state = placed.state_at(time, chase, lead_arc)
            lead_arc = state.chase.arc
            image, visible = renderer.render(state)
            truth = truth_of(scene, frame, state, visible)
            tracker = tracker or start_tracker(scene, truth, self.configuration)
            pose = odometer.read(time, placed.pose(time, chase))
            e = tracker.update(image, time, frame, pose)
            gap, lead_speed = float(truth.position[2]), placed.lead.speed_at(time)
            if manual:
                throttle = operator.acceleration(time, chase.speed, gap, lead_speed)
                desired_gap = operator.desired_gap(time, chase.speed)
            else:
                tracked = e.status == "tracking"
                throttle = controller.acceleration(
                    time, odometer.speed, float(e.position[2]), float(e.position_std[2]), tracked
                )
                desired_gap = placed.policy.desired_gap(chase.speed)
            command = Command(time + self.latency, e.steering, throttle)
            plant.queue(command)
            error, _ = placed.lead.path_offset(chase.x, chase.y, lead_arc - self.vehicle.camera_ahead)
            yield LoopStep(
                frame=frame,
                time=time,
                image=image,
                estimate=e,
                truth=truth,
                chase=chase,
                lead=state.lead,
                lead_speed=lead_speed,
                command=command,
                gap=gap,
                desired_gap=desired_gap,
                path_error=error,
                clearance=self._clearance(chase, state),
                lead_present=state.lead_present,
            )

    def _clearance(self, chase: VehicleState, state: WorldState) -> float:
        v = self.vehicle
        chase_outline = vehicle_outline(chase.x, chase.y, chase.heading, -v.tail, v.nose, v.width)
        world = self.scene.world
        others: list[tuple[Body, Placed]] = [(world.body, state.lead)] if state.lead_present else []
        others += zip(world.other_vehicles, state.other_vehicles, strict=True)
        return min(
            (outline_distance(chase_outline, _body_outline(body, place)) for body, place in others),
            default=float("nan"),
        )


def _body_outline(body: Body, place: Placed) -> Array:
    return vehicle_outline(place.x, place.y, place.heading, 0.0, body.length, body.width)


def start_tracker(scene: ChaseScene, first: ChaseTruth, configuration: FollowConfiguration) -> FollowTracker:
    """A tracker started on the first picture as an operator would start it."""
    document, start = target_document(scene), start_document(scene, first)
    names = list(document["corners"])
    corners = np.array(list(document["corners"].values()))
    segments = np.array([[names.index(a), names.index(b)] for a, b in document["segments"]])
    target = Target(document["name"], document["nominal_range"], corners, segments)
    return FollowTracker(scene.camera, target, (*start["center"], start["scale"]), configuration)
