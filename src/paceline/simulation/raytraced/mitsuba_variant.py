"""Which of Mitsuba's variants renders: the fast one where LLVM 19 is found, the portable one otherwise."""

from __future__ import annotations

import ctypes
import glob
import os
import sys
from functools import cache
from types import ModuleType

from paceline.errors import UnusableInput

FAST, PORTABLE = "llvm_ad_rgb", "scalar_rgb"
VARIANTS = (FAST, PORTABLE)
LLVM = 19  # older ones abort the process; newer ones were not tried

_PLACES = (
    "/usr/lib/*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    f"/usr/lib/llvm-{LLVM}/lib/libLLVM*.so*",
    f"/usr/lib64/llvm{LLVM}/lib*/libLLVM*.so*",
    f"/opt/homebrew/opt/llvm@{LLVM}/lib/libLLVM*.dylib",
    f"/usr/local/opt/llvm@{LLVM}/lib/libLLVM*.dylib",
)


@cache
def find_llvm() -> str | None:
    """The path of a library of LLVM 19: that in ``DRJIT_LIBLLVM_PATH``, or one of the system's; None without any.

    The library itself is asked for its version before the renderer sees it.
    """
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    found = [named] if named else [path for pattern in _PLACES for path in sorted(glob.glob(pattern))]
    likely = [path for path in found if named or str(LLVM) in os.path.basename(os.path.realpath(path))]
    return next((path for path in likely if _version(path) == LLVM), None)


def _version(path: str) -> int | None:
    """The major version of the LLVM library at ``path``; None where it does not tell, as before 16."""
    try:
        ask = ctypes.CDLL(path).LLVMGetVersion
    except (OSError, AttributeError):
        return None
    major = ctypes.c_uint()
    ask(ctypes.byref(major), None, None)
    return major.value


@cache
def default_variant() -> str:
    """`FAST` where it can run, else `PORTABLE`, with a notice on standard error."""
    if find_llvm():
        return FAST
    print(
        f"note: LLVM {LLVM} was not found (Debian: libllvm{LLVM}; elsewhere set DRJIT_LIBLLVM_PATH): "
        "rendering takes about five times as long",
        file=sys.stderr,
    )
    return PORTABLE


def mitsuba(variant: str) -> ModuleType:
    """Mitsuba, set to one of `VARIANTS`. Raises UnusableInput where it is not installed or cannot run."""
    if variant == FAST:
        library = find_llvm()
        if library is None:
            raise UnusableInput(f"rendering with {FAST}: expected a library of LLVM {LLVM}; none was found")
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
