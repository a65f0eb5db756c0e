"""Documents that are damaged or hostile: YAML files, and the times of frames."""

from __future__ import annotations

import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .cases import Fault, Visibility
from .recordings import Recording

DOCUMENTED = ("speed", "follow", "lanes", "vehicles", "live", "calibrate")
BOARDLESS = DOCUMENTED[:-1]
HOSTILE: tuple[Any, ...] = (
    None, "", "fast", True, [], {}, -1, 0, 0.0, -0.0, 1, 2, 1e-308, 1e308, -1e308, 1e19, 10**30, 2**31, 2**63, -(2**63),
    float("nan"), float("inf"), "1_0", "0x10", "1:30", "010", "٣", "=", "<<", "../../../../etc/passwd", "/dev/null",
    "/dev/zero", "/proc/self/mem", ".", "..", "/", "a\0b", "\ud7ff", "x" * 5000, "a/" * 3000, "tcp://127.0.0.1:9",
    "rtsp://127.0.0.1:9/x", "file:///etc/passwd", "%04d.png", "*", "[", "**/*", [[[[[]]]]], [0] * 1000, ["a", None],
    {"a": {"b": {}}}, [[1, 2], [3]], [[1e308, 1e308]] * 4, [[0, 0]] * 4, [[float("nan")] * 2] * 4, "2026-11-28", "~",
    {"value": 1.0}, {"value": "x", "std": -1}, {"video": "left", "half": "left"}, {"bag": "x", "topic": "y"},
)  # fmt: skip
TEXTS: tuple[str, ...] = (
    "[" * 20000,
    "{a: " * 5000,
    "- " * 3000,
    "&a [*a, *a]",
    "a: &a [1,1,1,1,1,1,1,1,1]\n" + "".join(f"{y}: &{y} [{f'*{x},' * 9}]\n" for x, y in pairwise("abcdefgh")),
    "!!python/object/apply:os.system ['true']",
    "--- 1\n--- 2\n",
    "\t",
    "",
    "null",
    "- 1\n- 2\n",
    "%YAML 9.9\n---\n{}\n",
    "? [a]\n: b\n",
    "? {a: b}\n: c\n",
    "left: left\nleft: right\n",
    "2026-99-99",
    "a: 2026-99-99",
    "x" * 300000,
    "#" * 300000,
    "\ufeffleft: left\n",
    "<<: {left: left}\n",
    "<<: [1, 2]\n",
    "a: !!binary x\n",
    "a: !!set {b, c}\n",
    "a: !!float x\n",
    "a: !!int ''\n",
    "a: !!timestamp x\n",
    "a: " + "9" * 5000 + "\n",
    "a: 1e999999\n",
)  # fmt: skip

FAULTS: list[Fault] = []


Change = Callable[[Path, np.random.Generator], None]


def document_fault(
    name: str, visibility: Visibility = Visibility.NOT_VISIBLE, areas: tuple[str, ...] = BOARDLESS
) -> Callable[[Change], Change]:
    """Adds what a function does to one document of a folder to the faults."""

    def add(change: Change) -> Change:
        def apply(r: Recording, rng: np.random.Generator) -> None:
            own = np.random.default_rng(int(rng.integers(2**32)))

            def damage(folder: Path) -> None:
                files = sorted(p for p in folder.iterdir() if p.suffix in (".yaml", ".csv") and p.is_file())
                if files:
                    change(files[int(own.integers(len(files)))], own)

            r.files.append(damage)

        FAULTS.append(Fault(name, visibility, areas, apply))
        return change

    return add


