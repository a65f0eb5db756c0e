"""Tables of [Zhu]: the filter repeated with other random numbers on one clip, beside the printed values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from common import MPH, measured

from paceline.speed.configuration import SpeedConfiguration
from zhu2012.clips import Loaded, as_printed, filtered, last_speed, loaded

REPETITIONS = 20  # of the filter, as in the paper
REFINED = 5  # of the refinement, which hardly depends on the seed

Outcome = dict[str, float]


def repeated(view: Loaded, configuration: SpeedConfiguration) -> Outcome:
    """Mean of the last speeds and their largest error over the repetitions, mph; ms per frame; tracks lost."""
    speeds, kept, milliseconds = [], [], []
    for seed in range(REPETITIONS):
        estimates, spent = filtered(view, configuration.model_copy(update={"seed": seed}))
        speed, held = last_speed(estimates)
        speeds.append(speed)
        kept.append(held)
        milliseconds += spent[2:]  # in the first two frames the filter begins
    true = _true(view)
    return {
        "mean": float(np.mean(speeds)),
        "max": float(np.abs(np.array(speeds) - true).max()),
        "ms": float(np.median(milliseconds)),
        "lost": sum(not k for k in kept),
    }


def _true(view: Loaded) -> float:
    return float(view.true(view.clip.vehicles[0].id, [view.frames[-1].index])[0]) / MPH


def table(scene: str, guess: float, name: str, varied: Sequence[dict[str, Any]], **fixed: Any) -> dict[str, Any]:
    """The shown numbers of a table in which the settings ``varied`` take turns; the first guess of the speed is
    ``guess`` times the true one."""
    view = loaded(scene).with_guess(guess)
    perfect = view.without_noise()
    rows = []
    for settings in varied:
        configuration = as_printed(**fixed | settings)
        rows.append(
            {
                "setting": settings[name],
                "printed": repeated(view, configuration),
                "perfect": repeated(perfect, configuration),
            }
        )
    return {"true": _true(view), "guess": guess, "rows": rows}


def defaults(scene: str, guess: float) -> dict[str, Any]:
    """What `paceline speed` makes of the clip, as it was drawn and as if it had been drawn without error."""
    view = loaded(scene).with_guess(guess)
    return {
        "guided": guided(view),
        "refined": refined(view, REFINED),
        "perfect": refined(view.without_noise(), 1),
    }


def guided(view: Loaded) -> Outcome:
    """The filter that `paceline speed` runs, started alike."""
    return repeated(view, SpeedConfiguration(refine=False))


def refined(view: Loaded, repetitions: int) -> Outcome:
    """What `paceline speed` reports, on the clip as the operator drew it."""
    found = [measured(view.clip, seed=seed)[0] for seed in range(repetitions)]
    speeds = np.array([m.speed for m in found]) / MPH
    half = np.array([m.speed_hi - m.speed_lo for m in found]) / 2 / MPH
    true = _true(view)
    return {
        "mean": float(speeds.mean()),
        "max": float(np.abs(speeds - true).max()),
        "half": float(half.mean()),
        "measured": sum(m.verdict == "measured" for m in found),
    }
