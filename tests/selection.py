"""Parameters of which some are tried in every run and the others before a release."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def slow_after(count: int, values: Iterable[Any]) -> list[Any]:
    """``values`` for `pytest.mark.parametrize`, those after the first ``count`` marked slow."""
    given = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*value, marks=[pytest.mark.slow] * (k >= count)) for k, value in enumerate(given)]
