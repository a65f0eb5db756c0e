"""New clips from files that a browser sends, written to disk as they come and put in place whole."""

from __future__ import annotations

import asyncio
import lzma
import re
import secrets
import shutil
import zipfile
import zlib
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import yaml

from paceline.console.confinement import check_container, check_document, check_name
from paceline.console.document_names import CLIP, FOLLOW, ChaseModel
from paceline.console.frames.frame_cache import ChasePictures
from paceline.documents.loading import load_clip_recording, load_rig
from paceline.documents.models import ClipModel, read_document
from paceline.errors import UnusableInput
from paceline.recordings.image_sources import IMAGE_SUFFIXES, open_source
from paceline.recordings.stereo import open_recording

PARTIAL = ".paceline-import."
STEREO, CHASE = ("left", "right"), ("video",)  # recordings of a clip
TEXTS = {"rig": "rig.yaml", "camera": "camera.yaml", "target": "target.yaml"}  # and what belongs to them
VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".ts", ".mts", ".mpg", ".mpeg", ".ogv", ".mxf"}
LARGEST_FILE = 64 << 30  # bytes, of one video, of one zip, and of what a zip holds
LARGEST_RIG = 1 << 20
MOST_IMAGES = 100_000  # of one view
SPARE = 256 << 20  # bytes that stay free on the disk
CHUNK = 1 << 20
# What a zip that is damaged, locked or too large for the disk makes unpacking raise.
DAMAGED = (OSError, RuntimeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, lzma.LZMAError)


@dataclass
class Import:
    """A clip on its way in: its hidden folder, and what has come so far, by slot. It is of two cameras, or, as a
    ``chase``, of one that follows a vehicle."""

    name: str
    folder: Path
    chase: bool = False
    received: dict[str, list[Path]] = field(default_factory=dict)


