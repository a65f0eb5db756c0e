"""What following gives: one estimate per frame, and the run's arrays as reports need them."""

from __future__ import annotations

from dataclasses import dataclass, field

from paceline.arrays import Array, Indices
from paceline.number_format import format_uncertain
from paceline.path_following.steering_goal import SteeringGoal
from paceline.units import COVERAGE_95


@dataclass(frozen=True, eq=False, repr=False)
class FollowEstimate:
    """Where the vehicle ahead is at one frame: pixels in the image as recorded, metres in the camera's axes.

    ``scale`` is 1 at the model's nominal range. ``weights`` (3,) are the confidences w_x, w_y, w_scale of [NIST]
    (15)–(17), 0 where nothing was measured. ``points`` (M, 2) are the edge points that were believed and ``owners``
    (M,) the segments they belong to; ``lines`` (S, 2, 2) is the model as estimated; ``window`` (x0, y0, x1, y1) is
    what was searched.
    """

    frame: int
    time: float
    center: Array  # (2,) px
    scale: float
    weights: Array  # (3,)
    position: Array  # (3,) m
    position_std: Array  # (3,) m
    bearing: float  # rad, positive to the right
    steering: float  # rad, positive to the right; NaN where nothing is steered for
    status: str  # tracking | coasting | lost
    reason: str  # why it does not track, or how it came to; empty otherwise
    residual: float  # px rms of the segments' offsets; NaN where nothing was measured
    lines: Array
    points: Array
    owners: Indices
    window: tuple[int, int, int, int]
    latency: float  # s, from the frame's arrival to this estimate; if it was looked at again, what that took

    def __repr__(self) -> str:
        """One line, without the lines and points."""
        x, y, z = (
            format_uncertain(value, COVERAGE_95 * std)
            for value, std in zip(self.position, self.position_std, strict=True)
        )
        reason = f" ({self.reason})" if self.reason else ""
        return (
            f"<FollowEstimate frame {self.frame}, {self.time:.3f} s: {self.status}{reason}, x {x}, y {y}, z {z} m, "
            f"95 %, steering {self.steering:+.4f} rad>"
        )


@dataclass(frozen=True)
class ModelWidth:
    """The width of a target's model and its standard deviation, m: every distance is as uncertain. ``assumed`` where
    nobody has stated the latter."""

    metres: float
    std: float
    assumed: bool


@dataclass(frozen=True, eq=False)
class FollowResult:
    """A whole run: one row per frame in every array."""

    clip: str
    target: str
    frame: Indices  # (F,)
    time: Array  # (F,) s
    center: Array  # (F, 2) px
    scale: Array  # (F,)
    weights: Array  # (F, 3)
    position: Array  # (F, 3) m
    position_std: Array  # (F, 3) m
    bearing: Array  # (F,) rad
    steering: Array  # (F,) rad
    status: list[str]
    reason: list[str]
    residual: Array  # (F,) px
    latency: Array  # (F,) s
    width: ModelWidth
    steering_goal: SteeringGoal
    assumed: dict[str, float]  # what the steering depends on and nobody has stated, by its key of follow.yaml
    configuration: dict[str, object]
    versions: dict[str, str]
    notices: list[str] = field(default_factory=list)
    seconds: float = 0.0
