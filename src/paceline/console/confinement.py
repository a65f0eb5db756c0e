"""Confines the console to files below one folder: no link, path or playlist may lead out of it.

Names of clips come from requests and names of files from documents, so neither is trusted.
"""

from __future__ import annotations

import glob
import re
from pathlib import Path

import av

from paceline.console.document_references import check_size, files_of, is_live, recordings_of, rig_of_site
from paceline.errors import UnusableInput
from paceline.recordings.image_sources import IMAGE_SUFFIXES

MAX_CLIP_NAME_LENGTH = 80
YAML_KEYS = ("rig", "site", "camera", "target")  # keys of documents whose files are read as YAML
# Containers that hold their own frames; a playlist would make the decoder open the files that it names.
ALLOWED_CONTAINERS = "mov,matroska,avi,mpegts,mpeg,ogg,flv,asf,mxf,nut,dv,h264,hevc,mjpeg,m4v,mpegvideo,ivf"


class NotFound(LookupError):
    """There is no such clip, run or file below the console's folder."""


def check_name(name: str) -> str:
    """``name``, if it is valid for a new clip. Raises UnusableInput."""
    printable = 0 < len(name) <= MAX_CLIP_NAME_LENGTH and name.isprintable() and name == name.strip()
    if not printable or name.startswith(".") or re.search(r'[/\\:*?"<>|]', name):
        raise UnusableInput(
            f"name {name[:MAX_CLIP_NAME_LENGTH]!r}: expected at most {MAX_CLIP_NAME_LENGTH} characters "
            'without / \\ : * ? " < > |, not beginning with a dot'
        )
    return name


def folder_below(root: Path, name: str) -> Path:
    """The folder ``name`` ("." or "a/b") below the resolved ``root``. Raises NotFound for anything else, and for names
    with "..", hidden or absolute ones, and links."""
    folder = root if name == "." else root.joinpath(*_path_parts(name))
    try:
        exists = folder.is_dir() and folder.resolve() == folder
    except OSError:  # a name that is too long
        exists = False
    if not exists:
        raise NotFound(name)
    return folder


def file_below(folder: Path, name: str) -> Path:
    """The regular file ``name`` below the resolved ``folder``. Raises NotFound, also for links."""
    file = folder.joinpath(*_path_parts(name))
    try:
        exists = file.is_file() and file.resolve() == file
    except OSError:
        exists = False
    if not exists:
        raise NotFound(name)
    return file


def _path_parts(name: str) -> list[str]:
    parts = name.split("/")
    if any(not part or part.startswith(".") or "\\" in part or not part.isprintable() for part in parts):
        raise NotFound(name)
    return parts


def check_document(root: Path, file: Path) -> None:
    """Raises UnusableInput where something that the document ``file`` names lies outside ``root`` or is a playlist.

    Live sources are allowed: only a run, which a person starts, opens them.
    """
    _require_inside(root, file, file, file.name)
    others = files_of(file)
    for key, name in others.items():
        path = _require_inside(root, file, file.parent / name, key)
        if key in YAML_KEYS:
            check_size(path)
    for key, name in recordings_of(file).items():
        if is_live(file, name) and not (file.parent / name).is_fifo():
            continue
        path = _require_inside(root, file, file.parent / name, key)
        try:
            _check_recording(root, file, path, key)
        except OSError as error:  # a folder without permission to read
            raise UnusableInput(f"{file}: {key}: cannot be read ({error.strerror})") from error
    if (site := others.get("site")) is not None and (file.parent / site).is_file():
        check_size(_require_inside(root, file.parent / site, rig_of_site(file.parent / site), "rig"))


def named_files(root: Path, file: Path) -> list[Path]:
    """The document ``file``, its folder and the files that it names, as far as they can be read below ``root``."""
    paths = [file, file.parent]
    try:
        others = files_of(file)
        paths += [file.parent / name for name in [*others.values(), *recordings_of(file).values()]]
        if "site" in others:
            paths.append(rig_of_site(_require_inside(root, file, file.parent / others["site"], "site")))
    except UnusableInput:
        pass
    return paths


def _check_recording(root: Path, file: Path, path: Path, key: str) -> None:
    if path.is_dir():
        images = [p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
    elif path.is_fifo():
        return  # opening it would block until something writes into it
    elif path.exists():
        return check_container(path)
    else:
        images = [Path(p) for p in glob.glob(re.sub(r"%0(\d{1,2})d", lambda m: "[0-9]" * int(m[1]), str(path)))]
    for folder in {image.parent for image in images}:
        _require_inside(root, file, folder, key)
    for image in images:
        if image.is_symlink():
            _require_inside(root, file, image, key)


def check_container(video: Path) -> None:
    """Raises UnusableInput unless ``video`` is a container that holds its own frames."""
    try:
        with av.open(video, options={"format_whitelist": ALLOWED_CONTAINERS}):
            pass
    except av.FFmpegError as error:
        raise UnusableInput(
            f"{video}: cannot be read as a video ({error.strerror}); expected MP4, MOV, MKV, WebM, AVI or the like"
        ) from error


def _require_inside(root: Path, file: Path, path: Path, key: str) -> Path:
    """``path``, if it lies below ``root`` with all links resolved; it need not exist. Raises UnusableInput."""
    try:
        inside = path.resolve().is_relative_to(root)
    except (OSError, RuntimeError, ValueError) as error:  # a name too long, links in a circle, a zero byte
        raise UnusableInput(f"{file}: {key}: {str(path)[:200]!r} cannot be read") from error
    if not inside:
        raise UnusableInput(f"{file}: {key}: leads out of the console's folder, and nothing else is read")
    return path
