"""An object detector that the user provides: a neural network in an ONNX file, run by ONNX Runtime on the CPU."""

from __future__ import annotations

import ast
import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from paceline.arrays import Array, Image
from paceline.detection.onnx_outputs import EXPECTED_OUTPUTS, Outputs, output_layout, select_boxes, vehicle_classes
from paceline.errors import UnusableInput
from paceline.processor_cores import max_threads
from paceline.speed.configuration import DEFAULTS

if TYPE_CHECKING:
    from onnxruntime import InferenceSession, NodeArg


INFERENCE_THREADS = 2  # more hardly help small networks, and the measurement needs some too
DEFAULT_SIDE_PX, ACCEPTED_SIDES_PX = 640, range(32, 8193)  # of an input of any size; of any input
PADDING_GREY = 114.0  # beside an image whose aspect ratio differs from the input's
FLOAT_TYPES: dict[str, type[np.floating]] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
LOG_FATAL_ONLY = 4  # log level of ONNX Runtime: errors are raised as well
MAX_NAMES_LENGTH = 1_000_000  # characters of the class names
MAX_QUOTED_LENGTH = 300  # characters quoted from a file in a message
ERROR_PREFIX = re.compile(  # source lines and file names in the errors of ONNX Runtime
    r".*\[ONNXRuntimeError\] : \d+ : \w+ : |Load model from .*? failed:|/\S+\.(?:h|cc):\d+ .*?\) (?:const )?"
)


class OnnxDetector:
    """Detects vehicles in images by the network in the ONNX ``file``, deterministically, in boxes of at least
    ``min_score``.

    ``name`` is the file's name and how its SHA-256 begins, ``runtime`` the version of ONNX Runtime. Raises
    UnusableInput for a file that holds no detector of a known layout, and where ONNX Runtime is not installed.
    """

    def __init__(self, file: Path, min_score: float = DEFAULTS.detection.score) -> None:
        self._file, self._min_score = file, min_score
        self.name = detector_name(file)
        self._session, self.runtime = _session(file)
        self._input, self._size, self._type, self._shape = self._input_of()
        outputs = self._run(np.full(self._size[::-1], PADDING_GREY / 255.0, np.float32))
        layout = output_layout(outputs, self._size)
        if layout is None:
            raise UnusableInput(f"{file}: outputs {_shapes(self._session.get_outputs(), outputs)}: {EXPECTED_OUTPUTS}")
        self._layout = layout
        self._classes = self._vehicles(layout.classes)

    def __call__(self, picture: Image) -> Array:
        """Left, top, right and bottom (N, 4), px, of the vehicles in a ``picture`` (H, W), grey 0 to 255."""
        padded, scale = letterbox(picture, self._size)
        outputs = self._run(padded * np.float32(self._layout.white / 255.0))
        try:
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is no box
                boxes = select_boxes(self._layout.read(outputs), self._classes, self._size, self._min_score)
        except (ValueError, IndexError):
            shapes = _shapes(self._session.get_outputs(), outputs)
            raise UnusableInput(f"{self._file}: outputs {shapes}: unlike those for a plain picture") from None
        return boxes / np.tile(scale, 2)

    def _run(self, padded: Image) -> Outputs:
        colours = self._shape[-3]
        picture = np.broadcast_to(padded.astype(self._type), (colours, *padded.shape)).reshape(self._shape)
        try:
            return [np.asarray(output) for output in self._session.run(None, {self._input: picture})]
        except Exception as error:  # ONNX Runtime has many
            raise UnusableInput(f"{self._file}: does not run: {_error_text(error)}") from error

    def _input_of(self) -> tuple[str, tuple[int, int], type[np.floating], tuple[int, ...]]:
        """The name of the input, its width and height, the type of its numbers and its whole shape."""
        inputs = self._session.get_inputs()
        if len(inputs) == 1 and len(shape := inputs[0].shape) in (3, 4) and inputs[0].type in FLOAT_TYPES:
            default_shape = (3, DEFAULT_SIDE_PX, DEFAULT_SIDE_PX)
            colours, height, width = (
                n if isinstance(n, int) else u for n, u in zip(shape[-3:], default_shape, strict=True)
            )
            single_image = not isinstance(shape[0], int) or shape[:-3] in ([], [1])
            if single_image and colours in (1, 3) and height in ACCEPTED_SIDES_PX and width in ACCEPTED_SIDES_PX:
                full_shape = (1, colours, height, width)[-len(shape) :]
                return inputs[0].name, (width, height), FLOAT_TYPES[inputs[0].type], full_shape
        raise UnusableInput(
            f"{self._file}: inputs {_shapes(inputs)}: expected one picture of floating-point numbers, "
            "(1, 3, height, width)"
        )

    def _vehicles(self, count: int | None) -> Array | None:
        text = self._session.get_modelmeta().custom_metadata_map.get("names", "")
        if not text:
            return vehicle_classes(None, count)
        names = _names(text)
        if names is None:
            raise UnusableInput(f"{self._file}: names: {_shorten(text)}: expected such as {{0: 'person', 1: 'car'}}")
        if count is not None and len(names) != count:
            raise UnusableInput(
                f"{self._file}: names {len(names)} classes, but its outputs have {count}; expected a detector of boxes"
            )
        classes = vehicle_classes(names, count)
        if classes is None or not len(classes):
            examples = _shorten(", ".join(names.values())) or "none"
            raise UnusableInput(f"{self._file}: names: {examples}; expected some vehicles, such as car or truck")
        return classes


