"""Settings that are one of a few: their values, which the command line shows without loading what computes."""

from __future__ import annotations

from typing import Literal

Motion = Literal["auto", "free", "line", "curve"]
Resampling = Literal["systematic", "stratified", "residual", "multinomial"]
DeviceName = Literal["auto", "cpu", "cuda"]