class Imports:
    """The clips on their way into ``root``. What an earlier console left half done is removed."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._open: dict[str, Import] = {}
        for left_over in root.glob(f"{PARTIAL}*"):
            if not left_over.is_symlink():
                shutil.rmtree(left_over, ignore_errors=True)

    def begin(self, name: str, chase: bool = False) -> str:
        """Makes room for a clip; returns the key of its import. Raises UnusableInput."""
        try:
            taken = (self._root / check_name(name)).exists()
        except OSError as error:  # 80 characters may be too many bytes
            raise UnusableInput(f"name {name!r}: cannot be used ({error.strerror})") from error
        if taken:
            raise UnusableInput(f"name {name!r}: there is a clip or folder of this name; expected another")
        if (self._root / "clip.yaml").is_file():
            raise UnusableInput("the console's folder is a clip itself; open the console on the folder above it")
        key = secrets.token_urlsafe(12)
        folder = self._root / f"{PARTIAL}{secrets.token_hex(6)}"
        try:
            folder.mkdir()
        except OSError as error:
            raise UnusableInput(f"the folder of the console cannot be written ({error.strerror})") from error
        self._open[key] = Import(name, folder, chase)
        return key

    async def receive(self, key: str, slot: str, name: str, size: int | None, body: AsyncIterator[bytes]) -> None:
        """Writes one file into the ``slot`` (left, right, rig; or video, camera, target) as it comes; ``size`` is what
        the browser announces.
        Raises UnusableInput, after which nothing of the file is left."""
        found = self._find(key)
        file = _place(found, slot, name)
        most = LARGEST_RIG if slot in TEXTS else LARGEST_FILE
        shown = Path(name).name[:80]
        if size is not None and size > most:
            raise UnusableInput(f"{shown}: is larger than {_bytes(most)}")
        if shutil.disk_usage(self._root).free < (size or 0) + SPARE:
            raise UnusableInput(f"{shown}: there is not enough room for it on the disk")
        written = 0
        try:
            file.parent.mkdir(exist_ok=True)
            stream = file.open("xb")
        except FileExistsError as error:
            raise UnusableInput(f"{shown}: came twice; expected different names") from error
        except OSError as error:
            raise UnusableInput(f"{shown}: cannot be written ({error.strerror})") from error
        try:
            with stream:
                async for part in _gathered(body):
                    written += len(part)
                    if written > most:
                        raise UnusableInput(f"{shown}: is larger than {_bytes(most)}")
                    await asyncio.to_thread(stream.write, part)
            if size is not None and written != size:
                raise UnusableInput(f"{shown}: came incomplete; try again")
        except BaseException as error:
            file.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise UnusableInput(f"{shown}: cannot be written ({error.strerror})") from error
            raise
        found.received.setdefault(slot, []).append(file)

    def finish(self, key: str, rate: float | None) -> str:
        """Checks what has come and puts the clip in place; returns its name. Raises UnusableInput, after which the
        import is still open for another file or rate."""
        found = self._find(key)
        try:
            self._complete(found, rate)
        except UnusableInput as error:
            raise UnusableInput(str(error).replace(f"{found.folder}/", "")) from error
        target = self._root / found.name
        if target.exists():
            raise UnusableInput(f"name {found.name!r}: there is a clip or folder of this name; expected another")
        try:
            found.folder.rename(target)
        except OSError as error:
            raise UnusableInput(f"name {found.name!r}: cannot be written ({error.strerror})") from error
        del self._open[key]
        return found.name

    def _complete(self, found: Import, rate: float | None) -> None:
        """Writes the clip.yaml or follow.yaml and checks that its recordings can be read."""
        views = CHASE if found.chase else STEREO
        clip: dict[str, object] = {view: _recorded(found, view) for view in views}
        if any((found.folder / str(clip[view])).is_dir() for view in views):
            if rate is None:
                raise UnusableInput("frames per second: missing; images do not tell when they were taken")
            clip["rate"] = rate
        clip |= {slot: name for slot, name in TEXTS.items() if slot in found.received}
        if found.chase and "camera" not in clip:
            raise UnusableInput("camera: missing; expected the camera.yaml of the camera")
        file = found.folder / (FOLLOW if found.chase else CLIP)
        try:
            file.write_text(yaml.safe_dump(clip, sort_keys=False, allow_unicode=True), encoding="utf-8")
        except OSError as error:
            raise UnusableInput(f"{file}: cannot be written ({error.strerror})") from error
        read_document(ChaseModel if found.chase else ClipModel, file)
        check_document(self._root, file)
        if found.chase:
            ChasePictures(file)
        elif "rig" in clip:
            open_recording(load_clip_recording(file))
        else:
            for view in views:
                open_source(found.folder / str(clip[view]))

    def give_up(self, key: str) -> None:
        """Removes what has come."""
        if key in self._open:
            shutil.rmtree(self._open.pop(key).folder, ignore_errors=True)

    def close(self) -> None:
        """Removes whatever is half done."""
        for key in list(self._open):
            self.give_up(key)

    def _find(self, key: str) -> Import:
        if key not in self._open:
            raise UnusableInput("this import is no longer open; begin it again")
        return self._open[key]


def add_rig(file: Path, content: bytes) -> None:
    """Puts a rig.yaml beside the clip.yaml ``file``, which has none yet, and names it there. Raises UnusableInput."""
    model = read_document(ClipModel, file)
    rig = file.with_name("rig.yaml")
    if model.rig is not None or model.site is not None or rig.exists():
        raise UnusableInput(f"{rig.name}: the clip has a rig already")
    partials = {path: path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial") for path in (rig, file)}
    text = file.read_text(encoding="utf-8")
    try:
        partials[rig].write_bytes(content)
        try:
            load_rig(partials[rig])
        except UnusableInput as error:
            raise UnusableInput(str(error).replace(str(partials[rig]), "the rig file")) from error
        partials[file].write_text(text.rstrip("\n") + "\nrig: rig.yaml\n", encoding="utf-8")
        if read_document(ClipModel, partials[file]).rig != "rig.yaml":
            raise UnusableInput(f"{file.name}: is written in a way that cannot be added to")
        for path, partial in partials.items():
            partial.replace(path)
    except OSError as error:
        raise UnusableInput(f"{rig}: cannot be written ({error.strerror})") from error
    finally:
        for partial in partials.values():
            partial.unlink(missing_ok=True)


def _place(found: Import, slot: str, name: str) -> Path:
    """Where a file of this ``name`` goes: a video, a zip of images, or one of many images. Raises UnusableInput."""
    base = re.sub(r"[^\w.()+-]", "_", name.replace("\\", "/").rsplit("/", 1)[-1])
    suffix = Path(base).suffix.lower()
    here = found.received.get(slot, [])
    views, texts = (CHASE, ("camera", "target")) if found.chase else (STEREO, ("rig",))
    if slot in texts and suffix in (".yaml", ".yml"):
        if here:
            raise UnusableInput(f"{slot}: came twice; expected one file")
        return found.folder / TEXTS[slot]
    if slot in views and suffix in VIDEO_SUFFIXES | {".zip"}:
        if here:
            raise UnusableInput(f"{slot}: expected one video, one zip or several images")
        return found.folder / f"{slot}{suffix}"
    if slot in views and suffix in IMAGE_SUFFIXES:
        if any(path.parent == found.folder for path in here) or base.startswith("."):
            raise UnusableInput(f"{slot}: expected one video, one zip or several images")
        if len(here) >= MOST_IMAGES:
            raise UnusableInput(f"{slot}: more than {MOST_IMAGES} images")
        return found.folder / slot / base
    raise UnusableInput(f"{base[:80]}: is no {TEXTS.get(slot, 'video, zip or image')}")


def _recorded(found: Import, view: str) -> str:
    """The file or folder of a view as its clip.yaml names it; a zip is unpacked. Raises UnusableInput."""
    files = found.received.get(view, [])
    if not files:
        raise UnusableInput(f"{view}: missing; expected a video, a zip of images or several images")
    first = files[0]
    if first.suffix == ".zip" and first.exists():
        _unpack(first, found.folder / view)
        first.unlink()
    if (found.folder / view).is_dir():
        return view
    check_container(first)
    return first.name


async def _gathered(body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The same bytes in pieces of about CHUNK."""
    part = bytearray()
    async for chunk in body:
        part += chunk
        if len(part) >= CHUNK:
            yield bytes(part)
            part.clear()
    yield bytes(part)


