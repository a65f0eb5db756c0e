"""Layout of the GPU's memory, shared by the kernels and the code that launches them.

The particles of all vehicles share one *pool* (2, ROWS, columns) of float64: a vehicle has a range of columns, a
particle is one column, and each number of its state a row, so that the threads of a warp read adjacent memory. A
vehicle's current particles are in one half of the pool; resampling moves them to the other.

The *command buffer* holds the commands, a table (slots, COMMAND) with one row for each vehicle, and after them the
noise that was drawn on the CPU. The *observations* are a header and a table (slots, OBSERVATION): what the likelihood
of each vehicle needs. Both are flat arrays of float64. A vehicle keeps its slot; a slot whose COUNT is 0 is free. The
*results* are what `weights.reduce_moments` writes.
"""

from __future__ import annotations

import numpy as np

# --- rows of the pool ----------------------------------------------------------------------------------------------

LEFT, RIGHT, NORMAL, DISTANCE, SPEED, S, HEADING, VELOCITY, TURNING = 0, 8, 16, 19, 20, 21, 22, 24, 27
STATE = 30  # rows of the state itself
# derived from the state: the planes' centres in space and in both views
CENTRE, CROSSING_LEFT, CROSSING_RIGHT = 30, 33, 35
CARRIED_ROWS = 37  # rows that resampling copies
LOG_WEIGHT, WEIGHT, CUMULATIVE_WEIGHT, LIKELIHOOD = range(37, 41)
PREVIOUS_LOG_WEIGHT = 41  # before the last update
ROWS = 42

# --- commands ------------------------------------------------------------------------------------------------------

FIRST, COUNT = 0, 1  # the vehicle's columns
HALF_BEFORE, HALF_AFTER = 2, 3  # half of the pool that the particles are in before the commands are executed, and after
RESAMPLE, SET_NORMAL, PROPAGATE, KALMAN_UPDATE = range(4, 8)  # whether to do so, in this order
PREPARE = 8  # whether there is anything to do, if only to prepare the sampling maps of the likelihood
IS_FREE, IS_CURVE = 9, 10  # the motion model: without a path; along a curve
RIG, KNOTS, KNOT_COUNT = 11, 12, 13  # rows of the tables of rigs and of knots
DT, DRIFT = 14, 15  # s; standard deviations of the drift, m, sideways and down
OFFSET, HEADING_STD, MEAN_HEADING = 17, 18, 20  # of resampling: u; of the headings, and of the survivors' headings
TARGET_NORMAL = 22  # (3,) of SET_NORMAL
KALMAN_STEP = 25  # (10, 3) the measured centre, the Cholesky factor of its covariance, the gain
KEY = 55  # (4,) of the counter-based generator, 32 bits each
NOISE = 59  # (NOISE_KINDS, 2) of each kind its index in the command buffer, or −1 − its call, and its sigma
NOISE_KINDS, JITTER, PROCESS_NOISE, MEASUREMENT_NOISE = 7, 0, 1, 6
HOST_COLUMN = NOISE + 2 * NOISE_KINDS  # the vehicle's first column when all are downloaded
DRAWN_STRIDE = HOST_COLUMN + 1  # every so many-th particle is returned for drawing
COMMAND = DRAWN_STRIDE + 1

# --- observations --------------------------------------------------------------------------------------------------

LEFT_FRAME, RIGHT_FRAME = 0, 4  # (4,) height, width, and first pixel (x, y) of a packed image
WORDS = 8  # (2,) number of words of each packed image
FLOOR, CAP, LAMBDA_SINGLE, LAMBDA_CROSS = range(10, 14)
HEADER = 14
MAX_PARTS = 16
WEIGHT_UPDATE = 3  # 1 to update the weights, −1 to restore them; FIRST, COUNT and HALF_BEFORE are as in the commands
GRID = 4  # (4,) parts across and down, samples of a block (x, y)
REFERENCE = 8  # (2, parts, 16)
OBSERVATION = REFERENCE + 2 * MAX_PARTS * 16

# --- results -------------------------------------------------------------------------------------------------------

_CENTRE_ROWS = (CENTRE, CENTRE + 1, CENTRE + 2)
VARIANCE_ROWS = (CROSSING_LEFT, CROSSING_LEFT + 1, SPEED, HEADING, HEADING + 1)
# rows of the state that the Kalman update corrects, by IS_FREE
CORRECTED_ROWS = ((SPEED, HEADING, HEADING + 1), (VELOCITY, VELOCITY + 1, VELOCITY + 2))
MOMENT_PAIRS = np.array(
    [
        [(row, -1) for row in range(CARRIED_ROWS)]
        + [(row, row) for row in VARIANCE_ROWS]
        + [(row, centre) for row in (*_CENTRE_ROWS, *corrected) for centre in _CENTRE_ROWS]
        for corrected in CORRECTED_ROWS
    ],
    np.int32,
)
"""(2, pairs, 2), by IS_FREE: rows whose first moment is computed, with −1, then pairs of rows for second moments."""
MOMENT_COUNT = MOMENT_PAIRS.shape[1]
SUM_OF_SQUARES = MOMENT_COUNT  # the quantity Σ W²
FIRST_EXTREME = SUM_OF_SQUARES + 1  # of NORMAL quantities: least and greatest values of the regions' coordinates
QUANTITY_COUNT = FIRST_EXTREME + NORMAL
DRAWN_ROWS = 4  # of the planes' projected centres, from CROSSING_LEFT on

KNOT_SIZE = 14  # numbers of a path's knot: arc length, roll, and the cubic of each coordinate from there on (3, 4)
SAMPLING_MAP = 39  # numbers: the three homographies and four edges by which the likelihood samples a particle
