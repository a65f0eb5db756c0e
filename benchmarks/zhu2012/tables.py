"""Tables of [Zhu] as Markdown, the printed values beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from common import head, row

from zhu2012.repeats import REFINED, REPETITIONS


def markdown(shown: dict[str, Any], setting: str, paper: Sequence[tuple[float | None, ...]], digits: int) -> str:
    """The paper's rows (average speed, maximum error, ms) beside ours."""
    timed = len(paper[0]) > 2
    columns = [setting, "[Zhu]: average", "max error"] + ["ms/frame"] * timed
    columns += ["as printed: average", "max error"] + ["ms/frame"] * timed + ["lost"]
    columns += ["drawn without error: average", "max error"]
    lines = [head(*columns)]
    for numbers, theirs in zip(shown["rows"], paper, strict=True):
        ours, perfect = numbers["printed"], numbers["perfect"]
        cells = [f"{theirs[0]:.2f}", f"{theirs[1]:.{digits}f}"] + [f"{t:.1f}" for t in theirs[2:]]
        cells += [f"{ours['mean']:.2f}", f"{ours['max']:.2f}"] + [f"{ours['ms']:.1f}"] * timed + [f"{ours['lost']:.0f}"]
        cells += [f"{perfect['mean']:.2f}", f"{perfect['max']:.2f}"]
        lines.append(row(numbers["setting"], *cells))
    return "\n".join(lines)


def default_words(shown: dict[str, Any]) -> str:
    """What `paceline speed` makes of the same clip."""
    g, r, p = shown["guided"], shown["refined"], shown["perfect"]
    return (
        f"`paceline speed` on the same clip: its own filter (400 particles, {REPETITIONS} seeds) ends at "
        f"{g['mean']:.2f} mph on average, {g['max']:.2f} mph off at most. **Refined: {r['mean']:.2f} mph, "
        f"{r['max']:.2f} mph off at most** ({REFINED} seeds, {r['measured']} of them measured), stated ± "
        f"{r['half']:.2f} mph; {p['max']:.2f} mph off if outline and road line are drawn without error. True: "
        f"{shown['true']:.2f} mph."
    )
