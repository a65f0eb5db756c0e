"""``paceline target``: learns the line model of a vehicle to follow from one image."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_DONE

target = typer.Typer(help="Line models of vehicles to follow.", rich_markup_mode=None)


@target.command("learn")
def target_learn(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="An image of the vehicle's rear.")],
    box: Annotated[str, typer.Option(metavar="X0,Y0,X1,Y1", help="Box around the rear, pixels.")],
    width: Annotated[
        str,
        typer.Option(
            metavar="METRES±METRES",
            help="True width of the vehicle inside the box and its uncertainty (95 %), 1.7±0.05 or 1.7+-0.05; ± 3 % is "
            "assumed where it states none.",
        ),
    ],
    camera: Annotated[
        Path, typer.Option(help="The camera.yaml of the picture: its focal length turns pixels into metres.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", help="The target.yaml to write; a picture appears beside it.")],
    name: Annotated[str | None, typer.Option(help="Name of the target; that of the file otherwise.")] = None,
) -> int:
    """Learn a line model from the strong horizontal and vertical edges inside a box."""
    from paceline.documents.loading import load_camera
    from paceline.recordings.image_sources import read_image_file, to_grey
    from paceline.reports.target import start_entry, write_target
    from paceline.targets.learning import learn_target
    from paceline.targets.stated_width import parse_width
    from paceline.units import COVERAGE_95

    if out.suffix and image.resolve() in (out.resolve(), out.with_suffix(".png").resolve()):
        raise UnusableInput(f"--out {out}: would write over the picture {image}; expected another name")
    corners, stated_width, lens = _box(box), parse_width(width), load_camera(camera)
    picture = to_grey(read_image_file(image), 16, str(image))
    try:
        learned = learn_target(picture, corners, stated_width, lens, name or out.stem)
    except UnusableInput as unusable:
        raise UnusableInput(f"{image}: {unusable}") from None
    image_file = write_target(learned, picture, out)
    print(f"{len(learned.target.segments)} lines in {out}; look at them in {image_file}")
    print(learned.quality)
    half_width = COVERAGE_95 * learned.relative_std
    print(
        f"ranges by it are uncertain by ± {half_width:.1%} (95 %), besides what each frame adds; width {learned.width}"
    )
    for notice in learned.notices:
        print(f"note: {notice}. {notice.advice}", file=sys.stderr)
    print(f"follow.yaml, where this picture is the first frame:\n{start_entry(learned)}")
    return EXIT_DONE


def _box(text: str) -> tuple[float, float, float, float]:
    try:
        x0, y0, x1, y1 = map(float, text.split(","))
    except ValueError:
        raise UnusableInput(f"--box {text}: expected four numbers x0,y0,x1,y1 in pixels") from None
    return x0, y0, x1, y1
