"""Which Paceline this is, and what it computes with."""

from __future__ import annotations

__version__ = "0.1.0"

COMPUTES = "numpy", "scipy", "numba", "opencv-python-headless", "av"  # the packages that results come from


def versions() -> dict[str, str]:
    """Versions of what computed a result."""
    import platform
    from importlib import metadata  # slow to load, and `import paceline` is to cost nothing

    return {"paceline": __version__, "python": platform.python_version()} | {n: metadata.version(n) for n in COMPUTES}
