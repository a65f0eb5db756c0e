"""The choice of the device that computes: the CPU, or a GPU while there is one.

Every failure of a GPU becomes a `DeviceFailure`, with a message of one line.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import TYPE_CHECKING

from paceline.errors import UnusableInput
from paceline.speed.choices import DeviceName

if TYPE_CHECKING:
    from paceline.speed.filter.cuda.device import CudaDevice

INSTALL_HINT = "install Paceline with its extra cuda"
GPU_ERROR_MODULES = ("numba.cuda", "cuda.")  # packages whose errors are the GPU's


class DeviceFailure(UnusableInput):
    """A GPU is missing, cannot be used, or has failed."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"--device cuda: {reason}; --device cpu computes without a GPU")
        self.reason = " ".join(reason.split())


def open_device(name: DeviceName) -> CudaDevice | None:
    """The GPU to compute on, None for the CPU: with ``auto`` the GPU where one can be used. Raises DeviceFailure."""
    if name == "cpu":
        return None
    try:
        with as_device_failure():
            from paceline.speed.filter.cuda.device import CudaDevice

            return CudaDevice()
    except DeviceFailure:
        if name == "auto":
            return None
        raise


@contextmanager
def as_device_failure() -> Iterator[None]:
    """Turn what a GPU or its software raises into a DeviceFailure; other errors pass."""
    try:
        yield
    except ImportError as error:
        raise DeviceFailure(_missing(error)) from error
    except MemoryError as error:
        raise DeviceFailure("the GPU's memory is too small for so many particles") from error
    except Exception as error:
        if not (type(error).__module__ + ".").startswith(GPU_ERROR_MODULES):
            raise
        _abandon_device()
        raise DeviceFailure(_reason(error)) from error


def _abandon_device() -> None:
    """Leave the memory of a failed GPU to the end of the process: Numba would try in vain to free it, with a traceback
    each time."""
    from numba import cuda

    with suppress(Exception):
        _cleanup_deferred.enter_context(cuda.defer_cleanup())


_cleanup_deferred = ExitStack()


def _missing(error: ImportError) -> str:
    """The reason for an ImportError; Numba raises one of its own for a missing driver or compiler."""
    if type(error).__name__ == "CudaSupportError":
        return f"no GPU can be used ({_first_line(error)})"
    return f"the software for it is not complete ({_first_line(error)}); {INSTALL_HINT}"


def _reason(error: Exception) -> str:
    text = _first_line(error)
    if "OUT_OF_MEMORY" in text.upper():
        return "the GPU's memory is too small for so many particles"
    if type(error).__name__ == "CudaSupportError" or "NO_DEVICE" in text or "INSUFFICIENT_DRIVER" in text:
        return f"no GPU can be used ({text})"
    return f"the GPU failed ({text})"


def _first_line(error: Exception) -> str:
    """The message of ``error``, shortened to one line."""
    lines = [line.strip(" :") for line in str(error).splitlines() if line.strip(" :")]
    return (lines[0] if lines else type(error).__name__)[:160]
