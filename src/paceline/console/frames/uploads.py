"""Uploads of new clips: files are streamed to a hidden folder, which becomes the clip once it is complete."""

from __future__ import annotations

import asyncio
import lzma
import re
import secrets
import shutil
import zipfile
import zlib
from collections.abc import AsyncIterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import yaml

from paceline.console.confinement import check_container, check_document, check_name
from paceline.console.document_references import CLIP_FILE, FOLLOW_FILE, PartialFollowModel
from paceline.console.frames.frame_cache import ChaseFrames
from paceline.documents.loading import load_clip_recording, load_rig
from paceline.documents.models import ClipModel, read_document
from paceline.errors import UnusableInput
from paceline.recordings.image_sources import IMAGE_SUFFIXES, open_source
from paceline.recordings.stereo import open_recording

PARTIAL_PREFIX = ".paceline-import."
STEREO_VIEWS, CHASE_VIEWS = ("left", "right"), ("video",)  # recordings of a clip
YAML_NAMES = {"rig": "rig.yaml", "camera": "camera.yaml", "target": "target.yaml"}  # file names of the documents
VIDEO_SUFFIXES = {".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".ts", ".mts", ".mpg", ".mpeg", ".ogv", ".mxf"}
MAX_RECORDING_BYTES = 64 << 30  # size limit of a video, of a zip file, and of an unpacked zip file
MAX_YAML_BYTES = 1 << 20
MAX_IMAGES = 100_000  # images per view
MIN_FREE_DISK_BYTES = 256 << 20  # disk space that uploads leave free
CHUNK_BYTES = 1 << 20
# Raised while unpacking a zip file that is damaged, encrypted or too large for the disk.
UNPACK_ERRORS = (OSError, RuntimeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error, lzma.LZMAError)


@dataclass
class Upload:
    """An unfinished upload: its hidden folder, and the received files by slot. The clip is of two cameras or, with
    ``chase``, of one camera behind a vehicle."""

    name: str
    folder: Path
    chase: bool = False
    received: dict[str, list[Path]] = field(default_factory=dict)


class Uploads:
    """The unfinished uploads into ``root``. Those of an earlier console are removed."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._open: dict[str, Upload] = {}
        for left_over in root.glob(f"{PARTIAL_PREFIX}*"):
            if not left_over.is_symlink():
                shutil.rmtree(left_over, ignore_errors=True)

    def begin(self, name: str, chase: bool = False) -> str:
        """Begins the upload of a clip; returns its key. Raises UnusableInput."""
        try:
            exists = (self._root / check_name(name)).exists()
        except OSError as error:  # MAX_NAME_LENGTH characters may be too many bytes
            raise UnusableInput(f"name {name!r}: cannot be used ({error.strerror})") from error
        if exists:
            raise UnusableInput(f"name {name!r}: there is a clip or folder of this name; expected another")
        if (self._root / "clip.yaml").is_file():
            raise UnusableInput("the console's folder is a clip itself; open the console on the folder above it")
        key = secrets.token_urlsafe(12)
        folder = self._root / f"{PARTIAL_PREFIX}{secrets.token_hex(6)}"
        try:
            folder.mkdir()
        except OSError as error:
            raise UnusableInput(f"the folder of the console cannot be written ({error.strerror})") from error
        self._open[key] = Upload(name, folder, chase)
        return key

    async def receive(self, key: str, slot: str, name: str, size: int | None, body: AsyncIterator[bytes]) -> None:
        """Writes one file of the ``slot`` (left, right, rig; or video, camera, target); ``size`` is what the browser
        announces, bytes. Raises UnusableInput and removes the file where it cannot be taken."""
        upload = self._find(key)
        file = _upload_path(upload, slot, name)
        max_bytes = MAX_YAML_BYTES if slot in YAML_NAMES else MAX_RECORDING_BYTES
        short_name = Path(name).name[:80]
        if size is not None and size > max_bytes:
            raise UnusableInput(f"{short_name}: is larger than {_format_bytes(max_bytes)}")
        self._require_space(short_name, size or 0)
        written = 0
        try:
            file.parent.mkdir(exist_ok=True)
            stream = file.open("xb")
        except FileExistsError as error:
            raise UnusableInput(f"{short_name}: was sent twice; expected different names") from error
        except OSError as error:
            _remove_if_empty(file.parent)
            raise UnusableInput(f"{short_name}: cannot be written ({error.strerror})") from error
        try:
            with stream:
                async for part in _in_chunks(body):
                    written += len(part)
                    if written > max_bytes:
                        raise UnusableInput(f"{short_name}: is larger than {_format_bytes(max_bytes)}")
                    self._require_space(short_name, len(part))
                    await asyncio.to_thread(stream.write, part)
            if size is not None and written != size:
                raise UnusableInput(f"{short_name}: was not received completely; try again")
        except BaseException as error:
            file.unlink(missing_ok=True)
            _remove_if_empty(file.parent)
            if isinstance(error, OSError):
                raise UnusableInput(f"{short_name}: cannot be written ({error.strerror})") from error
            raise
        upload.received.setdefault(slot, []).append(file)

    def _require_space(self, name: str, count: int) -> None:
        """Raises UnusableInput where ``count`` further bytes of the file ``name`` leave too little of the disk free."""
        if shutil.disk_usage(self._root).free < count + MIN_FREE_DISK_BYTES:
            raise UnusableInput(f"{name}: there is not enough free disk space for it")

    def finish(self, key: str, rate: float | None) -> str:
        """Checks the received files and makes them a clip; returns its name. Raises UnusableInput, and then keeps the
        upload open for another file or rate."""
        upload = self._find(key)
        try:
            self._complete(upload, rate)
        except UnusableInput as error:
            raise UnusableInput(str(error).replace(f"{upload.folder}/", "")) from error
        target = self._root / upload.name
        if target.exists():
            raise UnusableInput(f"name {upload.name!r}: there is a clip or folder of this name; expected another")
        try:
            upload.folder.rename(target)
        except OSError as error:
            raise UnusableInput(f"name {upload.name!r}: cannot be written ({error.strerror})") from error
        del self._open[key]
        return upload.name

    def _complete(self, upload: Upload, rate: float | None) -> None:
        """Writes the clip.yaml or follow.yaml and checks that its recordings can be read."""
        views = CHASE_VIEWS if upload.chase else STEREO_VIEWS
        clip: dict[str, object] = {view: _recording_name(upload, view) for view in views}
        if any((upload.folder / str(clip[view])).is_dir() for view in views):
            if rate is None:
                raise UnusableInput("frames per second: missing; image files have no time stamps")
            clip["rate"] = rate
        clip |= {slot: name for slot, name in YAML_NAMES.items() if slot in upload.received}
        if upload.chase and "camera" not in clip:
            raise UnusableInput("camera: missing; expected the camera.yaml of the camera")
        file = upload.folder / (FOLLOW_FILE if upload.chase else CLIP_FILE)
        try:
            file.write_text(yaml.safe_dump(clip, sort_keys=False, allow_unicode=True), encoding="utf-8")
        except OSError as error:
            raise UnusableInput(f"{file}: cannot be written ({error.strerror})") from error
        read_document(PartialFollowModel if upload.chase else ClipModel, file)
        check_document(self._root, file)
        if upload.chase:
            ChaseFrames(file)
        elif "rig" in clip:
            open_recording(load_clip_recording(file))
        else:
            for view in views:
                open_source(upload.folder / str(clip[view]))

    def discard(self, key: str) -> None:
        """Removes an unfinished upload."""
        if key in self._open:
            shutil.rmtree(self._open.pop(key).folder, ignore_errors=True)

    def close(self) -> None:
        """Removes all unfinished uploads."""
        for key in list(self._open):
            self.discard(key)

    def _find(self, key: str) -> Upload:
        if key not in self._open:
            raise UnusableInput("this import is no longer open; start it again")
        return self._open[key]


def add_rig(file: Path, content: bytes) -> None:
    """Adds a rig.yaml to the clip.yaml ``file``, which must not have one yet. Raises UnusableInput."""
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
            raise UnusableInput(f"{file.name}: is written in a way that cannot be edited")
        for path, partial in partials.items():
            partial.replace(path)
    except OSError as error:
        raise UnusableInput(f"{rig}: cannot be written ({error.strerror})") from error
    finally:
        for partial in partials.values():
            partial.unlink(missing_ok=True)


def _upload_path(upload: Upload, slot: str, name: str) -> Path:
    """The path for an uploaded file ``name``: a video, a zip of images, or one of many images. Raises UnusableInput."""
    base = re.sub(r"[^\w.()+-]", "_", name.replace("\\", "/").rsplit("/", 1)[-1])
    suffix = Path(base).suffix.lower()
    received = upload.received.get(slot, [])
    views, texts = (CHASE_VIEWS, ("camera", "target")) if upload.chase else (STEREO_VIEWS, ("rig",))
    if slot in texts and suffix in (".yaml", ".yml"):
        if received:
            raise UnusableInput(f"{slot}: was sent twice; expected one file")
        return upload.folder / YAML_NAMES[slot]
    if slot in views and suffix in VIDEO_SUFFIXES | {".zip"}:
        if received:
            raise UnusableInput(f"{slot}: expected one video, one zip or several images")
        return upload.folder / f"{slot}{suffix}"
    if slot in views and suffix in IMAGE_SUFFIXES:
        if any(path.parent == upload.folder for path in received) or base.startswith("."):
            raise UnusableInput(f"{slot}: expected one video, one zip or several images")
        if len(received) >= MAX_IMAGES:
            raise UnusableInput(f"{slot}: more than {MAX_IMAGES} images")
        return upload.folder / slot / base
    raise UnusableInput(f"{base[:80]}: is no {YAML_NAMES.get(slot, 'video, zip or image')}")


def _remove_if_empty(folder: Path) -> None:
    """Removes the ``folder`` of a view's images where there are none; the folder of an upload itself is kept."""
    if not folder.name.startswith(PARTIAL_PREFIX):
        with suppress(OSError):  # it holds other images
            folder.rmdir()


def _recording_name(upload: Upload, view: str) -> str:
    """The file or folder of a view as the clip.yaml names it; a zip file is unpacked. Raises UnusableInput."""
    files = upload.received.get(view, [])
    if not files:
        raise UnusableInput(f"{view}: missing; expected a video, a zip of images or several images")
    first = files[0]
    if first.suffix == ".zip" and first.exists():
        _unpack(first, upload.folder / view)
        first.unlink()
    if (upload.folder / view).is_dir():
        return view
    check_container(first)
    return first.name


async def _in_chunks(body: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The same bytes in chunks of about CHUNK_BYTES."""
    part = bytearray()
    async for chunk in body:
        part += chunk
        if len(part) >= CHUNK_BYTES:
            yield bytes(part)
            part.clear()
    yield bytes(part)


def _unpack(archive: Path, folder: Path) -> None:
    """Unpacks the images of ``archive`` into a new ``folder``, without subfolders. Raises UnusableInput."""
    total = 0
    try:
        with zipfile.ZipFile(archive) as packed:
            members = [m for m in packed.infolist() if not m.is_dir() and _is_image(m.filename)]
            if len(members) > MAX_IMAGES:
                raise UnusableInput(f"{archive.name}: holds more than {MAX_IMAGES} images")
            folder.mkdir()
            for member in members:
                file = folder / re.sub(r"[^\w.()+-]", "_", Path(member.filename).name)
                with packed.open(member) as source, file.open("xb") as target:
                    total = _copy_member(source, target, total, archive)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, FileExistsError):
            raise UnusableInput(f"{archive.name}: holds two images with the same name") from error
        if isinstance(error, UNPACK_ERRORS):
            raise UnusableInput(f"{archive.name}: cannot be unpacked ({error})") from error
        raise


def _copy_member(source: IO[bytes], target: IO[bytes], total: int, archive: Path) -> int:
    """Copies one member, counting its bytes: the size stated in the archive may be wrong. Returns the new total."""
    while chunk := source.read(CHUNK_BYTES):
        total += len(chunk)
        if total > MAX_RECORDING_BYTES or shutil.disk_usage(archive.parent).free < MIN_FREE_DISK_BYTES:
            raise UnusableInput(f"{archive.name}: holds more than fits on the disk")
        target.write(chunk)
    return total


def _is_image(name: str) -> bool:
    base = name.rsplit("/", 1)[-1]
    return Path(base).suffix.lower() in IMAGE_SUFFIXES and not base.startswith(".")


def _format_bytes(count: int) -> str:
    return f"{count >> 30} GiB" if count >= 1 << 30 else f"{count >> 20} MiB"
