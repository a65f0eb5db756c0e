"""Stereo rigs from the calibration files of other programs.

* OpenCV: one or two files written by ``cv::FileStorage`` (YAML or XML), with the names of its stereo_calib example (M1,
  D1, M2, D2, R, T) or the other names of `OPENCV_KEYS`.
* Kalibr: a camchain.yaml; pinhole cameras with radial-tangential distortion (radtan) or none.
* ROS: two camera_info files, as the package camera_calibration writes them. The pose comes from a pair's rectifying
  rotations R and projections P.
* KITTI: calib_cam_to_cam.txt of the raw data, or a file of projection matrices P0 … P3.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from paceline.arrays import Array
from paceline.cameras import Camera, StereoRig
from paceline.documents import plausibility
from paceline.documents.assumed_calibration import with_assumed_uncertainty
from paceline.documents.yaml_loading import load_yaml
from paceline.errors import UnusableInput, refuse_pipe_or_device

Size = tuple[int, int]

OPENCV_KEYS = {  # what a matrix may be called, first the names of OpenCV's own example
    "K1": ("M1", "K1", "cameraMatrix1", "camera_matrix_1", "left_camera_matrix", "K_left"),
    "K2": ("M2", "K2", "cameraMatrix2", "camera_matrix_2", "right_camera_matrix", "K_right"),
    "D1": ("D1", "distCoeffs1", "dist_coeffs_1", "left_distortion_coefficients", "D_left"),
    "D2": ("D2", "distCoeffs2", "dist_coeffs_2", "right_distortion_coefficients", "D_right"),
    "R": ("R", "rotation", "rotation_matrix"),
    "T": ("T", "t", "translation", "translation_vector"),
}
WIDTH_KEYS = ("image_width", "imageWidth", "width")
HEIGHT_KEYS = ("image_height", "imageHeight", "height")
COEFFICIENT_COUNTS = (0, 4, 5, 8, 12, 14)
EXPECTED_FILES = (
    "an OpenCV stereo calibration (YAML or XML), a Kalibr camchain, two ROS camera_info files or a KITTI calib file"
)


@dataclass(frozen=True)
class ImportOptions:
    """What the files may leave open: the image ``size``, the metres per ``unit`` of length, the two ``cameras`` of a
    chain, and whether the images are ``rectified``."""

    size: Size | None = None
    unit: float = 1.0
    cameras: tuple[int, int] = (0, 1)
    rectified: bool = True


def import_rig(files: Sequence[Path], options: ImportOptions) -> tuple[StereoRig, str]:
    """The rig that ``files`` describe, and the kind of file they are.

    Raises UnusableInput, naming the file and the key, where they describe none.
    """
    texts = {file: _text(file) for file in files}
    if len(texts) < len(files):
        raise UnusableInput(f"{files[0]}: is given twice; expected the left camera's file and the right one's")
    first, content = next(iter(texts.items()))
    if re.search(r"^P(_rect_0)?0:", content, re.MULTILINE):
        reader: Callable[[dict[Path, str], ImportOptions], StereoRig] = _kitti
        kind = "KITTI"
    elif re.match(r"\s*(<\?xml|<opencv_storage|%YAML)", content):
        reader, kind = _opencv, "OpenCV"
    else:
        document = _yaml(first, content)
        if "cam0" in document:
            reader, kind = _kalibr, "Kalibr"
        elif "camera_matrix" in document or {"k", "K"} & document.keys():
            reader, kind = _ros, "ROS"
        else:
            raise UnusableInput(f"{first}: is not known; expected {EXPECTED_FILES}")
    if len(files) > (2 if kind in ("OpenCV", "ROS") else 1):
        raise UnusableInput(f"{files[-1]}: one file too many; a {kind} rig is described by fewer")
    rig = reader(texts, options)
    for complaint in (
        *(plausibility.check_intrinsics(camera) for camera in rig.cameras),
        plausibility.check_rotation(rig.R),
        plausibility.check_baseline(rig),
    ):
        if complaint:
            hint = "; --translation-unit mm states that" if "millimetres" in complaint else ""
            raise UnusableInput(f"{first}: {complaint}{hint}")
    return with_assumed_uncertainty(replace(rig, R=plausibility.nearest_rotation(rig.R))), kind


# --- OpenCV --------------------------------------------------------------------------------------------------------


def _opencv(texts: dict[Path, str], options: ImportOptions) -> StereoRig:
    matrices: dict[str, Array] = {}
    file_names = " and ".join(map(str, texts))
    for file, text in texts.items():
        try:
            storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        except (cv2.error, SystemError) as error:
            raise UnusableInput(f"{file}: is no whole OpenCV file") from error
        for name, names in {**OPENCV_KEYS, "width": WIDTH_KEYS, "height": HEIGHT_KEYS}.items():
            for key in names:
                node = storage.getNode(key)
                if not node.empty() and name not in matrices:
                    scalar = name in ("width", "height")
                    value = node.real() if scalar else node.mat() if node.isMap() else None
                    if value is not None:
                        matrices[name] = np.asarray(value, float)
        storage.release()
    for name in ("K1", "K2", "R", "T"):
        if name not in matrices:
            raise UnusableInput(f"{file_names}: {OPENCV_KEYS[name][0]} is missing; expected M1, D1, M2, D2, R and T")
    size = options.size
    if "width" in matrices and "height" in matrices:
        size = int(matrices["width"]), int(matrices["height"])
    lenses = []
    for k in "12":
        D = matrices.get(f"D{k}", np.zeros(0))
        lenses.append(_camera(file_names, f"M{k}", matrices[f"K{k}"], D.ravel().tolist(), size))
    return StereoRig(
        lenses[0],
        lenses[1],
        _rotation(file_names, "R", matrices["R"]),
        _vector(file_names, "T", matrices["T"], options),
    )


# --- Kalibr --------------------------------------------------------------------------------------------------------


def _kalibr(texts: dict[Path, str], options: ImportOptions) -> StereoRig:
    file, text = next(iter(texts.items()))
    chain = _yaml(file, text)
    a, b = options.cameras
    T, lenses = np.eye(4), []
    for k in range(a, b + 1) if a < b else ():
        if f"cam{k}" not in chain:
            raise UnusableInput(f"{file}: cam{k} is missing; expected cam{a} to cam{b}")
        if k > a:
            T = _array(file, f"cam{k}.T_cn_cnm1", chain[f"cam{k}"].get("T_cn_cnm1"), (4, 4)) @ T
    if a >= b:
        raise UnusableInput(f"--cameras {a},{b}: expected the left camera's number first, and the smaller one")
    for k in (a, b):
        camera = chain[f"cam{k}"]
        if (model := camera.get("camera_model")) != "pinhole":
            raise UnusableInput(f"{file}: cam{k}.camera_model: {model!r} is not supported; expected pinhole")
        distortion = camera.get("distortion_model")
        if distortion not in ("radtan", "none"):
            raise UnusableInput(
                f"{file}: cam{k}.distortion_model: {distortion!r} is not supported; expected radtan or none"
            )
        fx, fy, cx, cy = _array(file, f"cam{k}.intrinsics", camera.get("intrinsics"), (4,))
        size = _array(file, f"cam{k}.resolution", camera.get("resolution"), (2,))
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        coefficients = camera.get("distortion_coeffs") or [] if distortion == "radtan" else []
        lenses.append(_camera(file, f"cam{k}", K, coefficients, (int(size[0]), int(size[1]))))
    return StereoRig(lenses[0], lenses[1], T[:3, :3], options.unit * T[:3, 3])


# --- ROS -----------------------------------------------------------------------------------------------------------


def _ros(texts: dict[Path, str], options: ImportOptions) -> StereoRig:
    if len(texts) != 2:
        raise UnusableInput(f"{next(iter(texts))}: is one camera's camera_info; expected the left and the right one")
    lenses: list[Camera] = []
    rotations: list[Array] = []
    shifts: list[Array] = []
    for file, text in texts.items():
        info = _yaml(file, text)
        size = int(_scalar(file, info, WIDTH_KEYS)), int(_scalar(file, info, HEIGHT_KEYS))
        K = _matrix(file, info, ("camera_matrix", "k", "K"), (3, 3))
        R = _matrix(file, info, ("rectification_matrix", "r", "R"), (3, 3))
        P = _matrix(file, info, ("projection_matrix", "p", "P"), (3, 4))
        model = info.get("distortion_model", "plumb_bob")
        if model not in ("plumb_bob", "rational_polynomial"):
            raise UnusableInput(
                f"{file}: distortion_model: {model!r} is not supported; expected plumb_bob or rational_polynomial"
            )
        D = info.get("distortion_coefficients", info.get("d", info.get("D", [])))
        D = D.get("data", []) if isinstance(D, Mapping) else D
        if not K[0, 0] > 0 or not P[0, 0] > 0:
            raise UnusableInput(f"{file}: the camera is not calibrated, its matrices hold zeros")
        shifts.append(_shift(P))
        rotations.append(_rotation(file, "rectification_matrix", R))
        lens = _camera(
            file, "camera_matrix", P[:, :3] if options.rectified else K, [] if options.rectified else D, size
        )
        lenses.append(lens)
    return _from_rectified(lenses, rotations, shifts, options)


def _from_rectified(
    lenses: list[Camera], rotations: list[Array], shifts: list[Array], options: ImportOptions
) -> StereoRig:
    """The rig of cameras that see ``X_rect = turn X`` plus a shift of their own, both in the same rectified axes."""
    t = options.unit * (shifts[1] - shifts[0])
    if options.rectified:
        return StereoRig(lenses[0], lenses[1], np.eye(3), t)
    return StereoRig(lenses[0], lenses[1], rotations[1].T @ rotations[0], rotations[1].T @ t)


# --- KITTI ---------------------------------------------------------------------------------------------------------


def _kitti(texts: dict[Path, str], options: ImportOptions) -> StereoRig:
    file, text = next(iter(texts.items()))
    values = {}
    for line in text.splitlines():
        key, colon, numbers = line.partition(":")
        try:
            values[key.strip()] = np.array([float(x) for x in numbers.split()])
        except ValueError:  # a date
            continue
    raw = any(key.startswith("P_rect_") for key in values)
    if not raw and not options.rectified:
        raise UnusableInput(
            f"{file}: holds the rectified cameras alone; expected calib_cam_to_cam.txt for --unrectified"
        )

    def read(key: str, shape: tuple[int, ...]) -> Array:
        if key not in values or values[key].size != np.prod(shape):
            raise UnusableInput(
                f"{file}: {key}: {'missing' if key not in values else 'expected'} {np.prod(shape)} numbers"
            )
        return values[key].reshape(shape)

    lenses: list[Camera] = []
    turns: list[Array] = []
    shifts: list[Array] = []
    for k in options.cameras:
        size = options.size
        if raw:
            width, height = read(f"S_rect_{k:02d}" if options.rectified else f"S_{k:02d}", (2,))
            size = int(width), int(height)
        if options.rectified:
            P = read(f"P_rect_{k:02d}" if raw else f"P{k}", (3, 4))
            lenses.append(_camera(file, f"P{k}", P[:, :3], [], size))
            turns.append(np.eye(3))
            shifts.append(_shift(P))
        else:
            K, D = read(f"K_{k:02d}", (3, 3)), read(f"D_{k:02d}", (5,))
            lenses.append(_camera(file, f"K_{k:02d}", K, D.tolist(), size))
            turns.append(read(f"R_{k:02d}", (3, 3)))
            shifts.append(read(f"T_{k:02d}", (3,)))
    if options.rectified:
        return _from_rectified(lenses, turns, shifts, options)
    R = np.asarray(turns[1] @ turns[0].T, float)  # each: from camera 0 to its own axes
    return StereoRig(lenses[0], lenses[1], R, options.unit * (shifts[1] - R @ shifts[0]))


# --- shared functions ----------------------------------------------------------------------------------------------


def _text(file: Path) -> str:
    refuse_pipe_or_device(file)
    try:
        return file.read_text(encoding="utf-8")
    except OSError as error:
        raise UnusableInput(f"{file}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise UnusableInput(f"{file}: is not a text file; expected {EXPECTED_FILES}") from error


def _yaml(file: Path, text: str) -> dict[str, Any]:
    try:
        document = load_yaml(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UnusableInput(f"{file}: is not valid YAML; expected {EXPECTED_FILES}") from error
    if not isinstance(document, dict):
        raise UnusableInput(f"{file}: is not known; expected {EXPECTED_FILES}")
    return document


def _camera(file: Path | str, key: str, K: Array, coefficients: Sequence[float], size: Size | None) -> Camera:
    if size is None:
        raise UnusableInput(f"{file}: does not say the size of the images; expected --size WIDTHxHEIGHT")
    if K.shape != (3, 3) or not np.isfinite(K).all():
        raise UnusableInput(f"{file}: {key}: expected a 3 × 3 matrix of finite numbers")
    if K[0, 1] or K[1, 0]:
        raise UnusableInput(
            f"{file}: {key}: holds a skew of {K[0, 1]:g}; expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        )
    try:
        D = np.array(coefficients, float).ravel()
    except (TypeError, ValueError):
        raise UnusableInput(f"{file}: {key}: the distortion is no list of numbers") from None
    if len(D) not in COEFFICIENT_COUNTS or not np.isfinite(D).all():
        raise UnusableInput(f"{file}: {key}: expected 4, 5, 8, 12 or 14 coefficients of distortion, found {len(D)}")
    return Camera(size, K, D)


def _shift(P: Array) -> Array:
    """What a projection matrix (3, 4) adds to points before its (3, 3) part projects them."""
    return np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), float)


def _rotation(file: Path | str, key: str, R: Array) -> Array:
    R = np.asarray(cv2.Rodrigues(R.ravel())[0]) if R.size == 3 else R
    if R.shape != (3, 3):
        raise UnusableInput(f"{file}: {key}: expected a rotation, found {R.size} numbers")
    return R


def _vector(file: Path | str, key: str, t: Array, options: ImportOptions) -> Array:
    if t.size != 3:
        raise UnusableInput(f"{file}: {key}: expected three numbers, found {t.size}")
    return options.unit * t.ravel()


def _array(file: Path | str, key: str, value: Any, shape: tuple[int, ...]) -> Array:
    try:
        array = np.array(value, float)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.size != np.prod(shape) or not np.isfinite(array).all():
        expected = " × ".join(map(str, shape))
        raise UnusableInput(f"{file}: {key}: expected {expected} finite numbers")
    return array.reshape(shape)


def _matrix(file: Path, info: Mapping[str, Any], keys: Sequence[str], shape: tuple[int, int]) -> Array:
    for key in keys:
        if key in info:
            value = info[key]
            return _array(file, key, value.get("data") if isinstance(value, Mapping) else value, shape)
    raise UnusableInput(f"{file}: {keys[0]}: missing")


def _scalar(file: Path, info: Mapping[str, Any], keys: Sequence[str]) -> float:
    for key in keys:
        if isinstance(info.get(key), int | float):
            return float(info[key])
    raise UnusableInput(f"{file}: {keys[0]}: missing")
