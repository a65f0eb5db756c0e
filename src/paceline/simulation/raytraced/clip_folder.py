"""The folder of a clip that is being rendered: an interrupted rendering is resumed, never mixed with another."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from paceline.errors import UnusableInput
from paceline.simulation.raytraced.scene_yaml import SceneModel
from paceline.simulation.video import write_h264
from paceline.version import __version__

Picture = NDArray[np.uint8]

STATE_FILE = "rendering.json"


def open_folder(directory: Path, scene: SceneModel, variant: str) -> None:
    """Makes ``directory`` ready for the pictures of ``scene``, or finds it begun by the same scene.

    Raises UnusableInput where it cannot be written or holds anything else.
    """
    document = scene.model_dump()
    state = {"scene": document, "variant": variant, "version": __version__}
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if (directory / STATE_FILE).exists():
            if json.loads((directory / STATE_FILE).read_text(encoding="utf-8")) != json.loads(json.dumps(state)):
                raise UnusableInput(f"{directory}: was begun with another scene or renderer; expected another folder")
            return
        if any(directory.iterdir()):
            raise UnusableInput(f"{directory}: holds other files; expected an empty folder, or one begun by this scene")
        write_atomically(directory / "scene.yaml", yaml.safe_dump(document, sort_keys=False).encode())
        write_atomically(directory / STATE_FILE, json.dumps(state).encode())
    except (OSError, json.JSONDecodeError) as error:
        text = error.strerror if isinstance(error, OSError) else "its rendering.json is damaged"
        raise UnusableInput(f"{directory}: the clip cannot be written here ({text})") from error


def write_atomically(path: Path, content: bytes) -> None:
    """Writes a file that is either there wholly or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(content)
    os.replace(partial, path)


def write_picture(path: Path, picture: Picture, quality: int) -> None:
    """Writes a PNG or a JPEG, whole or not at all."""
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if path.suffix == ".jpg" else [cv2.IMWRITE_PNG_COMPRESSION, 3]
    write_atomically(path, cv2.imencode(path.suffix, picture, options)[1].tobytes())


def write_yaml(path: Path, document: dict[str, Any]) -> None:
    write_atomically(path, yaml.safe_dump(document, sort_keys=False).encode())


def write_video(path: Path, pictures: list[Path], times: list[float], quality: int) -> None:
    """Writes ``pictures`` as H.264 with their ``times`` (s) as time stamps; ``quality`` 100 is nearly free of loss."""
    write_h264(path, map(read_picture, pictures), times, round(0.51 * (100 - quality)))


def read_picture(path: Path) -> Picture:
    """A picture (H, W, 3), blue, green, red, that `write_picture` wrote."""
    return np.asarray(cv2.imread(str(path), cv2.IMREAD_COLOR), np.uint8)


def remove_pictures(folder: Path) -> None:
    """Removes a folder of pictures, where a video has taken their place."""
    for picture in folder.iterdir():
        picture.unlink()
    folder.rmdir()
