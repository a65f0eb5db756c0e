"""The width of a vehicle as a person states it, with its uncertainty or without."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import isfinite

from paceline.errors import UnusableInput
from paceline.number_format import format_uncertain
from paceline.units import COVERAGE_95

MIN_WIDTH_M, MAX_WIDTH_M = 0.2, 10.0
ASSUMED_WIDTH_SHARE = 0.03  # half-width of the 95 % interval of a width that is stated without one
MAX_WIDTH_SHARE = 0.5  # greatest half-width: nothing is known of a vehicle whose width is more uncertain
WIDTH_PATTERN = re.compile(r"([^±+]+?)\s*(?:(?:±|\+/?-)\s*(.+))?")

# Widths of bodies without mirrors, m, with the half-width of an interval that contains nearly all of their kind
USUAL_WIDTHS = {
    "motorcycle": (0.85, 0.10),
    "small car": (1.70, 0.07),
    "car": (1.82, 0.06),
    "SUV": (1.89, 0.08),
    "van": (1.98, 0.09),
    "lorry, bus": (2.53, 0.05),
}


@dataclass(frozen=True)
class StatedWidth:
    """The true width of a vehicle's body, ``metres``, and the ``half_width`` of its 95 % interval, m; ``assumed`` where
    nobody has stated that."""

    metres: float
    half_width: float = 0.0
    assumed: bool = False

    @property
    def std(self) -> float:
        """Standard deviation, m."""
        return self.half_width / COVERAGE_95

    def __str__(self) -> str:
        return f"{format_uncertain(self.metres, self.half_width)} m"


def checked_width(metres: float, half_width: float | None = None) -> StatedWidth:
    """A width of ``metres`` ± ``half_width``; ASSUMED_WIDTH_SHARE of it where that is None. Raises UnusableInput."""
    if not MIN_WIDTH_M <= metres <= MAX_WIDTH_M:
        raise UnusableInput(f"--width {metres:g}: expected metres, {MIN_WIDTH_M:g} to {MAX_WIDTH_M:g}")
    if half_width is None:
        return StatedWidth(metres, ASSUMED_WIDTH_SHARE * metres, assumed=True)
    if not (isfinite(half_width) and 0 <= half_width <= MAX_WIDTH_SHARE * metres):
        raise UnusableInput(
            f"--width {metres:g}±{half_width:g}: expected an uncertainty of 0 to {MAX_WIDTH_SHARE * metres:g} m"
        )
    return StatedWidth(metres, half_width)


def parse_width(text: str) -> StatedWidth:
    """The width that ``text`` states: ``1.7``, or ``1.7±0.05`` or ``1.7+-0.05`` with its uncertainty, 95 %, in metres.

    Raises UnusableInput.
    """
    parts = WIDTH_PATTERN.fullmatch(text.strip())
    try:
        if parts is None:
            raise ValueError
        metres, half_width = float(parts[1]), None if parts[2] is None else float(parts[2])
    except ValueError:
        raise UnusableInput(f"--width {text}: expected metres, such as 1.7, 1.7±0.05 or 1.7+-0.05") from None
    return checked_width(metres, half_width)