def _unpack(archive: Path, folder: Path) -> None:
    """The images of ``archive`` in a new ``folder``, without their own folders. Raises UnusableInput."""
    total = 0
    try:
        with zipfile.ZipFile(archive) as packed:
            members = [m for m in packed.infolist() if not m.is_dir() and _is_image(m.filename)]
            if len(members) > MOST_IMAGES:
                raise UnusableInput(f"{archive.name}: holds more than {MOST_IMAGES} images")
            folder.mkdir()
            for member in members:
                file = folder / re.sub(r"[^\w.()+-]", "_", Path(member.filename).name)
                with packed.open(member) as source, file.open("xb") as target:
                    total = _copy(source, target, total, archive)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, FileExistsError):
            raise UnusableInput(f"{archive.name}: holds two images of one name") from error
        if isinstance(error, DAMAGED):
            raise UnusableInput(f"{archive.name}: cannot be unpacked ({error})") from error
        raise


def _copy(source: IO[bytes], target: IO[bytes], total: int, archive: Path) -> int:
    """Copies one member; its stated size is not believed."""
    while chunk := source.read(CHUNK):
        total += len(chunk)
        if total > LARGEST_FILE or shutil.disk_usage(archive.parent).free < SPARE:
            raise UnusableInput(f"{archive.name}: holds more than there is room for")
        target.write(chunk)
    return total


def _is_image(name: str) -> bool:
    base = name.rsplit("/", 1)[-1]
    return Path(base).suffix.lower() in IMAGE_SUFFIXES and not base.startswith(".")


def _bytes(count: int) -> str:
    return f"{count >> 30} GiB" if count >= 1 << 30 else f"{count >> 20} MiB"
