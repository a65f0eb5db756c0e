"""Formats a rig as the text of a rig.yaml."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from paceline.arrays import Array
from paceline.cameras import Camera, Quantity, RigUncertainty, StereoRig


def rig_yaml(rig: StereoRig, comments: Sequence[str] = ()) -> str:
    """``rig`` as rig.yaml, with ``comments`` at the top; what is only assumed of it is left out."""
    lines = [f"# {comment}" for comment in comments]
    for side, camera in (("left", rig.left), ("right", rig.right)):
        lines += [f"{side}:", *_camera(camera)]
    lines += ["rotation:", *(f"  - {_row(row, 12)}" for row in rig.R), f"translation: {_row(rig.t, 9)}"]
    if rig.scene_points:
        lines.append(f"scene_points: {rig.scene_points}  # by which the rotation was corrected")
    if rig.uncertainty is None:
        lines.append("uncertainty: exact")
    elif not rig.uncertainty.is_assumed:
        lines += ["uncertainty:", *_uncertainty(rig.uncertainty)]
    return "\n".join(lines) + "\n"


def _camera(camera: Camera) -> list[str]:
    width, height = camera.image_size
    lines = [f"  image_size: [{width}, {height}]", "  K:", *(f"    - {_row(row, 10)}" for row in camera.K)]
    if camera.has_distortion:
        lines.append(f"  distortion: {_row(camera.distortion, 9)}")
    return lines + _readout(camera.readout)


def _readout(readout: Quantity | None) -> list[str]:
    if readout is None or readout.source == "assumed":
        return []
    value, std = _number(readout.value, 9), _number(readout.std, 4)
    if readout.std:
        return [f"  readout: {{value: {value}, std: {std}}}"]
    return [f"  readout: {value}"] if readout.value else ["  shutter: global"]


def _uncertainty(u: RigUncertainty) -> list[str]:
    lines = [
        f"  focal_length_px: {_number(u.focal_length_px, 4)}",
        f"  principal_point_px: {_number(u.principal_point_px, 4)}",
        f"  rotation_rad: {_row(u.rotation_rad, 4)}",
        f"  translation_m: {_row(u.translation_m, 4)}",
    ]
    if u.covariance is not None:
        lines += [
            "  covariance:  # of left fx, fy, cx, cy, right fx, fy, cx, cy, rotation x, y, z, translation x, y, z",
            *(f"    - {_row(row, 10)}" for row in u.covariance),
        ]
    return lines


def _row(values: Iterable[float] | Array, digits: int) -> str:
    return f"[{', '.join(_number(v, digits) for v in values)}]"


def _number(value: float, digits: int) -> str:
    """A number that YAML 1.1 and 1.2 read alike: with a point before any exponent."""
    text = f"{float(value):.{digits}g}"
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}" if e else text