def letterbox(picture: Image, size: tuple[int, int]) -> tuple[Image, Array]:
    """A ``picture`` (H, W) at the top left of one of ``size`` (width, height), as large as it fits, with grey beside
    it; and by how much it is scaled across and down (2,)."""
    was = np.array(picture.shape[::-1])
    new = np.maximum(np.rint(was * min(np.array(size) / was)), 1).astype(int)
    padded = np.full(size[::-1], PADDING_GREY, np.float32)
    padded[: new[1], : new[0]] = cv2.resize(picture, new.tolist())
    return padded, new / was


def _session(file: Path) -> tuple[InferenceSession, str]:
    """The inference session of the ONNX ``file``, and the version of ONNX Runtime."""
    try:
        import onnxruntime
    except ImportError:
        raise UnusableInput(
            "--detector needs ONNX Runtime; install it with: pip install 'paceline[detector]'"
        ) from None
    onnxruntime.set_default_logger_severity(LOG_FATAL_ONLY)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = max_threads(INFERENCE_THREADS), 1
    options.log_severity_level = LOG_FATAL_ONLY
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has many
        raise UnusableInput(f"{file}: cannot be read as an ONNX model: {_error_text(error)}") from error
    return session, onnxruntime.__version__


def detector_name(file: Path) -> str:
    """The name of an ONNX ``file`` and how its SHA-256 begins. Raises UnusableInput where it cannot be read."""
    return f"{file.name} (SHA-256 {_digest(file)[:12]}…)"


def _digest(file: Path) -> str:
    """The SHA-256 of a ``file``."""
    if not file.is_file():
        problem = "is no file" if file.exists() else "no such file"
        raise UnusableInput(f"{file}: {problem}; expected a detector in the ONNX format")
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be read ({error.strerror})") from error


def _names(text: str) -> dict[int, str] | None:
    """The names of classes as Ultralytics writes them among a model's metadata; None for anything else."""
    try:
        names = ast.literal_eval(text) if len(text) <= MAX_NAMES_LENGTH else None
        if isinstance(names, list | tuple):
            names = dict(enumerate(names))
        return {int(k): str(name) for k, name in names.items()} if isinstance(names, dict) else None
    except (ValueError, SyntaxError, TypeError, OverflowError, MemoryError, RecursionError):  # of nests, the last two
        return None


def _shapes(described: list[NodeArg], outputs: Outputs | None = None) -> str:
    """The names, shapes and types of inputs or outputs, those ``outputs`` where they are known."""
    shapes = [(n.shape, n.type[7:-1]) for n in described] if outputs is None else [(o.shape, o.dtype) for o in outputs]
    descriptions = [
        f"{n.name} ({', '.join(map(str, s))}) {kind}" for n, (s, kind) in zip(described, shapes, strict=True)
    ]
    return _shorten(", ".join(descriptions)) or "none"


def _error_text(error: Exception) -> str:
    """The message of an error of ONNX Runtime, shortened."""
    return _shorten(ERROR_PREFIX.sub("", " ".join(str(error).split())))


def _shorten(text: str) -> str:
    """The beginning of a ``text`` from a file, on one line and printable."""
    printable = "".join(c for c in " ".join(text.split()) if c.isprintable())
    return printable if len(printable) <= MAX_QUOTED_LENGTH else f"{printable[: MAX_QUOTED_LENGTH - 1]}…"
