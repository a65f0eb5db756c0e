"""``paceline simulate``: rendered clips with exact truth."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from paceline.commands.progress_output import progress_bar
from paceline.errors import UnusableInput

if TYPE_CHECKING:
    from paceline.simulation.raytraced.scene_yaml import FollowScene, SpeedScene

simulate = typer.Typer(help="Rendered clips with exact truth.", rich_markup_mode=None)

Scene = Annotated[
    str, typer.Argument(metavar="SCENE", help="A named scene (see paceline simulate list) or a scene.yaml.")
]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder for the clip; an interrupted rendering is resumed.")]
Samples = Annotated[int | None, typer.Option(min=1, max=4096, help="Rays per pixel.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of everything that the scene does not fix.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]


class Kind(StrEnum):
    speed = "speed"
    follow = "follow"


@simulate.command("speed")
def simulate_speed(scene: Scene, out: Out, samples: Samples = None, seed: Seed = None, quiet: Quiet = False) -> int:
    """Render a stereo clip for paceline speed."""
    from paceline.simulation.raytraced.named_scenes import speed_scene
    from paceline.simulation.raytraced.scene_yaml import load_speed_scene

    model = speed_scene(scene) or load_speed_scene(_file(scene, "speed"))
    return _render(_changed(model, samples, seed), out, quiet)


@simulate.command("follow")
def simulate_follow(scene: Scene, out: Out, samples: Samples = None, seed: Seed = None, quiet: Quiet = False) -> int:
    """Render a chase-camera clip for paceline follow."""
    from paceline.simulation.raytraced.named_scenes import follow_scene
    from paceline.simulation.raytraced.scene_yaml import load_follow_scene

    model = follow_scene(scene) or load_follow_scene(_file(scene, "follow"))
    return _render(_changed(model, samples, seed), out, quiet)


@simulate.command("list")
def simulate_list() -> int:
    """List the named scenes."""
    from paceline.simulation.raytraced.named_scenes import list_scenes

    for kind, name, text in list_scenes():
        print(f"{kind:6}  {name:22}  {text}")
    return 0


@simulate.command("suite")
def simulate_suite(
    out: Out,
    n: Annotated[int, typer.Option("-n", "--count", min=1, max=10000, help="Number of scenes.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the suite.")] = 0,
    kind: Annotated[Kind, typer.Option(help="The command that the clips are made for.")] = Kind.speed,
    samples: Samples = None,
    quiet: Quiet = False,
) -> int:
    """Render random scenes, each into a folder of its own; an interrupted rendering is resumed."""
    from paceline.simulation.random_scenes.raytraced import random_follow_scene, random_speed_scene

    draw = random_speed_scene if kind is Kind.speed else random_follow_scene
    for k in range(n):
        _render(_changed(draw(1000 * seed + k), samples, None), out / f"{kind.value}-{k:03d}", quiet)
    return 0


def _file(scene: str, kind: str) -> Path:
    """The path ``scene`` of a scene file, where no named scene has this name."""
    from paceline.documents.models import suggestion
    from paceline.simulation.raytraced.named_scenes import list_scenes

    path = Path(scene)
    if path.is_dir():
        path = path / "scene.yaml"
    if path.suffix not in (".yaml", ".yml") and not path.exists():
        names = [name for k, name, _ in list_scenes() if k == kind]
        raise UnusableInput(f"{scene}: no {kind} scene has this name; {suggestion(scene, names)}")
    return path


def _changed(scene: SpeedScene | FollowScene, samples: int | None, seed: int | None) -> SpeedScene | FollowScene:
    overrides = {name: value for name, value in (("samples", samples), ("seed", seed)) if value is not None}
    return scene.model_copy(update=overrides)


def _render(scene: SpeedScene | FollowScene, out: Path, quiet: bool) -> int:
    from paceline.simulation.raytraced import chase_clip, stereo_clip

    with progress_bar(f"rendering {out.name}", sys.stderr.isatty() and not quiet) as advance:
        written = (
            stereo_clip.write(scene, out, advance) if scene.kind == "speed" else chase_clip.write(scene, out, advance)
        )
    if not quiet:
        print(written)
    return 0
