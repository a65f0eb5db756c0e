"""Outputs of object detectors as boxes around vehicles: the common layouts, identified by their shapes.

Overlapping boxes are not suppressed: only whether a pixel lies in any box matters.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from paceline.arrays import Array

Outputs = list[NDArray[np.generic]]

MIN_CONSTANT_OBJECTNESS = 0.25  # in a plain picture, where other detectors see nothing
MAX_BOXES = 1000  # boxes of an image that are kept, those with the highest scores
MAX_NORMALISED_PX = 1.5  # boxes that all lie within it are fractions of the input's size
CELL_STRIDES_PX = 8, 16, 32  # of the grids whose cells raw outputs have a row each for
VEHICLE_WORDS = {
    "ambulance", "bus", "car", "coach", "lorry", "minibus", "motor", "motorbike", "motorcycle", "pickup", "rickshaw",
    "scooter", "suv", "taxi", "tractor", "trailer", "tricycle", "truck", "van", "vehicle",
}  # fmt: skip
COCO_VEHICLE_CLASSES = {
    80: (2, 3, 5, 7),
    91: (3, 4, 6, 8),
}  # car, motorcycle, bus and truck where there are so many classes
EXPECTED_OUTPUTS = (
    "expected one output (1, N, 6), (1, 4 + classes, N) or (1, N, 5 + classes), "
    "or three: boxes (N, 4), labels (N) and scores (N)"
)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Boxes (N, 4): left, top, right and bottom, px of the input, with their ``scores`` and ``classes`` (N,)."""

    boxes: Array
    scores: Array
    classes: Array


@dataclass(frozen=True, eq=False)
class OutputLayout:
    """How to ``read`` the outputs of a detector, the value of ``white`` in its input, and its number of ``classes``
    where the outputs contain it."""

    read: Callable[[Outputs], Candidates]
    white: float = 1.0
    classes: int | None = None


