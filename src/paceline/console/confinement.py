"""What the console may touch: files below one folder, and nothing that a link, a path or a playlist leads to elsewhere.

Names of clips come from addresses and files from their documents, so both are distrusted.
"""

from __future__ import annotations

import glob
import re
from pathlib import Path

import av

from paceline.console.document_names import check_small, files_of, is_live, recordings_of, rig_of_site
from paceline.errors import UnusableInput
from paceline.recordings.image_sources import IMAGE_SUFFIXES

LONGEST_NAME = 80
DOCUMENTS = ("rig", "site", "camera", "target")  # that a clip names and that are read as YAML
# Containers that hold their own pictures; a playlist would make the decoder open the files that it names.
CONTAINERS = "mov,matroska,avi,mpegts,mpeg,ogg,flv,asf,mxf,nut,dv,h264,hevc,mjpeg,m4v,mpegvideo,ivf"


class NotHere(LookupError):
    """No such clip, run or file below the console's folder."""


def check_name(name: str) -> str:
    """``name``, if a new clip may be called so. Raises UnusableInput."""
    plain = 0 < len(name) <= LONGEST_NAME and name.isprintable() and name == name.strip()
    if not plain or name.startswith(".") or re.search(r'[/\\:*?"<>|]', name):
        raise UnusableInput(
            f'name {name[:LONGEST_NAME]!r}: expected at most {LONGEST_NAME} characters without / \\ : * ? " < > |, '
            "not beginning with a dot"
        )
    return name


def folder_below(root: Path, name: str) -> Path:
    """The folder called ``name`` ("." or "a/b") below ``root``, itself resolved. Raises NotHere for anything else:
    a name that climbs, is hidden or absolute, or leads through a link."""
    folder = root if name == "." else root.joinpath(*_parts(name))
    try:
        there = folder.is_dir() and folder.resolve() == folder
    except OSError:  # a name that is too long
        there = False
    if not there:
        raise NotHere(name)
    return folder


def file_below(folder: Path, name: str) -> Path:
    """The plain file called ``name`` below ``folder``, itself resolved. Raises NotHere, for links too."""
    file = folder.joinpath(*_parts(name))
    try:
        there = file.is_file() and file.resolve() == file
    except OSError:
        there = False
    if not there:
        raise NotHere(name)
    return file


def _parts(name: str) -> list[str]:
    parts = name.split("/")
    if any(not part or part.startswith(".") or "\\" in part or not part.isprintable() for part in parts):
        raise NotHere(name)
    return parts


def check_document(root: Path, file: Path) -> None:
    """Raises UnusableInput where something that the document ``file`` names lies outside ``root`` or is a playlist.

    Live sources are let through: a run may open them, for a person to start.
    """
    _inside(root, file, file, file.name)
    others = files_of(file)
    for key, given in others.items():
        path = _inside(root, file, file.parent / given, key)
        if key in DOCUMENTS:
            check_small(path)
    for key, given in recordings_of(file).items():
        if is_live(file, given) and not (file.parent / given).is_fifo():
            continue
        path = _inside(root, file, file.parent / given, key)
        try:
            _check_recorded(root, file, path, key)
        except OSError as error:  # a folder that is not ours to read
            raise UnusableInput(f"{file}: {key}: cannot be read ({error.strerror})") from error
    if (site := others.get("site")) is not None and (file.parent / site).is_file():
        check_small(_inside(root, file.parent / site, rig_of_site(file.parent / site), "rig"))


def named_files(root: Path, file: Path) -> list[Path]:
    """The document ``file``, its folder and, so far as it can be read below ``root``, all that it names."""
    found = [file, file.parent]
    try:
        others = files_of(file)
        found += [file.parent / given for given in [*others.values(), *recordings_of(file).values()]]
        if "site" in others:
            found.append(rig_of_site(_inside(root, file, file.parent / others["site"], "site")))
    except UnusableInput:
        pass
    return found


def _check_recorded(root: Path, file: Path, where: Path, key: str) -> None:
    if where.is_dir():
        images = [p for p in where.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES]
    elif where.is_fifo():
        return  # opening it would wait for whoever writes into it
    elif where.exists():
        return check_container(where)
    else:
        images = [Path(p) for p in glob.glob(re.sub(r"%0(\d{1,2})d", lambda m: "[0-9]" * int(m[1]), str(where)))]
    for folder in {image.parent for image in images}:
        _inside(root, file, folder, key)
    for image in images:
        if image.is_symlink():
            _inside(root, file, image, key)


def check_container(video: Path) -> None:
    """Raises UnusableInput unless ``video`` holds its own pictures."""
    try:
        with av.open(video, options={"format_whitelist": CONTAINERS}):
            pass
    except av.FFmpegError as error:
        raise UnusableInput(
            f"{video}: cannot be read as a video ({error.strerror}); expected MP4, MOV, MKV, WebM, AVI or the like"
        ) from error


def _inside(root: Path, file: Path, path: Path, key: str) -> Path:
    """``path``, if all links followed it lies below ``root``; what is not there is for others to complain of."""
    try:
        inside = path.resolve().is_relative_to(root)
    except (OSError, RuntimeError, ValueError) as error:  # a name too long, links in a circle, a zero byte
        raise UnusableInput(f"{file}: {key}: {str(path)[:200]!r} cannot be read") from error
    if not inside:
        raise UnusableInput(f"{file}: {key}: leads out of the console's folder, and nothing else is read")
    return path
