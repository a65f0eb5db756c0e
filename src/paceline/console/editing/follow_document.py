"""Edits a follow.yaml: its target, and the frame, place and scale at which following starts; the rest stays."""

from __future__ import annotations

import secrets
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from paceline.cameras import Camera
from paceline.console.document_references import PartialFollowModel
from paceline.console.editing.clip_document import FileChanged, file_revision
from paceline.console.editing.target_model import target_as_dict, validated_start, validated_target
from paceline.documents.loading import load_follow
from paceline.documents.models import TargetModel, read_document
from paceline.documents.yaml_editing import Plain, format_flow, set_values
from paceline.errors import UnusableInput
from paceline.reports.common.output_folder import write_all_or_none

CENTER_DECIMALS = 2  # decimals of written pixels
SCALE_DECIMALS = 5


@dataclass(frozen=True)
class FollowSetup:
    """The ``target`` model and its ``start``, None while there is none; ``revision`` identifies the content of the file
    that they were read from, ``problem`` is why the target that the file names cannot be used."""

    target: Plain | None
    start: Plain | None
    revision: str
    problem: str = ""


def read_follow_setup(file: Path) -> FollowSetup:
    """The target and the start in a follow.yaml. Raises UnusableInput."""
    revision = file_revision(file)
    model = read_document(PartialFollowModel, file)
    target, problem = None, ""
    if model.target is not None:
        try:
            target = target_as_dict(read_document(TargetModel, file.parent / model.target))
            validated_target(target)
        except UnusableInput as error:
            target, problem = None, str(error)
    start = None
    if model.start is not None:
        start = {"frame": model.start.frame, "center": model.start.center.tolist(), "scale": model.start.scale}
    return FollowSetup(target, start, revision, problem)


def save_follow_setup(file: Path, camera: Camera, setup: FollowSetup) -> FollowSetup:
    """Writes the target and the start of ``setup`` into the follow.yaml ``file``, and a changed target into a new file
    beside it. Raises FileChanged where ``file`` has another revision, UnusableInput where nothing could be followed
    with them."""
    if file_revision(file) != setup.revision:
        raise FileChanged
    target = validated_target(setup.target)
    start = validated_start(camera, target, setup.start)
    center = [round(float(value), CENTER_DECIMALS) for value in start.center]
    values: Plain = {"start": {"frame": start.frame, "center": center, "scale": round(start.scale, SCALE_DECIMALS)}}
    contents: dict[Path, bytes] = {}
    if read_follow_setup(file).target != target_as_dict(target):
        named = _unused_target_file(file.parent)
        values["target"] = named.name
        contents[named] = target_yaml(target).encode()
    new = set_values(file.read_text(encoding="utf-8"), str(file), values)
    _check_loadable(file, new, contents)
    write_all_or_none({**contents, file: new.encode()})
    return read_follow_setup(file)


def _check_loadable(file: Path, text: str, contents: dict[Path, bytes]) -> None:
    """Raises UnusableInput where ``file`` with this ``text``, and ``contents`` beside it, could not be loaded."""
    written = [*contents, file.with_name(f".{file.name}.{secrets.token_hex(4)}.partial")]
    try:
        for path, content in zip(written, [*contents.values(), text.encode()], strict=True):
            path.write_bytes(content)
        load_follow(written[-1])
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be written ({error.strerror})") from error
    except UnusableInput as error:
        raise UnusableInput(str(error).replace(str(written[-1]), str(file))) from error
    finally:
        for path in written:
            with suppress(OSError):
                path.unlink()


def _unused_target_file(folder: Path) -> Path:
    """A file name for a new model that no existing file has."""
    names = ("target.yaml", *(f"target-{number}.yaml" for number in range(2, 10_000)))
    return next(path for name in names if not (path := folder / name).exists() and not path.is_symlink())


def target_yaml(target: TargetModel) -> str:
    """``target`` as target.yaml, without unused corners."""
    used_corners = {name for pair in target.segments for name in pair}
    corners = [
        f"  {format_flow(n)}: {format_flow([round(float(v), 4) for v in c])}"
        for n, c in target.corners.items()
        if n in used_corners
    ]
    segments = [f"  - {format_flow(list(pair))}" for pair in target.segments]
    head = [f"name: {format_flow(target.name)}", f"nominal_range: {format_flow(target.nominal_range)}"]
    if target.tolerance is not None:
        head.append(f"tolerance: {format_flow(target.tolerance)}")
    if target.width_assumed is not None:
        head.append(f"width_assumed: {format_flow(target.width_assumed)}")
    return "\n".join([*head, "corners:", *corners, "segments:", *segments]) + "\n"
