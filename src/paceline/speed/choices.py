"""Settings with a few allowed values: these values, which the command line shows without importing the computation."""

from __future__ import annotations

from importlib import import_module
from typing import Literal

Motion = Literal["auto", "free", "line", "curve"]
DeviceName = Literal["auto", "cpu", "cuda"]
OverlayChoice = Literal["auto", "all", "rejected", "none"]

RESAMPLING_MODULE = "paceline.speed.filter.resampling"  # registers the schemes; loaded when their names are needed


def resampling_schemes() -> list[str]:
    """The names of the registered resampling schemes."""
    return list(import_module(RESAMPLING_MODULE).RESAMPLING_SCHEMES)
