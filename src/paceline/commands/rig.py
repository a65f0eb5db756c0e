"""``paceline rig``: imports calibrations of other programs, and checks whether a calibrated rig has moved."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import file_named, print_columns
from paceline.commands.progress_output import progress_bar
from paceline.commands.renamed_options import accepting
from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED
from paceline.verdicts import Message, message

if TYPE_CHECKING:
    from paceline.calibration.rig_check import RigCheck, RotationCorrection

rig = typer.Typer(help="Rigs: import and check them.", rich_markup_mode=None)

ROTATION_NAMES = ("nod (about x)", "pan (about y)", "roll (about z)")


class Unit(StrEnum):
    """Unit of length of the translation in a calibration file."""

    m = "m"
    cm = "cm"
    mm = "mm"


METRES_PER_UNIT = {Unit.m: 1.0, Unit.cm: 0.01, Unit.mm: 0.001}


@rig.command("import", cls=accepting({"--unit": "--translation-unit"}))
def rig_import(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE…", help="OpenCV YAML or XML, a Kalibr camchain, ROS camera_info left and right, KITTI."
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The rig.yaml to write.")],
    size: Annotated[
        str | None, typer.Option(metavar="WIDTHxHEIGHT", help="Size of the images, if the files do not contain it.")
    ] = None,
    unit: Annotated[
        Unit,
        typer.Option("--translation-unit", help="Unit of the distance between the cameras in the files."),
    ] = Unit.m,
    cameras: Annotated[
        str, typer.Option(metavar="LEFT,RIGHT", help="The pair among the cameras of a Kalibr chain or of KITTI.")
    ] = "0,1",
    rectified: Annotated[
        bool,
        typer.Option("--rectified/--unrectified", help="Whether the pictures are rectified already (ROS and KITTI)."),
    ] = True,
) -> int:
    """Write the rig.yaml of a calibration by another program."""
    from paceline.calibration.importers import ImportOptions, import_rig
    from paceline.documents.rig_yaml import rig_yaml
    from paceline.reports.calibration import check_rig_file_name
    from paceline.reports.common.output_folder import write_all_or_none

    check_rig_file_name(out)
    imported, kind = import_rig(files, ImportOptions(_size(size), METRES_PER_UNIT[unit], _pair(cameras), rectified))
    comments = [
        f"from {kind}: {', '.join(f.name for f in files)}",
        "it states no uncertainty, so that of an ordinary, careful calibration is assumed:",
        "see uncertainty in docs/files.md",
    ]
    write_all_or_none({out: rig_yaml(imported, comments).encode()})
    width, height = imported.left.image_size
    print(
        f"{kind}: {width} × {height} pixels, focal length {imported.left.K[0, 0]:.1f} px, "
        f"cameras {imported.baseline:.4f} m apart; {out}"
    )
    print(f"note: {message('rig_uncertainty_missing', rig=out)}", file=sys.stderr)
    return EXIT_DONE


@rig.command("check", cls=accepting({"--refine": "--correct-rotation"}))
def rig_check(
    clip: Annotated[Path, typer.Argument(metavar="CLIP", help="A clip.yaml, or the folder that contains it.")],
    other: Annotated[
        Path | None, typer.Option("--rig", help="The rig.yaml to check in place of the clip's own.")
    ] = None,
    correct: Annotated[
        bool, typer.Option("--correct-rotation", help="Correct the rotation by the scene, and write the rig to --out.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="The rig.yaml to write with --correct-rotation.")
    ] = None,
) -> int:
    """Check by points of the scene whether the cameras have moved since their calibration.

    Ends with status 1 where they have, where the scene cannot tell, or where what was asked to be corrected cannot be.
    """
    if correct != (out is not None):
        raise UnusableInput("--correct-rotation and --out belong together: the corrected rig needs a file to go to")

    from paceline.calibration.rig_check import check_rig, correct_rotation, correction_refusal, has_enough_matches
    from paceline.calibration.scene_matches import match_scene
    from paceline.documents.loading import load_clip_recording
    from paceline.documents.rig_yaml import rig_yaml
    from paceline.recordings.stereo import open_recording
    from paceline.reports.calibration import check_rig_file_name
    from paceline.reports.common.output_folder import write_all_or_none

    if out is not None:
        check_rig_file_name(out)
    document = load_clip_recording(file_named(clip, "clip.yaml"), other)
    recording = open_recording(document)
    with progress_bar("matching", sys.stderr.isatty()) as advance:
        matches = match_scene(recording, advance)
    if not has_enough_matches(matches):
        print(f"verdict  {message('rig_unchecked', points=len(matches))}")
        return EXIT_NOTHING_MEASURED
    check = check_rig(document.rig, matches)
    corrected = correct_rotation(document.rig, check)
    refusal = correction_refusal(check, corrected)
    _print_check(check, corrected, matches.frames, refusal)
    if refusal and (check.moved or out is not None):
        print(f"note: {refusal}", file=sys.stderr)
    if not check.states_uncertainty:
        print(f"note: {message('rig_uncertainty_missing', rig='the rig')}", file=sys.stderr)
    if out is not None:
        if refusal:
            return EXIT_NOTHING_MEASURED
        comments = [f"rotation refined by {check.matches} points of the scene in {clip.name}"]
        if not check.states_uncertainty:
            comments.append("the uncertainty before that is assumed: that of an ordinary, careful calibration")
        write_all_or_none({out: rig_yaml(corrected.rig, comments).encode()})
        _print_effects(corrected, out)
        return EXIT_DONE
    return EXIT_NOTHING_MEASURED if check.moved or refusal.code == "rotation_unexplained" else EXIT_DONE


def _print_check(check: RigCheck, correction: RotationCorrection, frames: int, refusal: Message) -> None:
    import numpy as np

    from paceline.number_format import align_decimals, format_uncertain
    from paceline.units import COVERAGE_95

    angles, half_widths = np.degrees(correction.rotation), np.degrees(COVERAGE_95 * correction.std)
    columns = [
        ("rotation since calibration", *ROTATION_NAMES),
        ("degrees, 95 %", *align_decimals([format_uncertain(*pair) for pair in zip(angles, half_widths, strict=True)])),
        (
            "determined by",
            *(
                "the scene" if share > 0.5 else "the calibration: the scene does not determine it"
                for share in correction.scene_share
            ),
        ),
    ]
    print_columns(list(zip(*columns, strict=True)))
    print(
        f"\n{check.matches} points in {frames} frames, off their epipolar lines (rms) by {correction.explained_px:.2f} "
        f"px that this rotation explains, {correction.unexplained_px:.2f} px that it does not, and "
        f"{check.residual_px:.2f} px of noise"
    )
    print(f"verdict  {verdict(check, refusal)}")


def verdict(check: RigCheck, refusal: Message) -> str:
    """One line on whether the rig has moved since its calibration; ``refusal`` is why it cannot be corrected."""
    from paceline.calibration.rig_check import SIGNIFICANCE_LEVEL

    if not check.moved and refusal.code == "rotation_unexplained":
        return refusal
    if not check.moved:
        return f"the rig has not moved; the scene agrees with it (chance of so large a difference: {check.p_value:.2g})"
    return message(
        "rig_moved" if check.states_uncertainty else "rig_differs_from_file",
        offset_px=check.rotation_error_px,
        chance=check.p_value,
        min_chance=SIGNIFICANCE_LEVEL,
        alternative="" if refusal else ", or --correct-rotation -o rig.yaml",
    )


def _print_effects(correction: RotationCorrection, out: Path) -> None:
    from paceline.number_format import format_half_width
    from paceline.units import COVERAGE_95

    effects = "   ".join(
        f"{e.distance:.0f} m ± {format_half_width(100 * COVERAGE_95 * e.along)} %" for e in correction.effects
    )
    print(f"speeds   {effects}   (95 %, from the calibration alone)")
    print(f"No scene determines the distance between the cameras: {out} keeps the calibration's.")


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    width, cross, height = text.partition("x")
    if not (cross and width.isdecimal() and height.isdecimal() and 16 <= min(int(width), int(height)) <= 65536):
        raise UnusableInput(f"--size {text}: expected WIDTHxHEIGHT in pixels, for instance 1280x960")
    return int(width), int(height)


def _pair(text: str) -> tuple[int, int]:
    left, comma, right = text.partition(",")
    if not (comma and left.isdecimal() and right.isdecimal() and left != right):
        raise UnusableInput(f"--cameras {text}: expected two numbers, the left camera's first, for instance 0,1")
    return int(left), int(right)