def places(value: Any, before: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where the values within ``value`` are, by the keys that lead to them."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, inner in pairs for place in ((*before, key), *places(inner, (*before, key)))]


def _change(file: Path, rng: np.random.Generator, change: Callable[[Any, Any], None]) -> None:
    """Changes what holds one value within a document, shallow ones more often than those within long lists."""
    try:
        document = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (ValueError, yaml.YAMLError, RecursionError):  # another fault was here before
        return
    found = places(document)
    if not found:
        return
    weights = np.array([4.0 ** -len(place) for place in found])
    *parents, last = found[int(rng.choice(len(found), p=weights / weights.sum()))]
    holder = document
    for key in parents:
        holder = holder[key]
    change(holder, last)
    file.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8", errors="surrogatepass")


@document_fault("a key deleted")
def deleted(file: Path, rng: np.random.Generator) -> None:
    def change(holder: Any, key: Any) -> None:
        del holder[key]

    _change(file, rng, change)


@document_fault("a value replaced")
def replaced(file: Path, rng: np.random.Generator) -> None:
    def change(holder: Any, key: Any) -> None:
        holder[key] = HOSTILE[int(rng.integers(len(HOSTILE)))]

    _change(file, rng, change)


@document_fault("a number scaled")
def scaled(file: Path, rng: np.random.Generator) -> None:
    def change(holder: Any, key: Any) -> None:
        if isinstance(holder[key], int | float):
            holder[key] *= float(rng.choice([-1, 0, 1e-9, 1e-3, 0.1, 10, 1e3, 1e6, 1e9, 1e300]))

    _change(file, rng, change)


@document_fault("an unknown key")
def unknown(file: Path, rng: np.random.Generator) -> None:
    def change(holder: Any, key: Any) -> None:
        if isinstance(holder, dict):
            holder[f"{key}_"] = holder[key]

    _change(file, rng, change)


@document_fault("bytes of a document changed")
def bytes_flipped(file: Path, rng: np.random.Generator) -> None:
    content = bytearray(file.read_bytes())
    for _ in range(int(rng.integers(1, 6))):
        if content:
            content[int(rng.integers(len(content)))] = int(rng.integers(256))
    file.write_bytes(bytes(content))


@document_fault("a document cut short")
def cut(file: Path, rng: np.random.Generator) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: int(rng.integers(len(content) + 1))])


@document_fault("a hostile document")
def hostile(file: Path, rng: np.random.Generator) -> None:
    text = TEXTS[int(rng.integers(len(TEXTS)))]
    file.write_text(text if rng.random() < 0.5 else file.read_text(errors="replace") + "\n" + text, errors="replace")


@document_fault("another encoding")
def encoded(file: Path, rng: np.random.Generator) -> None:
    text = file.read_text(errors="replace") + "\n# Höhe ± 1\n"
    file.write_bytes(text.encode(str(rng.choice(["utf-16", "utf-8-sig", "latin-1", "utf-32"]))))


@document_fault("no file")
def no_file(file: Path, rng: np.random.Generator) -> None:
    """A folder, nothing, a link to nothing or to itself, or a pipe that nobody writes to."""
    file.unlink()
    kind = int(rng.integers(5))
    if kind == 0:
        file.mkdir()
    elif kind == 1:
        file.symlink_to(file.name)
    elif kind == 2:
        file.symlink_to("nothing")
    elif kind == 3:
        os.mkfifo(file)


@document_fault("numbers as YAML 1.1 reads them", Visibility.VISIBLE)
def yaml_1_1(file: Path, rng: np.random.Generator) -> None:
    """Whole numbers with leading zeros, with underscores and in sixties: as YAML 1.2 reads them, or refused."""
    form = int(rng.integers(3))
    lines = file.read_text(errors="replace").splitlines()
    for k, line in enumerate(lines):
        key, colon, value = line.partition(": ")
        if colon and value.isdecimal() and rng.random() < 0.7:
            if form == 0:
                value = "0" * int(rng.integers(1, 3)) + value
            elif len(value) > 1:
                value = value[0] + "_:"[form - 1] + value[1:]
            lines[k] = key + colon + value
    file.write_text("\n".join(lines) + "\n")


@document_fault("a picture that is no file", Visibility.VISIBLE, DOCUMENTED)
def no_picture(file: Path, rng: np.random.Generator) -> None:
    pictures = sorted(p for p in file.parent.rglob("*") if p.suffix in (".png", ".jpg", ".mp4", ".mkv"))
    if pictures:
        picture = pictures[int(rng.integers(len(pictures)))]
        picture.unlink()
        kind = int(rng.integers(4))
        if kind == 0:
            picture.mkdir()
        elif kind == 1:
            os.mkfifo(picture)
        elif kind == 2:
            picture.symlink_to("/dev/zero" if rng.random() < 0.5 else picture.name)
        else:
            picture.write_bytes(rng.bytes(int(rng.integers(2000))))
