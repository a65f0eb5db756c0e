"""A reproduction of a table or figure in docs/results.md: its computation, the cache of its numbers, and its clips.

Numbers are cached as JSON under build/results, clips under build/results/clips. A cached number is used again as long
as all that went into it is the same: settings, code, clips.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml
from common import machine

ROOT = Path(__file__).parents[2]
BUILD = ROOT / "build" / "results"
PICTURES = ROOT / "docs" / "images" / "results"
PICTURES_FROM_DOCUMENT = "images/results"

Numbers = dict[str, Any]


@dataclass(frozen=True)
class Reproduction:
    """One table or figure of the document.

    ``compute`` makes the numbers: ``shown``, of which the text is made and which are committed, and ``drawn``, which
    only the pictures need. ``text`` writes Markdown from the shown ones alone; ``draw`` puts ``pictures`` into a
    folder. ``scenes`` are the rendered clips that it uses, ``rooms`` the parts of the package and ``helpers``
    the modules whose change makes the numbers stale.
    """

    name: str
    script: str
    title: str
    compute: Callable[[], Numbers]
    text: Callable[[Numbers], str]
    draw: Callable[[Numbers, Path], None] | None = None
    pictures: tuple[str, ...] = ()
    settings: Numbers = field(default_factory=dict)
    scenes: tuple[str, ...] = ()
    rooms: tuple[str, ...] = ("speed",)
    helpers: tuple[ModuleType, ...] = ()

    @property
    def command(self) -> str:
        return f".venv/bin/python benchmarks/reproduce.py {self.script}"

    @property
    def cache(self) -> Path:
        return BUILD / f"{self.name}.json"

    def key(self) -> str:
        """A digest of all that goes into the numbers."""
        digest = hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode())
        digest.update(self._computing().encode())
        for helper in self.helpers:
            digest.update(inspect.getsource(helper).encode())
        for room in self.rooms:
            for file in sorted((ROOT / "src" / "paceline" / room).rglob("*.py")):
                digest.update(file.read_bytes())
        for scene in self.scenes:
            for name in ("clip.yaml", "follow.yaml", "truth.json"):
                file = clip_folder(scene) / name
                digest.update(file.read_bytes() if file.exists() else b"")
        return digest.hexdigest()

    def _computing(self) -> str:
        """The module of ``compute`` without what only shows the numbers."""
        module = inspect.getmodule(self.compute)
        source = inspect.getsource(module or self.compute)
        for shows in (self.text, self.draw):
            if inspect.isroutine(shows):
                source = source.replace(inspect.getsource(shows), "")
        return source

    def cached(self) -> Numbers | None:
        """The numbers of the last run with these settings, however old; None where there are none."""
        old = json.loads(self.cache.read_text()) if self.cache.exists() else None
        return old if old is not None and old["settings"] == json.loads(json.dumps(self.settings)) else None

    def up_to_date(self) -> Numbers:
        """The numbers, computed where the last ones are missing or stale."""
        for scene in self.scenes:
            clip_folder(scene)
        key, old = self.key(), self.cached()
        if old is not None and old["key"] == key:
            return old
        load, start_time, used = os.getloadavg()[0], time.perf_counter(), time.process_time()
        numbers = self.compute()
        about = {
            "key": key,
            "settings": self.settings,
            "seconds": round(time.perf_counter() - start_time, 1),
            "processor_seconds": round(time.process_time() - used, 1),
            "load": round(max(load, os.getloadavg()[0]), 1),
            "machine": machine(),
        }
        self.cache.parent.mkdir(parents=True, exist_ok=True)
        partial = self.cache.with_suffix(".part")
        partial.write_text(json.dumps(about | numbers, default=lambda number: number.item()))  # of NumPy
        partial.replace(self.cache)
        return json.loads(self.cache.read_text())


def run_alone(item: Reproduction) -> None:
    """What a script does when it is run: compute, print, draw."""
    parser = argparse.ArgumentParser(description=item.title)
    parser.add_argument("--pictures", type=Path, default=PICTURES, help="folder for the pictures")
    args = parser.parse_args()
    numbers = item.up_to_date()
    print(item.text(numbers["shown"]))
    if item.draw is not None:
        args.pictures.mkdir(parents=True, exist_ok=True)
        item.draw(numbers, args.pictures)
    print(f"\n{numbers['processor_seconds']:.0f} processor seconds, system load {numbers['load']:.1f}.")


def clip_folder(name: str) -> Path:
    """The rendered clip of a named scene; rendered first where it is missing or the scene has changed since."""
    from paceline.simulation.raytraced import chase_clip, stereo_clip
    from paceline.simulation.raytraced.named_scenes import follow_scene, speed_scene

    scene, folder = speed_scene(name) or follow_scene(name), BUILD / "clips" / name
    assert scene is not None, name
    if (folder / "truth.json").exists():
        if yaml.safe_load((folder / "scene.yaml").read_text()) == scene.model_dump(mode="json"):
            return folder
        shutil.rmtree(folder)
    print(f"rendering {name}", flush=True)
    write = stereo_clip.write if scene.kind == "speed" else chase_clip.write
    write(scene, folder)  # type: ignore[arg-type]
    return folder


def image(name: str, description: str) -> str:
    """A picture of the document."""
    return f"![{description}]({PICTURES_FROM_DOCUMENT}/{name})"
