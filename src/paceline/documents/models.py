"""The pydantic models of the YAML files: keys, types and ranges, and the reading of a file into its model."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import yaml
from pydantic import (
    AfterValidator,
    AliasChoices,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    WrapValidator,
    model_validator,
)
from pydantic.fields import FieldInfo

from paceline.arrays import Array
from paceline.documents.yaml_loading import load_yaml
from paceline.errors import UnusableInput, refuse_pipe_or_device
from paceline.units import parse_speed

MAX_DOCUMENT_NAME_LENGTH = 100
MAX_NUMBER = 1e9  # upper limit of every pixel and metre in these files; excludes NaN and infinity as well
FRAME_RATE_LIMITS_HZ = 0.1, 10000.0  # from time-lapse pictures to high-speed cameras
MAX_READOUT_S = 0.1  # greatest time from the first row's exposure to the last one's; ordinary cameras take up to 0.03
RIG_PARAMETERS = 14  # fx, fy, cx, cy of each camera, rotation, translation
_NUMBER_WORDS = {2: "two", 3: "three", 4: "four"}


def _array(columns: int, rows: int | None = None, noun: str = "points") -> BeforeValidator:
    """Validates nested lists of finite numbers into an array (rows, columns)."""
    row = f"[{', '.join('xyz'[:columns])}]"
    count_text = f"{_NUMBER_WORDS[rows]} " if rows else ""
    expected = (
        f"{count_text}{row} points" if noun == "points" else f"{count_text}rows of {_NUMBER_WORDS[columns]} numbers"
    )

    def validate(value: Any) -> Array:
        if not isinstance(value, list):
            raise ValueError(f"expected {expected}, found {_excerpt(value)}")
        for i, item in enumerate(value):
            if not (isinstance(item, list) and len(item) == columns and all(map(_is_number, item))):
                raise ValueError(f"expected {expected}, found {_excerpt(item)} in place {i}")
        if rows is not None and len(value) != rows:
            raise ValueError(f"expected {expected}, found {len(value)}")
        return np.array(value, float).reshape(-1, columns)

    return BeforeValidator(validate)


def _vector(length: int) -> BeforeValidator:
    def validate(value: Any) -> Array:
        if not (isinstance(value, list) and len(value) == length and all(map(_is_number, value))):
            raise ValueError(f"expected {_NUMBER_WORDS[length]} finite numbers, found {_excerpt(value)}")
        return np.array(value, float)

    return BeforeValidator(validate)


def _covariance(value: Any) -> Any:
    if value is None:
        return None
    rows = value if isinstance(value, list) else []
    if len(rows) != RIG_PARAMETERS or any(not isinstance(r, list) or len(r) != RIG_PARAMETERS for r in rows):
        raise ValueError(f"expected {RIG_PARAMETERS} rows of {RIG_PARAMETERS} numbers, found {_excerpt(value)}")
    if not all(_is_number(x) for row in rows for x in row):
        raise ValueError("expected finite numbers")
    C = np.array(rows, float)
    size = np.sqrt(np.maximum(np.diag(C), 1e-300))
    correlation = C / np.outer(size, size)
    if (np.diag(C) < 0).any() or np.abs(correlation - correlation.T).max() > 1e-6:
        raise ValueError("is no covariance: expected a symmetric matrix without negative variances")
    if np.linalg.eigvalsh(correlation).min() < -1e-6:
        raise ValueError("is no covariance: it gives some change of the rig a negative variance")
    return C


def _quantity(value: Any) -> Any:
    """A number is exact as stated."""
    if isinstance(value, dict | QuantityModel):
        return value
    if not _is_number(value):
        raise ValueError(f"expected a number or {{value: …, std: …}}, found {_excerpt(value)}")
    return {"value": value, "std": 0.0}


def _frame_rate(value: Any) -> Any:
    """A number is the rate of what has no time stamps of its own."""
    if isinstance(value, dict | RateModel):
        return value
    if not _is_number(value):
        raise ValueError(f"expected a number or {{value: …, override: …}}, found {_excerpt(value)}")
    return {"value": value}


def _is_frame_rate(rate: RateModel) -> RateModel:
    low, high = FRAME_RATE_LIMITS_HZ
    if not low <= rate.value <= high:
        expected = f"at least {low:g}" if rate.value < low else f"at most {high:g}"
        raise ValueError(f"expected {expected}, found {rate.value:g}")
    return rate


def _speed_with_unit(value: Any) -> str:
    """Kept as it is written, so that it can be written again."""
    if not isinstance(value, str):
        raise ValueError(f"expected a speed with its unit, such as 30 mph, found {_excerpt(value)}")
    parse_speed(value)
    return value


def _is_readout(quantity: QuantityModel) -> QuantityModel:
    if abs(quantity.value) > MAX_READOUT_S:
        raise ValueError(
            f"expected at most {MAX_READOUT_S:g} s from the first row to the last, found {quantity.value:g}"
        )
    return quantity


def _exact_or_keys(value: Any, model: Callable[[Any], UncertaintyModel]) -> UncertaintyModel:
    """The word ``exact``, or the keys of the ``model``."""
    if not isinstance(value, str):
        return model(value)
    if value != "exact":
        raise ValueError(f"expected exact, or the keys {', '.join(UncertaintyModel.model_fields)}, found {value!r}")
    return ExactModel()


def _name(value: Any) -> Any:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


def _legible(name: str) -> str:
    """A name goes into tables, labels and file names."""
    if len(name) > MAX_DOCUMENT_NAME_LENGTH or not name.isprintable():
        raise ValueError(f"expected at most {MAX_DOCUMENT_NAME_LENGTH} printable characters")
    return name


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < MAX_NUMBER


Pixels = Annotated[Array, _array(2)]
Corners = Annotated[Array, _array(2, 4)]
Points = Annotated[Array, _array(3)]
Matrix = Annotated[Array, _array(3, 3, "numbers")]
Vector = Annotated[Array, _vector(3)]
Pair = Annotated[Array, _vector(2)]
Name = Annotated[str, BeforeValidator(_name), Field(min_length=1), AfterValidator(_legible)]
Text = Annotated[str, Field(min_length=1)]
PostedLimit = Annotated[str, BeforeValidator(_speed_with_unit)]
Rate = Annotated[float, Field(ge=FRAME_RATE_LIMITS_HZ[0], le=FRAME_RATE_LIMITS_HZ[1])]
Bits = Annotated[int, Field(ge=8, le=16)]
Size = Annotated[int, Field(ge=16, le=65536)]
Sigma = Annotated[float, Field(ge=0)]
Covariance = Annotated[Array, BeforeValidator(_covariance)]


class KnownKeys(BaseModel):
    """A model that refuses an unknown key and names the nearest valid one.

    A field with ``validation_alias=AliasChoices(name, old name)`` accepts an older name of its key, too.
    """

    model_config = ConfigDict(allow_inf_nan=False, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _know_all_keys(cls, value: Any) -> Any:
        if isinstance(value, cls):
            return value
        if not isinstance(value, dict):
            raise ValueError(f"expected the keys {', '.join(cls.model_fields)}, found {_excerpt(value)}")
        aliases = {str(old): name for name, field in cls.model_fields.items() for old in _older_names(field)}
        for key in value:
            if key not in cls.model_fields and key not in aliases:
                raise ValueError(f"unknown key {key!r}; {suggestion(str(key), list(cls.model_fields))}")
            if aliases.get(key) in value:
                raise ValueError(f"{aliases[key]} and {key}: one key under two names; expected one of them")
        return value


def _older_names(field: FieldInfo) -> list[Any]:
    """The names beside its own under which a field is accepted."""
    return field.validation_alias.choices[1:] if isinstance(field.validation_alias, AliasChoices) else []


class Document(KnownKeys):
    model_config = ConfigDict(strict=True, arbitrary_types_allowed=True)


class QuantityModel(Document):
    value: float
    std: Sigma


Stated = Annotated[QuantityModel, BeforeValidator(_quantity)]
Readout = Annotated[Stated, AfterValidator(_is_readout)]


class RateModel(Document):
    value: float
    override: bool = False


FrameRate = Annotated[RateModel, BeforeValidator(_frame_rate), AfterValidator(_is_frame_rate)]


class CameraModel(Document):
    image_size: Annotated[list[Size], Field(min_length=2, max_length=2)]
    K: Matrix
    distortion: list[float] = []
    shutter: Literal["global", "rolling"] | None = None
    readout: Readout | None = None

    @model_validator(mode="after")
    def _count_coefficients(self) -> CameraModel:
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14):
            raise ValueError(f"distortion: expected 4, 5, 8, 12 or 14 coefficients, found {len(self.distortion)}")
        return self


class UncertaintyModel(Document):
    focal_length_px: Sigma = 0.0
    principal_point_px: Sigma = 0.0
    rotation_rad: Annotated[list[Sigma], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]
    translation_m: Annotated[list[Sigma], Field(min_length=3, max_length=3)] = [0.0, 0.0, 0.0]
    covariance: Covariance | None = None


class ExactModel(UncertaintyModel):
    """``uncertainty: exact``"""


class RigModel(Document):
    left: CameraModel
    right: CameraModel
    rotation: Matrix
    translation: Vector
    scene_points: Annotated[int, Field(ge=1)] | None = None
    uncertainty: Annotated[UncertaintyModel, WrapValidator(_exact_or_keys)] | None = None


class PathModel(Document):
    shape: Literal["line", "curve"]
    left: Pixels | None = None
    right: Pixels | None = None
    points: Points | None = None
    lateral_offset: float = 0.0
    limit: PostedLimit | None = None


class VehicleModel(Document):
    id: Name
    path: Name | None = None
    frame: Annotated[int, Field(ge=0)]
    left: Corners
    right: Corners
    plane: Literal["front", "side", "free"] | None = None
    speed: Annotated[float, Field(gt=0, le=150)] | None = None


class ClipModel(Document):
    left: Text
    right: Text
    rate: FrameRate | None = None
    times: str | None = None
    time_tolerance: Annotated[float, Field(gt=0)] | None = None
    bit_depth: Bits | None = None
    synchronised: bool | None = None
    offset: Stated | None = None
    drawn_on: Annotated[int, Field(ge=0)] | None = None
    limit: PostedLimit | None = None
    rig: str | None = None
    site: Text | None = None
    paths: dict[Name, PathModel] | None = None
    vehicles: list[VehicleModel] | None = None


class SiteModel(Document):
    rig: Text
    limit: PostedLimit | None = None
    paths: dict[Name, PathModel] | None = None


class TargetModel(Document):
    name: Name
    nominal_range: Annotated[float, Field(gt=0, le=1000)]
    corners: dict[Name, Pair]
    segments: list[Annotated[list[Name], Field(min_length=2, max_length=2)]]
    tolerance: Annotated[float, Field(ge=0, le=1)] | None = None
    width_assumed: bool | None = None


class StartModel(Document):
    frame: Annotated[int, Field(ge=0)]
    center: Pair
    scale: Annotated[float, Field(gt=0)]


class FollowModel(Document):
    video: Text
    rate: FrameRate | None = None
    bit_depth: Bits | None = None
    camera: Text
    target: Text
    start: StartModel
    odometry: Text | None = None
    wheelbase: Annotated[float, Field(ge=0.1, le=20)] | None = None
    camera_ahead: Annotated[float, Field(ge=-5, le=20)] | None = None
    lookahead: Annotated[float, Field(ge=0, le=10)] | None = None


# --- reading -------------------------------------------------------------------------------------------------------


M = TypeVar("M", bound=KnownKeys)
B = TypeVar("B", bound=BaseModel)


def read_document(model: type[M], path: Path) -> M:
    """The file at ``path`` as a ``model``; raises UnusableInput naming the line or key for anything it cannot be."""
    refuse_pipe_or_device(path)
    try:
        with path.open(encoding="utf-8") as file:
            content = load_yaml(file)
    except FileNotFoundError:
        raise UnusableInput(f"{path}: no such file") from None
    except OSError as error:
        raise UnusableInput(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise UnusableInput(f"{path}: is not a text file") from error
    except (yaml.MarkedYAMLError, yaml.reader.ReaderError, ValueError, RecursionError) as error:
        raise UnusableInput(f"{path}: {_yaml_problem(error)}") from error
    return checked_content(model, content, path)


def checked_content(model: type[B], content: Any, path: Path) -> B:
    """The ``content`` of the file at ``path`` as a ``model``; raises UnusableInput naming the key."""
    try:
        return model.model_validate(content, strict=True)
    except ValidationError as error:
        raise UnusableInput(f"{path}: {_first_problem(error)}") from error


def _yaml_problem(error: Exception) -> str:
    if not isinstance(error, yaml.MarkedYAMLError):
        return "is not valid YAML"
    mark = error.problem_mark or error.context_mark
    position = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
    return f"{position}{error.problem or error.context}"


def _first_problem(error: ValidationError) -> str:
    """Where in the file the first problem lies, and what was expected there."""
    first = error.errors()[0]
    key = ""
    for part in first["loc"]:
        if part != "[key]":
            key += f"[{part}]" if isinstance(part, int) else f".{part}" if key else part
    context: Mapping[str, Any] = first.get("ctx", {})
    expected = {
        "float_type": "expected a number",
        "int_type": "expected a whole number",
        "bool_type": "expected true or false",
        "string_type": "expected text",
        "list_type": "expected a list",
        "dict_type": "expected names, each with its keys",
        "finite_number": "expected a finite number",
        "literal_error": f"expected {context.get('expected')}",
        "string_too_short": "expected a name",
        "too_short": f"expected {context.get('min_length')} values",
        "too_long": f"expected {context.get('max_length')} values",
        "greater_than": f"expected a number above {context.get('gt', 0):g}",
        "greater_than_equal": f"expected at least {context.get('ge', 0):g}",
        "less_than": f"expected a number below {context.get('lt', 0):g}",
        "less_than_equal": f"expected at most {context.get('le', 0):g}",
    }
    if first["type"] == "value_error":
        text = str(context["error"])
    elif first["type"] == "missing":
        text = "missing"
    else:
        text = f"{expected.get(first['type'], first['msg'])}, found {_excerpt(first['input'])}"
    return f"{key}: {text}" if key else text


def _excerpt(value: Any) -> str:
    if value is None:
        return "nothing"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def suggestion(name: str, valid: list[str]) -> str:
    """Names the entry of ``valid`` that was probably meant, or all of them where none resembles ``name``."""
    if matches := difflib.get_close_matches(name, valid, 1, 0.5):
        return f"did you mean {matches[0]!r}?"
    return f"expected one of {', '.join(valid)}" if valid else "none is given"
