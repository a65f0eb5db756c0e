"""Where everything lies in a GPU's memory: what its kernels and those who launch them agree on.

The particles of all vehicles share one *pool* (2, ROWS, columns) of float64: a vehicle has some columns of it, a
particle is one column, and every number of its state a row, so that the threads of a warp read side by side. A vehicle
is in one half of the pool; resampling takes it to the other.

What is to be done with the vehicles stands on the *desk*: orders, a table (slots, ORDER), and after them the noise that
was drawn for them. What they look at are *sights*, a header and a table (slots, SIGHT). Both are float64 and flat. A
vehicle keeps its slot; a slot whose COUNT is 0 is free. What all came to is *told*: see `weights.survey`.
"""

from __future__ import annotations

import numpy as np

# --- rows of the pool ----------------------------------------------------------------------------------------------

LEFT, RIGHT, NORMAL, DISTANCE, SPEED, S, HEADING, VELOCITY, TURNING = 0, 8, 16, 19, 20, 21, 22, 24, 27
STATE = 30  # rows of the state itself
# what follows from the state and is asked for by the filter: where the planes' centres are, in space and in both views
PLACE, CROSSING_LEFT, CROSSING_RIGHT = 30, 33, 35
MOVING = 37  # rows that a survivor takes along
LOG_WEIGHT, WEIGHT, CUMULATED, LIKELIHOOD = range(37, 41)
UNWEIGHED = 41  # the log weights before they were last updated
ROWS = 42

# --- orders --------------------------------------------------------------------------------------------------------

FIRST, COUNT = 0, 1  # the vehicle's columns
BEFORE, NOW = 2, 3  # half of the pool it is in before the orders are carried out, and after
RESAMPLED, SQUARED, MOVED, CORRECTED = range(4, 8)  # whether it is to be, one after the other
PREPARED = 8  # whether anything is to be done, if only to make the maps by which the likelihood samples
FREE, TURNS = 9, 10  # the motion: without a path, along one that turns
RIG, KNOTS, KNOT_COUNT = 11, 12, 13  # rows of the tables of rigs and of knots
DT, DRIFT = 14, 15  # s; m, across and down
OFFSET, SPREAD, MEAN = 17, 18, 20  # of resampling: u, and of the headings their spread and the survivors' mean
TOWARDS = 22  # (3,) the normal that planes are set square to
STEP = 25  # (10, 3) the Kalman step: the place seen, the root of its covariance, the gain of centre and linear rows
KEY = 55  # (4,) of the generator that counts, by 32 bits
DRAWS = 59  # (DRAWN, 2) of each kind of noise, its place in the desk, or −1 − the call that counts it, and its sigma
DRAWN, STIRRING, MOVING_NOISE, SEEN_NOISE = 7, 0, 1, 6
AT_HOME = DRAWS + 2 * DRAWN  # the vehicle's first column among all that are fetched
EVERY = AT_HOME + 1  # so many-th particle is told
ORDER = EVERY + 1

# --- sights --------------------------------------------------------------------------------------------------------

LEFT_FRAME, RIGHT_FRAME = 0, 4  # (4,) height, width, and place (x, y) of the first pixel of a packed image
WORDS = 8  # (2,) how many words of pixels each image has
FLOOR, CAP, LAMBDA_SINGLE, LAMBDA_CROSS = range(10, 14)
HEADER = 14
MOST_PARTS = 16
TIMES = 3  # 1 where a vehicle is weighed, −1 where that is taken back; FIRST, COUNT and BEFORE are as in the orders
GRID = 4  # (4,) parts across and down, samples a block (x, y)
REFERENCE = 8  # (2, parts, 16)
SIGHT = REFERENCE + 2 * MOST_PARTS * 16

# --- what is told --------------------------------------------------------------------------------------------------

_PLACES = (PLACE, PLACE + 1, PLACE + 2)
SPREADS = (CROSSING_LEFT, CROSSING_LEFT + 1, SPEED, HEADING, HEADING + 1)  # rows whose variance is asked for
LINEAR = ((SPEED, HEADING, HEADING + 1), (VELOCITY, VELOCITY + 1, VELOCITY + 2))  # what a place seen corrects: by FREE
PAIRS = np.array(
    [
        [(row, -1) for row in range(MOVING)]
        + [(row, row) for row in SPREADS]
        + [(row, place) for row in (*_PLACES, *linear) for place in _PLACES]
        for linear in LINEAR
    ],
    np.int32,
)
"""(2, pairs, 2), by FREE: rows whose first moment is asked for, with −1, then pairs whose second moment is."""
MOMENTS = PAIRS.shape[1]
SQUARES = MOMENTS  # the quantity Σ W²
EXTREMES = SQUARES + 1  # the first of NORMAL quantities: the least and greatest of a region's coordinate
QUANTITIES = EXTREMES + NORMAL
SHOWN_ROWS = 4  # of the planes' projected centres, from CROSSING_LEFT on

KNOT = 14  # numbers of a path's knot: arc length, roll, and the cubic of each coordinate from there on (3, 4)
MAPS = 39  # what the likelihood samples a particle by: three homographies and the four edges of the right region
