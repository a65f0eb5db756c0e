"""The GPU under CUDA's simulator, and what is said where there is none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from run_command import assert_one_line_error, paceline
from selection import slow_after

from paceline import numba_cache
from paceline.speed.filter import device
from paceline.speed.filter.device import DeviceFailure, as_device_failure, open_device

PARITY = Path(__file__).with_name("cuda_parity.py")
EXAMPLE = Path(__file__).parents[1] / "examples" / "straight" / "clip.yaml"


@pytest.mark.parametrize("marked", slow_after(1, ["not slow", "slow"]))
def test_the_simulated_gpu_does_what_the_cpu_does(marked: str) -> None:
    """In a process of its own: Numba chooses between the simulator and a GPU when it is imported."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-m", marked, str(PARITY)]
    done = subprocess.run(
        command, env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"}, capture_output=True, text=True, timeout=1500
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]


# --- failures ------------------------------------------------------------------------------------------------------


def foreign(name: str, module: str, base: type[Exception] = Exception) -> type[Exception]:
    """An exception as the packages that drive a GPU define them."""
    return type(name, (base,), {"__module__": module})


DRIVER, ERROR = "numba.cuda.cudadrv.driver", "numba.cuda.cudadrv.error"
FAILURES = [
    (
        foreign("CudaSupportError", ERROR, ImportError)(
            "Error at driver init: \n\nCUDA driver library cannot be found"
        ),
        "no GPU can be used (Error at driver init)",
    ),
    (
        foreign("CudaSupportError", ERROR)("CUDA_ERROR_NO_DEVICE"),
        "no GPU can be used (CUDA_ERROR_NO_DEVICE)",
    ),
    (
        foreign("CudaAPIError", DRIVER)("[35] CUDA_ERROR_INSUFFICIENT_DRIVER"),
        "no GPU can be used ([35] CUDA_ERROR_INSUFFICIENT_DRIVER)",
    ),
    (
        ModuleNotFoundError("No module named 'numba_cuda'"),
        "the software for it is not complete (No module named 'numba_cuda'); install Paceline with its extra cuda",
    ),
    (
        foreign("NvvmSupportError", ERROR, ImportError)("libNVVM cannot be found"),
        "the software for it is not complete (libNVVM cannot be found); install Paceline with its extra cuda",
    ),
    (
        foreign("CudaAPIError", DRIVER)("[2] Call to cuMemAlloc results in CUDA_ERROR_OUT_OF_MEMORY"),
        "the GPU's memory is too small for so many particles",
    ),
    (MemoryError(), "the GPU's memory is too small for so many particles"),
    (
        foreign("CudaAPIError", DRIVER)("[719] CUDA_ERROR_LAUNCH_FAILED\nmore of it"),
        "the GPU failed ([719] CUDA_ERROR_LAUNCH_FAILED)",
    ),
    (foreign("CUDAError", "cuda.core._utils.cuda_utils")(""), "the GPU failed (CUDAError)"),
]


@pytest.mark.parametrize(("error", "reason"), FAILURES, ids=lambda x: x if isinstance(x, str) else type(x).__name__)
def test_device_errors_are_one_plain_line(error: Exception, reason: str) -> None:
    with pytest.raises(DeviceFailure) as failure, as_device_failure():
        raise error
    assert failure.value.reason == reason
    assert str(failure.value) == f"--device cuda: {reason}; --device cpu computes without a GPU"


@pytest.mark.parametrize("error", [ValueError("a mistake of ours"), FloatingPointError("all particle weights vanish")])
def test_other_errors_are_not_the_devices(error: Exception) -> None:
    with pytest.raises(type(error), match=str(error)), as_device_failure():
        raise error


@pytest.fixture
def no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also on a machine that has one."""
    from paceline.speed.filter.cuda import device as cuda_device

    error = foreign("CudaSupportError", ERROR)("CUDA driver library cannot be found")

    def context() -> None:
        raise error

    monkeypatch.setattr(cuda_device.cuda, "current_context", context)


@pytest.mark.usefixtures("no_gpu")
def test_without_a_gpu_auto_is_the_cpu() -> None:
    assert open_device("auto") is None
    assert open_device("cpu") is None
    with pytest.raises(DeviceFailure, match="no GPU can be used"):
        open_device("cuda")


@pytest.mark.usefixtures("no_gpu")
def test_the_command_reports_a_missing_gpu(tmp_path: Path) -> None:
    done = paceline("speed", EXAMPLE, "-o", "out", "--device", "cuda", folder=tmp_path)
    assert_one_line_error(done, "--device cuda: no GPU can be used (CUDA driver library cannot be found); --device cpu")
    assert list(tmp_path.iterdir()) == []


def test_methods_without_a_gpu_implementation_report_it(tmp_path: Path) -> None:
    done = paceline("speed", EXAMPLE, "-o", "out", "--device", "cuda", "--method", "sift", folder=tmp_path)
    assert_one_line_error(done, "--device cuda: --method sift computes on the CPU only; use --device cpu")
    assert list(tmp_path.iterdir()) == []


def test_the_cpu_needs_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "as_device_failure", None)
    assert open_device("cpu") is None


# --- kernels on disk -----------------------------------------------------------------------------------------------


def test_a_kernel_closes_over_the_digest_of_all_that_it_is_made_of() -> None:
    """Numba keeps a kernel under the code of its function and what that closes over: see test_numba_cache.py."""
    from paceline.speed.filter.cuda import kernels, patch_features, weights

    digests = set()
    for module, name in ((kernels, "execute"), (weights, "reduce_moments"), (patch_features, "log_likelihood")):
        (cell,) = getattr(module, name).py_func.__closure__
        assert cell.cell_contents == numba_cache.source_digest(module.__name__)
        digests.add(cell.cell_contents)
    assert len(digests) == 3
