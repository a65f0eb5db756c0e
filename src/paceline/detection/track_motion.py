"""How what was tracked moves along its lane, and the parts of a track in which it does not stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from paceline.arrays import Array
from paceline.robust_line import theil_sen_slope

MIN_TRAVEL_M_PX = 1.5, 1.5  # along the lane, m, or px of disparity if that is more: what travels less is stationary
STAND_REACH_M_PX, MIN_STAND_S = (0.75, 0.75), 1.0  # what stands stays within so much for so long
# between two stands: both places are uncertain, and of a long track many parts are looked at
MIN_TRAVEL_BETWEEN_STANDS_M_PX = 5.0, 3.0


@dataclass(frozen=True, eq=False)
class TrackMotion:
    """Places along a lane, ``arc_lengths`` (N,) m, at ``times`` (N,) s, where ``pixels`` (N,) m correspond to one pixel
    of disparity."""

    times: Array
    arc_lengths: Array
    pixels: Array

    def part(self, detections: slice) -> TrackMotion:
        """The motion of some of the detections."""
        return TrackMotion(self.times[detections], self.arc_lengths[detections], self.pixels[detections])

    @property
    def speed(self) -> float:
        """Mean speed along the lane, m/s; NaN for a single detection."""
        return theil_sen_slope(self.times, self.arc_lengths)

    @property
    def travel(self) -> float:
        """Distance travelled along the lane, m, from the medians of the first and of the last third."""
        s = self.arc_lengths
        third = -(-len(s) // 3)
        return float(np.median(s[-third:]) - np.median(s[:third])) * (len(s) - 1) / max(len(s) - third, 1)

    def exceeds(self, least: tuple[float, float]) -> bool:
        """Whether the travel is ``least`` or more, m, and px of disparity."""
        min_m, min_px = least
        return len(self.times) > 1 and abs(self.travel) >= max(min_m, min_px * self._middle_pixel)

    @property
    def unsteadiness(self) -> float:
        """The residual of a motion of constant acceleration over that of one jump between two fixed places: near 0 for
        a vehicle, above 1 for what sways between two places."""
        s = self.arc_lengths
        jumping = min(_absolute_deviation(s[:k]) + _absolute_deviation(s[k:]) for k in range(1, len(s)))
        return float(np.abs(self._smooth_residuals).sum()) / max(jumping, 1e-9)

    @property
    def roughness_px(self) -> float:
        """RMS residual about the best motion of constant acceleration, px of disparity."""
        return float(np.sqrt(np.mean(self._smooth_residuals**2))) / self._middle_pixel

    @property
    def _middle_pixel(self) -> float:
        return float(self.pixels[len(self.pixels) // 2])

    @property
    def _smooth_residuals(self) -> Array:
        t, s = self.times - self.times[0], self.arc_lengths
        return np.asarray(s - np.polyval(np.polyfit(t, s, 2), t))

    def stands(self) -> list[slice]:
        """The detections, from one to the next, between which it stands for `MIN_STAND_S` or longer."""
        reach = np.maximum(STAND_REACH_M_PX[0], STAND_REACH_M_PX[1] * self.pixels)
        result, first = [], 0
        while first < len(self.times):
            end, low, high = first, self.arc_lengths[first], self.arc_lengths[first]
            while end < len(self.times):
                low, high = min(low, self.arc_lengths[end]), max(high, self.arc_lengths[end])
                if high - low > reach[first]:
                    break
                end += 1
            if self.times[end - 1] - self.times[first] >= MIN_STAND_S:
                result.append(slice(first, end))
                first = end
            else:
                first += 1
        return result

    def drives(self) -> list[slice]:
        """The detections between those in which it stands, where it travels for far enough; none where it never stands.
        A vehicle may come to a stand or drive off from one."""
        stands = self.stands()
        ends = [0, *(end for stand in stands for end in (stand.start, stand.stop)), len(self.times)]
        parts = [slice(a, b) for a, b in zip(ends[::2], ends[1::2], strict=True)] if stands else []
        return [part for part in parts if self.part(part).exceeds(MIN_TRAVEL_BETWEEN_STANDS_M_PX)]


def _absolute_deviation(s: Array) -> float:
    return float(np.abs(s - np.median(s)).sum())