def output_layout(outputs: Outputs, size: tuple[int, int]) -> OutputLayout | None:
    """The layout of the ``outputs`` for a uniform image of ``size`` (width, height); None for an unknown one."""
    if not all(np.issubdtype(output.dtype, np.number) for output in outputs):
        return None
    if len(outputs) == 3 and (order := _list_order(outputs)):
        return OutputLayout(lambda arrays: _from_lists(*(arrays[k] for k in order)))
    tables = [k for k, output in enumerate(outputs) if output.ndim == 3 and len(output) == 1]
    if len(tables) != 1:
        return None
    index = tables[0]
    _, rows, columns = outputs[index].shape
    cells = sum((size[0] // stride) * (size[1] // stride) for stride in CELL_STRIDES_PX)
    if columns == 6 and rows < cells:
        return OutputLayout(lambda arrays: _from_rows(_table(arrays, index)))
    if 5 <= rows < columns:
        return OutputLayout(lambda arrays: _from_class_scores(_table(arrays, index).T), classes=rows - 4)
    if not 6 <= columns < rows:
        return None
    if rows != cells:
        return OutputLayout(lambda arrays: _from_objectness(_table(arrays, index)), classes=columns - 5)
    table, grid = _table(outputs, index), _cell_grid(size)  # a row for each cell, as YOLOX and YOLOv6 have it
    if table[:, 2:4].min() < 0:  # logarithms of sizes, and places in the cell: as YOLOX leaves them
        return OutputLayout(
            lambda arrays: _from_objectness(_decode_cells(_table(arrays, index), grid)), 255.0, columns - 5
        )
    has_constant_objectness = table[:, 4].min() > MIN_CONSTANT_OBJECTNESS  # only that of YOLOv6, 1 everywhere
    white = 1.0 if has_constant_objectness else 255.0
    return OutputLayout(lambda arrays: _from_objectness(_table(arrays, index)), white, columns - 5)


def vehicle_classes(names: dict[int, str] | None, count: int | None) -> Array | None:
    """The indices of the vehicle classes among ``count``, by their ``names`` where these are known; None: all of
    them."""
    if names is not None:
        return np.array([k for k, name in names.items() if _is_vehicle(name)], float)
    return np.array(COCO_VEHICLE_CLASSES[count], float) if count in COCO_VEHICLE_CLASSES else None


def select_boxes(candidates: Candidates, classes: Array | None, size: tuple[int, int], min_score: float) -> Array:
    """The boxes (N, 4) with at least ``min_score``, of these ``classes``, in px of an input of ``size`` (width,
    height)."""
    boxes, scores = candidates.boxes, candidates.scores
    scoring = (scores >= min_score) & np.isfinite(boxes).all(1) & (boxes[:, 2:] > boxes[:, :2]).all(1)
    if scoring.any() and np.abs(boxes[scoring]).max() <= MAX_NORMALISED_PX:
        boxes = boxes * np.tile(size, 2)
    if classes is not None:
        scoring &= np.isin(candidates.classes, classes)
    selected = np.flatnonzero(scoring)
    return boxes[selected[np.argsort(-scores[selected], kind="stable")[:MAX_BOXES]]]


def _is_vehicle(name: str) -> bool:
    """Whether the last word of a class's name is a vehicle's: of a police car, but not of a car wheel."""
    words = re.findall(r"[a-z]+", name.lower())
    return bool(words) and any(words[-1].removesuffix(plural) in VEHICLE_WORDS for plural in ("", "s", "es"))


def _list_order(outputs: Outputs) -> tuple[int, int, int] | None:
    """Which of three outputs are the boxes (N, 4), the labels (N) and the scores (N)."""
    is_integer = [np.issubdtype(output.dtype, np.integer) for output in outputs]
    boxes = [k for k, output in enumerate(outputs) if output.ndim == 2 and output.shape[1] == 4]
    labels = [k for k, output in enumerate(outputs) if output.ndim == 1 and is_integer[k]]
    scores = [k for k, output in enumerate(outputs) if output.ndim == 1 and not is_integer[k]]
    separate = len(boxes) == len(labels) == len(scores) == 1 and len({len(output) for output in outputs}) == 1
    return (boxes[0], labels[0], scores[0]) if separate else None


def _table(outputs: Outputs, index: int) -> Array:
    return np.asarray(outputs[index][0], float)


def _from_lists(boxes: NDArray[np.generic], labels: NDArray[np.generic], scores: NDArray[np.generic]) -> Candidates:
    return Candidates(np.asarray(boxes, float), np.asarray(scores, float), np.asarray(labels, float))


def _from_rows(rows: Array) -> Candidates:
    """From rows of left, top, right, bottom, score and class."""
    return Candidates(rows[:, :4], rows[:, 4], rows[:, 5])


def _from_class_scores(rows: Array) -> Candidates:
    """From rows of a centre, width and height, and a score for each class."""
    centre, half = rows[:, :2], rows[:, 2:4] / 2
    boxes = np.concatenate([centre - half, centre + half], axis=1)
    return Candidates(boxes, rows[:, 4:].max(1), rows[:, 4:].argmax(1).astype(float))


def _from_objectness(rows: Array) -> Candidates:
    """As `_from_class_scores`, from rows that hold an objectness before the scores."""
    return _from_class_scores(np.concatenate([rows[:, :4], rows[:, 4:5] * rows[:, 5:]], axis=1))


def _cell_grid(size: tuple[int, int]) -> Array:
    """Column, row and stride (N, 3) of the cells in a picture, those of the smallest stride first."""
    cells = []
    for stride in CELL_STRIDES_PX:
        y, x = np.mgrid[: size[1] // stride, : size[0] // stride]
        cells.append(np.stack([x.ravel(), y.ravel(), np.full(x.size, stride)], axis=1))
    return np.concatenate(cells).astype(float)


def _decode_cells(rows: Array, grid: Array) -> Array:
    stride = grid[:, 2:]
    return np.concatenate([(rows[:, :2] + grid[:, :2]) * stride, np.exp(rows[:, 2:4]) * stride, rows[:, 4:]], axis=1)
