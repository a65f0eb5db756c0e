"""How a vehicle of a random scene has to be seen, however it is rendered."""

from __future__ import annotations

import numpy as np

MIN_VISIBLE_FRAMES = 8  # frames in which a vehicle is inside both pictures

# of vehicles on bends that cross the view
MIN_BEND_DEPTH_M, MAX_BEND_DEPTH_M = 15.0, 75.0  # m from the cameras
MAX_BEND_OBLIQUITY_RAD = np.radians(50.0)  # between the line of sight and the direction of travel
