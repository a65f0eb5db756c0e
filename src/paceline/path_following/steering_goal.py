"""What a vehicle is steered for: the path that the vehicle ahead has driven, that vehicle itself, or nothing."""

from __future__ import annotations

from typing import Literal

SteeringGoal = Literal["path", "lead", "none"]
