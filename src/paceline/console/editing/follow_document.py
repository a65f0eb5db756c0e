"""The target and the start of a follow.yaml, read for editing and written back with all else as a person wrote it."""

from __future__ import annotations

import secrets
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from paceline.cameras import Camera
from paceline.console.document_names import ChaseModel
from paceline.console.editing.clip_document import Changed, revision_of
from paceline.console.editing.target_model import checked_start, checked_target, plain_target
from paceline.documents.loading import load_follow
from paceline.documents.models import TargetModel, read_document
from paceline.documents.yaml_editing import Plain, format_flow, set_values
from paceline.errors import UnusableInput
from paceline.reports.common.output_folder import write_all_or_none

DECIMALS = 2  # of a pixel as written
SCALE_DECIMALS = 5


@dataclass(frozen=True)
class Chase:
    """What a person places: the ``target`` model and its ``start``, None while there is none; ``revision`` is the file
    that they were read from, ``problem`` says why there is no target although the file names one."""

    target: Plain | None
    start: Plain | None
    revision: str
    problem: str = ""


def read_chase(file: Path) -> Chase:
    """The target and the start in a follow.yaml. Raises UnusableInput."""
    revision = revision_of(file)
    model = read_document(ChaseModel, file)
    target, problem = None, ""
    if model.target is not None:
        try:
            target = plain_target(read_document(TargetModel, file.parent / model.target))
            checked_target(target)
        except UnusableInput as error:
            target, problem = None, str(error)
    start = None
    if model.start is not None:
        start = {"frame": model.start.frame, "center": model.start.center.tolist(), "scale": model.start.scale}
    return Chase(target, start, revision, problem)


def save_chase(file: Path, camera: Camera, chase: Chase) -> Chase:
    """Puts the target and the start of ``chase`` into the follow.yaml ``file``, and a target that has changed into a
    new file beside it. Raises Changed where ``file`` is not of that revision, UnusableInput where nothing could be
    followed from then on."""
    if revision_of(file) != chase.revision:
        raise Changed
    target = checked_target(chase.target)
    start = checked_start(camera, target, chase.start)
    center = [round(float(value), DECIMALS) for value in start.center]
    values: Plain = {"start": {"frame": start.frame, "center": center, "scale": round(start.scale, SCALE_DECIMALS)}}
    contents: dict[Path, bytes] = {}
    if read_chase(file).target != plain_target(target):
        named = _free(file.parent)
        values["target"] = named.name
        contents[named] = target_text(target).encode()
    new = set_values(file.read_text(encoding="utf-8"), str(file), values)
    _check(file, new, contents)
    write_all_or_none({**contents, file: new.encode()})
    return read_chase(file)


def _check(file: Path, text: str, contents: dict[Path, bytes]) -> None:
    """Raises UnusableInput where the follow.yaml ``file`` would be none with this ``text`` and ``contents`` beside."""
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


def _free(folder: Path) -> Path:
    """A name for a new model; one that is there already may be someone's work, and stays."""
    names = ("target.yaml", *(f"target-{number}.yaml" for number in range(2, 10_000)))
    return next(path for name in names if not (path := folder / name).exists() and not path.is_symlink())


def target_text(target: TargetModel) -> str:
    """``target`` as target.yaml, without corners that no line uses."""
    used = {name for pair in target.segments for name in pair}
    corners = [
        f"  {format_flow(n)}: {format_flow([round(float(v), 4) for v in c])}"
        for n, c in target.corners.items()
        if n in used
    ]
    segments = [f"  - {format_flow(list(pair))}" for pair in target.segments]
    head = [f"name: {format_flow(target.name)}", f"nominal_range: {format_flow(target.nominal_range)}"]
    if target.tolerance is not None:
        head.append(f"tolerance: {format_flow(target.tolerance)}")
    return "\n".join([*head, "corners:", *corners, "segments:", *segments]) + "\n"
