"""The versions of Paceline and of the third-party packages that its results depend on."""

from __future__ import annotations

__version__ = "0.1.0"

COMPUTING_PACKAGES = "numpy", "scipy", "numba", "opencv-python-headless", "av"  # packages on which results depend


def versions() -> dict[str, str]:
    """Versions of Paceline, Python and the packages that results depend on."""
    import platform
    from importlib import metadata  # slow to load, and `import paceline` is to cost nothing

    return {"paceline": __version__, "python": platform.python_version()} | {
        n: metadata.version(n) for n in COMPUTING_PACKAGES
    }
