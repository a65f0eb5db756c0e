"""A table of [Zhu]: one setting of the filter takes turns on one clip, beside the printed values."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from zhu2012 import clips, repeats, tables
from zhu2012.reproductions import Numbers, Reproduction


@dataclass(frozen=True)
class Sweep:
    """``table`` as the paper numbers it, for instance 1a; ``fixed`` are the other settings, ``guess`` the first guess
    of the speed over the true one, ``paper`` the printed rows with their errors to so many ``digits``. With
    ``defaults`` what `paceline speed` makes of the clip stands below.
    """

    table: str
    title: str
    scene: str
    setting: str
    values: tuple[float, ...]
    label: str  # of the first column
    paper: tuple[tuple[float, ...], ...]
    digits: int
    guess: float
    fixed: dict[str, Any]
    defaults: bool = False

    def compute(self) -> Numbers:
        varied = [{self.setting: value} for value in self.values]
        shown = repeats.table(self.scene, self.guess, self.setting, varied, **self.fixed)
        if self.defaults:
            shown |= repeats.defaults(self.scene, self.guess)
        return {"shown": shown, "drawn": {}}

    def text(self, shown: Numbers) -> str:
        parts = [tables.markdown(shown, self.label, self.paper, self.digits)]
        if self.defaults:
            parts.append(tables.default_words(shown))
        return "\n\n".join(parts)

    def item(self) -> Reproduction:
        return Reproduction(
            name=f"table-{self.table}",
            script=f"zhu2012.table_{self.table}",
            title=self.title,
            compute=self.compute,
            text=self.text,
            settings=self.fixed | {"scene": self.scene, self.setting: list(self.values), "guess": self.guess},
            scenes=(self.scene,),
            helpers=(clips, repeats),
        )
