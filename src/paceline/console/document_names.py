"""What the documents of clips are called and name: recordings, rigs, cameras, targets, and live sources."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path
from typing import TypeVar, cast

from paceline.documents.models import ClipModel, Document, FollowModel, SiteModel, StartModel, Text, read_document
from paceline.errors import UnusableInput

CLIP, FOLLOW = "clip.yaml", "follow.yaml"  # a folder that holds both is a stereo clip
# What may be opened beyond the console's folder, by a run that a person starts: cameras, and nothing on the disk.
STREAM = re.compile(r"(rtsps?|https?|udp|rtp|srt|rtmps?)://\S+", re.IGNORECASE)
DEVICE = re.compile(r"/dev/video\d+")


LARGEST_DOCUMENT = 512 << 10  # bytes, of some 2500 outlined vehicles; reading YAML takes ten seconds for each MiB
REMEMBERED = 64  # documents

M = TypeVar("M", bound=Document)


class ChaseModel(FollowModel):
    """A follow.yaml on its way: the target and where it starts may still be missing."""

    target: Text | None = None  # type: ignore[assignment]
    start: StartModel | None = None  # type: ignore[assignment]


def read_small(model: type[M], file: Path) -> M:
    """`read_document`, of a file that is not too large, again only once it has changed. Raises UnusableInput."""
    check_small(file)
    try:
        stat = file.stat()
    except (OSError, ValueError):  # for the reading to complain of
        return read_document(model, file)
    found = _read(model, file, stat.st_mtime_ns, stat.st_size)
    if isinstance(found, str):
        raise UnusableInput(found)
    return cast(M, found)


@lru_cache(REMEMBERED)
def _read(model: type[M], file: Path, changed: int, size: int) -> M | str:
    """The document, or what is wrong with it: several questions are asked of the same one."""
    try:
        return read_document(model, file)
    except UnusableInput as error:
        return str(error)


def check_small(file: Path) -> None:
    """Raises UnusableInput where the document ``file`` is larger than LARGEST_DOCUMENT; others complain of one that is
    not there."""
    try:
        size = file.stat().st_size
    except (OSError, ValueError):
        return
    if size > LARGEST_DOCUMENT:
        raise UnusableInput(f"{file}: is larger than {LARGEST_DOCUMENT >> 10} KiB; no such file needs to be")


def is_chase(file: Path) -> bool:
    """Whether the document ``file`` is a follow.yaml, of one camera."""
    return file.name == FOLLOW


def recordings_of(file: Path) -> dict[str, str]:
    """The recordings that a document names, by key. Raises UnusableInput."""
    if is_chase(file):
        return {"video": read_small(ChaseModel, file).video}
    model = read_small(ClipModel, file)
    return {"left": model.left, "right": model.right}


def files_of(file: Path) -> dict[str, str]:
    """The other files that a document names, by key. Raises UnusableInput."""
    if is_chase(file):
        chase = read_small(ChaseModel, file)
        named = {"camera": chase.camera, "target": chase.target, "odometry": chase.odometry}
    else:
        clip = read_small(ClipModel, file)
        named = {"rig": clip.rig, "site": clip.site, "times": clip.times}
    return {key: given for key, given in named.items() if given is not None}


def rig_of_site(site: Path) -> Path:
    """The rig.yaml that a site.yaml names. Raises UnusableInput."""
    return site.parent / read_small(SiteModel, site).rig


def is_live(file: Path, given: str) -> bool:
    """Whether the recording that the document ``file`` calls ``given`` is a camera or a stream. Raises UnusableInput
    for an address of anything else."""
    if STREAM.fullmatch(given) or DEVICE.fullmatch(given):
        return True
    if "://" in given:
        raise UnusableInput(f"{file}: {without_password(given)}: expected a file, or an rtsp, http, udp or srt address")
    try:
        return (file.parent / given).is_fifo()
    except (OSError, ValueError):  # a name too long, a zero byte: for others to complain of
        return False


def live_views(file: Path) -> list[str]:
    """The live sources of a document as people may see them. Raises UnusableInput."""
    return [without_password(given) for given in recordings_of(file).values() if is_live(file, given)]


def without_password(address: str) -> str:
    """``address`` as messages may repeat it."""
    return re.sub(r"//[^/@]*@", "//", address)
