"""The choice of Mitsuba's variant: the fast one where LLVM 19 is found, the portable one otherwise."""

from __future__ import annotations

import ctypes
import glob
import os
import sys
from functools import cache
from types import ModuleType

from paceline.errors import UnusableInput
from paceline.verdicts import message

FAST_VARIANT, PORTABLE_VARIANT = "llvm_ad_rgb", "scalar_rgb"
MITSUBA_VARIANTS = (FAST_VARIANT, PORTABLE_VARIANT)
LLVM_VERSION = 19  # older ones abort the process; newer ones were not tried

_LIBRARY_PATTERNS = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    f"/usr/lib/llvm-{LLVM_VERSION}/lib/libLLVM*.so*",
    f"/usr/lib64/llvm{LLVM_VERSION}/lib*/libLLVM*.so*",
    f"/opt/homebrew/opt/llvm@{LLVM_VERSION}/lib/libLLVM*.dylib",
    f"/usr/local/opt/llvm@{LLVM_VERSION}/lib/libLLVM*.dylib",
)


@cache
def find_llvm() -> str | None:
    """The path of a library of LLVM 19: that in ``DRJIT_LIBLLVM_PATH``, or one of the system's; None without any.

    The library itself is asked for its version before the renderer sees it.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    paths = [named] if named else [path for pattern in _LIBRARY_PATTERNS for path in sorted(glob.glob(pattern))]
    candidates = [path for path in paths if named or str(LLVM_VERSION) in os.path.basename(os.path.realpath(path))]
    return next((path for path in candidates if _library_version(path) == LLVM_VERSION), None)


def _library_version(path: str) -> int | None:
    """The major version of the LLVM library at ``path``; None where it has no such function, as before 16."""
    try:
        get_version = ctypes.CDLL(path).LLVMGetVersion
    except (OSError, AttributeError):
        return None
    major = ctypes.c_uint()
    get_version(ctypes.byref(major), None, None)
    return major.value


@cache
def default_variant() -> str:
    """`FAST_VARIANT` where it can run, else `PORTABLE_VARIANT`, with a notice on standard error."""
    if find_llvm():
        return FAST_VARIANT
    print(f"note: {message('renderer_slow', version=LLVM_VERSION)}", file=sys.stderr)
    return PORTABLE_VARIANT


def load_mitsuba(variant: str) -> ModuleType:
    """Mitsuba, set to one of `MITSUBA_VARIANTS`. Raises UnusableInput where it is not installed or cannot run."""
    if variant == FAST_VARIANT:
        library = find_llvm()
        if library is None:
            raise UnusableInput(
                f"rendering with {FAST_VARIANT}: expected a library of LLVM {LLVM_VERSION}; none was found"
            )
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    try:
        import mitsuba as mi
    except ImportError:
        raise UnusableInput(
            "rendering needs Mitsuba, which is not installed; expected Paceline with its extra `simulation`: "
            "pip install paceline[simulation]"
        ) from None
    if mi.variant() != variant:
        mi.set_variant(variant)
    return mi
