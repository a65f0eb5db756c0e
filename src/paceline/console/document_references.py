"""What clip.yaml, follow.yaml and site.yaml refer to: recordings, live cameras, rigs, targets. Reading is cached."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import TypeVar, cast

from paceline.documents.models import ClipModel, Document, FollowModel, SiteModel, StartModel, Text, read_document
from paceline.errors import UnusableInput

CLIP_FILE, FOLLOW_FILE = "clip.yaml", "follow.yaml"  # a folder that holds both is a stereo clip
# What a run may open outside the console's folder: cameras and streams, no files.
STREAM_PATTERN = re.compile(r"(rtsps?|https?|udp|rtp|srt|rtmps?)://\S+", re.IGNORECASE)
DEVICE_PATTERN = re.compile(r"/dev/video\d+")

MAX_DOCUMENT_BYTES = 512 << 10  # some 2500 outlined vehicles; reading them takes 2 s per MiB
MAX_CACHED_DOCUMENTS = 64

M = TypeVar("M", bound=Document)


class PartialFollowModel(FollowModel):
    """A follow.yaml that may not be complete: target and start may be missing."""

    target: Text | None = None  # type: ignore[assignment]
    start: StartModel | None = None  # type: ignore[assignment]


def read_cached(model: type[M], file: Path) -> M:
    """`read_document`, of a file that is not too large, again only once it has changed. Raises UnusableInput."""
    check_size(file)
    try:
        stat = file.stat()
    except (OSError, ValueError):  # the reader reports it
        return read_document(model, file)
    content = _read_or_message(model, file, stat.st_mtime_ns, stat.st_size)
    if isinstance(content, str):
        raise UnusableInput(content)
    return cast(M, content)


@lru_cache(MAX_CACHED_DOCUMENTS)
def _read_or_message(model: type[M], file: Path, changed: int, size: int) -> M | str:
    """The document, or the message of its error; cached, as each page reads the same documents repeatedly."""
    try:
        return read_document(model, file)
    except UnusableInput as error:
        return str(error)


def check_size(file: Path) -> None:
    """Raises UnusableInput where the document ``file`` exists and is larger than MAX_DOCUMENT_BYTES."""
    try:
        size = file.stat().st_size
    except (OSError, ValueError):
        return
    if size > MAX_DOCUMENT_BYTES:
        raise UnusableInput(f"{file}: is larger than {MAX_DOCUMENT_BYTES >> 10} KiB; no such file needs to be")


def is_follow(file: Path) -> bool:
    """Whether the document ``file`` is a follow.yaml, of one chase camera."""
    return file.name == FOLLOW_FILE


def recordings_of(file: Path) -> dict[str, str]:
    """The recordings that a document names, by key. Raises UnusableInput."""
    if is_follow(file):
        return {"video": read_cached(PartialFollowModel, file).video}
    model = read_cached(ClipModel, file)
    return {"left": model.left, "right": model.right}


def files_of(file: Path) -> dict[str, str]:
    """The other files that a document names, by key. Raises UnusableInput."""
    if is_follow(file):
        chase = read_cached(PartialFollowModel, file)
        named = {"camera": chase.camera, "target": chase.target, "odometry": chase.odometry}
    else:
        clip = read_cached(ClipModel, file)
        named = {"rig": clip.rig, "site": clip.site, "times": clip.times}
    return {key: name for key, name in named.items() if name is not None}


def rig_of_site(site: Path) -> Path:
    """The rig.yaml that a site.yaml names. Raises UnusableInput."""
    return site.parent / read_cached(SiteModel, site).rig


def is_live(file: Path, name: str) -> bool:
    """Whether the recording ``name`` in the document ``file`` is a camera or a stream. Raises UnusableInput for an
    address of any other kind."""
    if STREAM_PATTERN.fullmatch(name) or DEVICE_PATTERN.fullmatch(name):
        return True
    if "://" in name:
        raise UnusableInput(f"{file}: {without_password(name)}: expected a file, or an rtsp, http, udp or srt address")
    try:
        return (file.parent / name).is_fifo()
    except (OSError, ValueError):  # a name too long, a zero byte: the reader reports it
        return False


def live_views(file: Path) -> list[str]:
    """The live sources of a document, without passwords. Raises UnusableInput."""
    return [without_password(name) for name in recordings_of(file).values() if is_live(file, name)]


def without_password(address: str) -> str:
    """``address`` without user name and password, for messages."""
    return re.sub(r"//[^/@]*@", "//", address)
