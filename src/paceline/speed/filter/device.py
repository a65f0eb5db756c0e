"""The choice of the device that computes: the CPU, or a GPU where one can be used.

Every failure of a GPU is raised as a `DeviceFailure`, whose message has one line.
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
GPU_ERROR_MODULES = ("numba.cuda", "cuda.")  # packages that raise an error when the GPU or its driver fails

_deferred_cleanup = ExitStack()  # holds Numba's cleanup off until the process ends, once a GPU has failed


class DeviceFailure(UnusableInput):
    """A GPU is missing, cannot be used, or has failed."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"--device cuda: {reason}; --device cpu computes without a GPU")
        self.reason = " ".join(reason.split())


def open_device(name: DeviceName) -> CudaDevice | None:
    """The GPU to compute on, or None for the CPU.

    ``auto`` selects the GPU where one can be used, and the CPU otherwise. ``cuda`` raises DeviceFailure where none can
    be used.
    """
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
    """Raise a DeviceFailure in place of any error of a GPU or of its software; other errors are raised unchanged."""
    try:
        yield
    except ImportError as error:
        raise DeviceFailure(_import_failure_reason(error)) from error
    except MemoryError as error:
        raise DeviceFailure("the GPU's memory is too small for so many particles") from error
    except Exception as error:
        if not (type(error).__module__ + ".").startswith(GPU_ERROR_MODULES):
            raise
        _abandon_device()
        raise DeviceFailure(_gpu_failure_reason(error)) from error


def _abandon_device() -> None:
    """Do not free the memory of a failed GPU before the process ends: Numba's attempts would fail, and print a
    traceback each."""
    from numba import cuda

    with suppress(Exception):
        _deferred_cleanup.enter_context(cuda.defer_cleanup())


def _import_failure_reason(error: ImportError) -> str:
    """The reason for an ImportError; for a missing driver or compiler Numba raises a subclass of it."""
    if type(error).__name__ == "CudaSupportError":
        return f"no GPU can be used ({_first_line(error)})"
    return f"the software for it is not complete ({_first_line(error)}); {INSTALL_HINT}"


def _gpu_failure_reason(error: Exception) -> str:
    """The reason for an error that a package of ``GPU_ERROR_MODULES`` raised."""
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
