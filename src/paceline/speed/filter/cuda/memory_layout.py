"""Layout of the GPU's memory, shared by the kernels and the code that launches them.

The particles of all vehicles share one *pool* (2, ROW_COUNT, columns) of float64: a vehicle has a range of columns, a
particle is one column, and each number of its state a row, so that the threads of a warp read adjacent memory. A
vehicle's current particles are in one half of the pool; resampling moves them to the other.

The *command buffer* holds the commands, a table (slots, COMMAND_SIZE) with one row for each vehicle, and after them the
noise that was drawn on the CPU. The *observations* are a header and a table (slots, OBSERVATION_SIZE): the inputs of
the likelihood of each vehicle. Both are flat arrays of float64. A vehicle keeps its slot; a slot whose PARTICLE_COUNT
is 0 is free. The *results* are the outputs of `weights.reduce_moments`.
"""

from __future__ import annotations

import numpy as np

# --- rows of the pool ----------------------------------------------------------------------------------------------

LEFT_REGION_ROW, RIGHT_REGION_ROW, NORMAL_ROW, DISTANCE_ROW = 0, 8, 16, 19
SPEED_ROW, ARC_LENGTH_ROW, HEADING_ROW, VELOCITY_ROW, TURN_RATE_ROW = 20, 21, 22, 24, 27
STATE_ROW_COUNT = 30  # rows of the state itself
# derived from the state: the planes' centres in space, and in both views
CENTRE_ROW, LEFT_CROSSING_ROW, RIGHT_CROSSING_ROW = 30, 33, 35
CARRIED_ROW_COUNT = 37  # rows that resampling copies
LOG_WEIGHT_ROW, WEIGHT_ROW, CUMULATIVE_WEIGHT_ROW, LIKELIHOOD_ROW = range(37, 41)
PREVIOUS_LOG_WEIGHT_ROW = 41  # before the last update
ROW_COUNT = 42

# --- commands ------------------------------------------------------------------------------------------------------

FIRST_COLUMN, PARTICLE_COUNT = 0, 1  # the vehicle's columns
HALF_BEFORE, HALF_AFTER = 2, 3  # half of the pool that the particles are in before the commands are executed, and after
RESAMPLE, SET_NORMAL, PROPAGATE, KALMAN_UPDATE = range(4, 8)  # 1 to execute the step; in this order
IS_ACTIVE = 8  # 1 if anything is to be done, at least the preparation of the likelihood's sampling maps
IS_FREE, IS_CURVE = 9, 10  # the motion model: without a path; along a curve
RIG_INDEX, KNOT_TABLE_INDEX, KNOT_COUNT = 11, 12, 13  # rows of the tables of rigs and of knots
TIME_STEP, DRIFT_STD = 14, 15  # s; standard deviations of the drift, m, sideways and down
RESAMPLING_OFFSET = 17  # u of systematic resampling
HEADING_STD, MEAN_HEADING = 18, 20  # (2,) of the particles' headings; of those of the survivors
TARGET_NORMAL = 22  # (3,) of SET_NORMAL
KALMAN_STEP = 25  # (13, 3) the measured place, the Cholesky factor of its covariance, the gain
IS_COORDINATED_TURN = 64  # without a path: whether the velocity turns with the plane
GENERATOR_KEY = 65  # (4,) of the counter-based generator, 32 bits each
NOISE_SOURCES = 69  # (NOISE_KINDS, 2) for each kind: index in the command buffer or −1 − generator call; sigma
NOISE_KINDS, JITTER_KIND, PROCESS_NOISE_KIND, MEASUREMENT_NOISE_KIND = 7, 0, 1, 6
HOST_COLUMN = NOISE_SOURCES + 2 * NOISE_KINDS  # the vehicle's first column when all are downloaded
DRAWN_STRIDE = HOST_COLUMN + 1  # n, where every n-th particle is returned for drawing
COMMAND_SIZE = DRAWN_STRIDE + 1

# --- observations --------------------------------------------------------------------------------------------------

LEFT_FRAME, RIGHT_FRAME = 0, 4  # (4,) height, width, and first pixel (x, y) of a packed image
WORD_COUNTS = 8  # (2,) number of words of each packed image
CONTRAST_FLOOR_INDEX, DISTANCE_CAP_INDEX, LAMBDA_SINGLE_INDEX, LAMBDA_CROSS_INDEX = range(10, 14)
HEADER_SIZE = 14
MAX_PARTS = 16
# 1 to update the weights, −1 to restore them; FIRST_COLUMN, PARTICLE_COUNT and HALF_BEFORE are as in the commands
WEIGHT_UPDATE = 3
PART_GRID = 4  # (4,) parts across and down, samples of a block (x, y)
REFERENCE_FEATURES = 8  # (2, parts, 16)
OBSERVATION_SIZE = REFERENCE_FEATURES + 2 * MAX_PARTS * 16

# --- results -------------------------------------------------------------------------------------------------------

CENTRE_ROWS = (CENTRE_ROW, CENTRE_ROW + 1, CENTRE_ROW + 2)
VARIANCE_ROWS = (LEFT_CROSSING_ROW, LEFT_CROSSING_ROW + 1, SPEED_ROW, HEADING_ROW, HEADING_ROW + 1)
# rows of the state that the Kalman update corrects, by IS_FREE; along a path there are fewer, and the last is repeated
CORRECTED_ROWS = (
    (SPEED_ROW, HEADING_ROW, HEADING_ROW + 1, HEADING_ROW + 1, HEADING_ROW + 1, HEADING_ROW + 1),
    (*range(VELOCITY_ROW, VELOCITY_ROW + 3), *range(TURN_RATE_ROW, TURN_RATE_ROW + 3)),
)
MOMENT_PAIRS = np.array(
    [
        [(row, -1) for row in range(CARRIED_ROW_COUNT)]
        + [(row, row) for row in VARIANCE_ROWS]
        + [(row, measured) for row in (*CENTRE_ROWS, *corrected) for measured in CENTRE_ROWS]
        for corrected in CORRECTED_ROWS
    ],
    np.int32,
)
"""(2, pairs, 2), by IS_FREE: rows whose first moment is computed, with −1, then pairs of rows for second moments."""
MOMENT_COUNT = MOMENT_PAIRS.shape[1]
SUM_OF_SQUARES = MOMENT_COUNT  # the quantity Σ W²
FIRST_EXTREME = SUM_OF_SQUARES + 1  # of NORMAL_ROW quantities: least and greatest values of the regions' coordinates
QUANTITY_COUNT = FIRST_EXTREME + NORMAL_ROW
DRAWN_ROW_COUNT = 4  # of the planes' projected centres, from LEFT_CROSSING_ROW on

KNOT_SIZE = 14  # numbers of a path's knot: arc length, roll, and the cubic of each coordinate from there on (3, 4)
SAMPLING_MAP = 39  # numbers: the three homographies and four edges by which the likelihood samples a particle
