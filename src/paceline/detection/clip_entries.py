"""Outlines of detected vehicles as entries of a clip.yaml."""

from __future__ import annotations

from paceline.cameras import StereoRig
from paceline.detection.finder import DetectedVehicle
from paceline.documents.yaml_editing import format_pixels, format_text, insert_below, parse_edited
from paceline.documents.yaml_loading import load_yaml
from paceline.errors import UnusableInput


def with_vehicles(text: str, file: str, rig: StereoRig, detected: list[DetectedVehicle]) -> str:
    """``text`` of a clip.yaml that outlines no vehicle, with the vehicles ``detected`` added and the rest unchanged.

    Raises UnusableInput where it outlines vehicles already, or is written in a way that cannot be added to.
    """
    before = load_yaml(text)
    if before.get("vehicles"):
        raise UnusableInput(f"{file}: vehicles: some are outlined already; expected none, to be found without a person")
    added = insert_below(text, "vehicles", lambda indent: _entries(rig, detected, indent))
    new = load_yaml("\n".join(_entries(rig, detected, 0))) or None
    after = parse_edited(added)
    if after | {"vehicles": after.get("vehicles")} != before | {"vehicles": new}:
        raise UnusableInput(f"{file}: vehicles: is written in a way that cannot be added to; expected no such key")
    return added


def _entries(rig: StereoRig, detected: list[DetectedVehicle], indent: int) -> list[str]:
    pad, lines = " " * indent, []
    for f in detected:
        v = f.recorded or f.vehicle
        if v is None:
            continue
        lines += [
            f"{pad}- id: {v.id}  # found by paceline vehicles, seen from {f.times[0]:.2f} to {f.times[1]:.2f} s",
            f"{pad}  path: {format_text(f.path)}",
            f"{pad}  frame: {v.frame}",
            f"{pad}  left: {format_pixels(rig.left.distort_points(v.left))}",
            f"{pad}  right: {format_pixels(rig.right.distort_points(v.right))}",
        ]
        if v.speed is not None:
            lines.append(f"{pad}  speed: {v.speed}  # a first guess, m/s")
    return lines
