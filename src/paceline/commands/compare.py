"""``paceline compare``: results of one clip, by any methods, beside the truth or beside each other."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands import print_columns
from paceline.commands.speed import unit_named
from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE, EXIT_NOTHING_MEASURED

if TYPE_CHECKING:
    from paceline.units import SpeedUnit
    from paceline.verification.comparison import VehicleError
    from paceline.verification.saved_results import SavedResult

ERROR_DECIMALS = 2  # of errors, in the displayed unit


def compare(
    outs: Annotated[list[Path], typer.Argument(metavar="OUT…", help="Output folders of paceline speed, of one clip.")],
    truth: Annotated[
        Path | None,
        typer.Option(help="A truth.json, or another output folder that stands for it; by default the first OUT."),
    ] = None,
    units: Annotated[str, typer.Option(metavar="<mph|km/h|m/s>", help="Displayed unit.", show_default="mph")] = "mph",
) -> int:
    """Compare results of one clip, by any methods: errors of the speeds, coverage of the intervals, frame by frame.

    Vehicles are matched by their ids; those that are rejected do not count. Ends with status 1 where none is in common.
    """
    from paceline.verification.comparison import vehicle_errors
    from paceline.verification.saved_results import read_result
    from paceline.verification.truth import read_truth, speeds_as_truth

    unit = unit_named(units)
    results = [read_result(out) for out in outs]
    if truth is not None:
        true = read_truth(truth)
    elif len(results) > 1:
        true = speeds_as_truth(results.pop(0))
    else:
        raise UnusableInput(f"{outs[0]}: is the only result; expected another one, or --truth to compare it with")
    errors = [vehicle_errors(result, true) for result in results]
    if not any(errors):
        print(f"no vehicle is measured in a result and in {truth or outs[0]} under the same id and in the same frames")
        return EXIT_NOTHING_MEASURED
    print_columns(_vehicle_rows(results, errors, unit, "reference" if truth is None else "true"))
    print()
    print_columns(_result_rows(results, errors, unit))
    if truth is None:
        print(f"\nErrors are differences from {outs[0]}, in place of a truth.")
    return EXIT_DONE


def _vehicle_rows(
    results: list[SavedResult], errors: list[list[VehicleError]], unit: SpeedUnit, true: str
) -> list[list[str]]:
    """A row for each vehicle of each result; ``true`` is what true speeds are called."""
    from paceline.number_format import format_number
    from paceline.reports.common.formatting import format_speed
    from paceline.units import convert
    from paceline.verification.comparison import largest, rms

    rows = []
    for result, of_result in zip(results, errors, strict=True):
        for e in of_result:
            ends = (e.vehicle.speed_mps, e.vehicle.speed_lo_mps, e.vehicle.speed_hi_mps)
            speed, lo, hi = (float("nan") if end is None else end for end in ends)
            text = format_speed(speed, lo, hi, unit)
            numbers = [rms(e.frame_errors), largest(e.frame_errors), rms(e.refined_errors)]
            rows.append(
                [
                    e.vehicle.vehicle,
                    result.name,
                    str(text),
                    format_number(convert(e.true_speed, unit), text.decimals),
                    format_number(convert(e.error, unit), text.decimals),
                    "yes" if e.inside else "no",
                    *(format_number(convert(number, unit), ERROR_DECIMALS) for number in numbers),
                ]
            )
    rows.sort(key=lambda row: row[0])
    head = ["vehicle", "result", f"speed, {unit}", true, "error", "inside", "frames: RMS", "worst", "refined: RMS"]
    return _aligned(head, rows, words=(0, 1, 5))


def _result_rows(results: list[SavedResult], errors: list[list[VehicleError]], unit: SpeedUnit) -> list[list[str]]:
    """A row for each result over all its vehicles."""
    import numpy as np

    from paceline.number_format import format_number
    from paceline.units import convert
    from paceline.verification.comparison import all_errors, all_frame_errors, largest, rms

    rows = []
    for result, of_result in zip(results, errors, strict=True):
        means, frames = all_errors(of_result), all_frame_errors(of_result)
        bias = float(np.mean(means)) if len(means) else float("nan")
        numbers = [rms(means), largest(means), bias, rms(frames), largest(frames)]
        texts = [format_number(convert(number, unit), ERROR_DECIMALS) for number in numbers]
        measured = sum(v.verdict == "measured" for v in result.vehicles)
        rows.append(
            [
                result.name,
                result.method,
                f"{measured} of {len(result.vehicles)}",
                f"{sum(e.inside for e in of_result)} of {len(of_result)}",
                *texts,
            ]
        )
    head = ["result", "method", "measured", "inside", f"RMS, {unit}", "worst", "bias", "frames: RMS", "worst"]
    return _aligned(head, rows, words=(0, 1, 2, 3))


def _aligned(head: list[str], rows: list[list[str]], words: tuple[int, ...]) -> list[list[str]]:
    """A table of ``head`` and ``rows``, the numbers aligned in all columns but those of ``words``."""
    from paceline.number_format import align_decimals

    columns = [list(column) for column in zip(*rows, strict=True)]
    columns = [column if i in words else align_decimals(column) for i, column in enumerate(columns)]
    return [head, *(list(row) for row in zip(*columns, strict=True))]
