"""docs/results.md, from all items: make results.

python benchmarks/reproduce.py zhu2012.document [--cached] [NAME ...]

Runs the named items, or all of them, each as far as its last numbers are stale, and writes the document, its pictures
and docs/results.json. Of the others it keeps what is cached, or else what stands in docs/results.json, as long as the
settings are the same. --cached runs nothing.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from typing import Any

from nist1993 import decay, failures, long_run, rate, stages, target

from zhu2012 import (
    figure_7,
    figures_5_6,
    figures_8_9,
    figures_10_11,
    figures_12_13,
    figures_14_15,
    figures_16_15,
    first_guess,
    operator_noise,
    table_1a,
    table_1b,
    table_2a,
    table_2b,
)
from zhu2012.captions import CAPTIONS, HEADINGS, INTRODUCTION
from zhu2012.reproductions import PICTURES, ROOT, Numbers, Reproduction

DOCUMENT, NUMBERS = ROOT / "docs" / "results.md", ROOT / "docs" / "results.json"
KEPT = ("settings", "shown", "processor_seconds", "load", "machine")  # of an item's numbers
DIGITS = 6  # significant ones, of the numbers that are committed

MODULES = (
    table_1a,
    table_1b,
    table_2a,
    table_2b,
    operator_noise,
    first_guess,
    figures_5_6,
    figure_7,
    figures_8_9,
    figures_10_11,
    figures_12_13,
    figures_14_15,
    figures_16_15,
    target,
    stages,
    long_run,
    failures,
    decay,
    rate,
)
REPRODUCTIONS: tuple[Reproduction, ...] = tuple(module.REPRODUCTION for module in MODULES)


def rounded(value: Any) -> Any:
    """``value`` with its numbers to a few digits."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def document(results: Numbers) -> str:
    """The whole document, of the numbers in ``results`` and nothing else."""
    parts = ["# Results", INTRODUCTION]
    found = results["items"]
    for item in REPRODUCTIONS:
        if item.name in HEADINGS:
            parts.append(HEADINGS[item.name])
        parts.append(f"### {item.title}")
        if item.name not in found:
            parts += ["Not run for this version of the document.", f"`{item.command}`"]
            continue
        one = found[item.name]
        parts += [item.text(one["shown"]), CAPTIONS.get(item.name, "")]
        clips = "one clip" if len(item.scenes) == 1 else f"{len(item.scenes)} clips"
        rendering = f", the rendering of {clips} not counted" if item.scenes else ""
        parts.append(f"`{item.command}` — {max(one['processor_seconds'], 1):.0f} processor seconds{rendering}.")
    spent = sum(one["processor_seconds"] for one in found.values())
    busy = max(one["load"] for one in found.values())
    machines = ". ".join(sorted({one["machine"] for one in found.values()}))
    parts.append(
        f"{machines}. All items together: {spent / 60:.0f} processor minutes, the rendering of the clips not counted. "
        f"The system's load was up to {busy:.0f} meanwhile; ms/frame in [Zhu]'s tables is processor time."
    )
    return "\n\n".join(part for part in parts if part) + "\n"


def run(names: Sequence[str], cached: bool, committed: Numbers) -> Numbers:
    """The results of all items that have any, the named ones brought up to date, the others at least as committed."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    found: Numbers = {}
    for item in REPRODUCTIONS:
        start_time = time.perf_counter()
        wanted = not cached and (not names or item.name in names)
        numbers = item.up_to_date() if wanted else item.cached()
        before = committed["items"].get(item.name)
        if numbers is None and before is not None and before["settings"] == rounded(item.settings):
            found[item.name] = before
            continue
        if numbers is None:
            print(f"{item.name}: not run", flush=True)
            for name in item.pictures:
                (PICTURES / name).unlink(missing_ok=True)
            continue
        if item.draw is not None:
            item.draw(numbers, PICTURES)
        found[item.name] = rounded({k: numbers[k] for k in KEPT})
        print(f"{item.name}: {time.perf_counter() - start_time:.0f} s", flush=True)
    return {"items": found}


def main() -> None:
    parser = argparse.ArgumentParser(description="Writes docs/results.md from all items.")
    parser.add_argument("names", nargs="*", choices=[item.name for item in REPRODUCTIONS] + [[]], metavar="NAME")
    parser.add_argument("--cached", action="store_true", help="run nothing")
    args = parser.parse_args()
    start_time = time.perf_counter()
    results = run(args.names, args.cached, json.loads(NUMBERS.read_text(encoding="utf-8")))
    NUMBERS.write_text(json.dumps(results, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    DOCUMENT.write_text(document(json.loads(NUMBERS.read_text(encoding="utf-8"))), encoding="utf-8")
    size = sum(
        (PICTURES / name).stat().st_size
        for item in REPRODUCTIONS
        for name in item.pictures
        if (PICTURES / name).exists()
    )
    print(f"\n{DOCUMENT}: {time.perf_counter() - start_time:.0f} s; pictures {size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
