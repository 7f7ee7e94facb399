"""The Mitsuba variant and the machine under it: finds libLLVM, picks cuda or llvm, keeps thread pools from fighting.

Import this module before mitsuba, drjit or torch, and call `select_variant` before any of Mitsuba's types is used. It is the only
module that knows where libLLVM lives and which variants exist.

Dr.Jit's llvm backend needs libLLVM 17 or newer; with an older one the whole *process* aborts in its first kernel. So the library is
chosen here, by version, before Dr.Jit loads, and an old one is refused with the command that installs a new one.
"""

import ctypes
import ctypes.util
import importlib
import os
import platform
import re
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

MINIMUM_LLVM = 17
LLVM_VARIANT = "llvm_ad_rgb"
CUDA_VARIANT = "cuda_ad_rgb"
FEWEST_THREADS = 2  # of Dr.Jit's pool: with one, on a machine of one core, Mitsuba waits for ever while it reads an image file

LLVM_INSTALLATION = {
    "apt": "apt-get install -y libllvm19",
    "dnf": "dnf install -y llvm-libs",
    "brew": "brew install llvm",
    "conda": "conda install -c conda-forge 'libllvm19'",
}


class BackendError(RuntimeError):
    """No usable Mitsuba variant on this machine; the message says how to mend it."""


@dataclass(frozen=True)
class LlvmLibrary:
    """A libLLVM shared library and its major version (0 when it could not be told)."""

    path: Path
    major: int


def llvm_search_folders() -> list[Path]:
    """Folders where package managers put libLLVM, in the order in which they are preferred."""
    prefixes = [Path(p) for p in (os.environ.get("CONDA_PREFIX"), sys.prefix) if p]
    folders = [prefix / "lib" for prefix in prefixes]
    folders += sorted(Path("/usr/lib").glob("llvm-*/lib"), reverse=True)
    machine = platform.machine()
    folders += [Path(f"/usr/lib/{machine}-linux-gnu"), Path("/usr/lib64"), Path("/usr/lib"), Path("/usr/local/lib"), Path("/lib64")]
    folders += [Path("/opt/homebrew/opt/llvm/lib"), Path("/usr/local/opt/llvm/lib")]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def llvm_version(path: Path) -> int:
    """Major version of a libLLVM: from its file name, its link's target, or the library's own word (LLVM 16 and newer answer)."""
    for name in (path.name, path.resolve().name):
        match = re.search(r"libLLVM(?:-|\.so\.|\.)(\d+)", name)
        if match:
            return int(match.group(1))
    try:
        library = ctypes.CDLL(str(path), mode=getattr(os, "RTLD_LOCAL", 0))
        numbers = [ctypes.c_uint() for _ in range(3)]
        library.LLVMGetVersion(*(ctypes.byref(number) for number in numbers))
    except (OSError, AttributeError):  # not loadable, or older than LLVMGetVersion
        return 0
    return int(numbers[0].value)


def find_llvm() -> LlvmLibrary | None:
    """The newest libLLVM on this machine, or the one that DRJIT_LIBLLVM_PATH names; None where there is none."""
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    if chosen:
        return LlvmLibrary(Path(chosen), llvm_version(Path(chosen)))
    pattern = "libLLVM*.dylib" if sys.platform == "darwin" else "libLLVM*.so*"
    found = [path for folder in llvm_search_folders() for path in sorted(folder.glob(pattern)) if path.exists()]
    libraries = [LlvmLibrary(path, llvm_version(path)) for path in found]
    return max(libraries, key=lambda library: library.major, default=None)


def llvm_advice() -> str:
    """One line that says how to install a libLLVM that works, for the common package managers."""
    return "Install LLVM: " + "  |  ".join(f"{manager}: {command}" for manager, command in LLVM_INSTALLATION.items())


def prepare_llvm() -> LlvmLibrary:
    """Point Dr.Jit at a libLLVM that works. Must run before drjit is imported.

    Raises:
        BackendError: where libLLVM is missing or older than 17; the message has the installation commands.
    """
    library = find_llvm()
    if library is None:
        raise BackendError(f"prepare_llvm(): expected libLLVM {MINIMUM_LLVM} or newer; found none. {llvm_advice()}")
    if not library.path.exists():
        raise BackendError(
            f"prepare_llvm(): DRJIT_LIBLLVM_PATH names {library.path}, which does not exist. Unset it or name a libLLVM {MINIMUM_LLVM}+."
        )
    if library.major < MINIMUM_LLVM:
        raise BackendError(
            f"prepare_llvm(): expected libLLVM {MINIMUM_LLVM} or newer; the newest found is {library.major} ({library.path}), "
            f"with which Dr.Jit would abort the process. {llvm_advice()}"
        )
    os.environ["DRJIT_LIBLLVM_PATH"] = str(library.path)
    return library


def cuda_driver_found() -> bool:
    """Whether an NVIDIA driver with at least one device answers; asks the driver library, so that torch need not be imported."""
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
        count = ctypes.c_int(0)
        return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0
    except OSError:
        return False


def optix_found() -> bool:
    """Whether the OptiX runtime that comes with the NVIDIA driver is there; Mitsuba's cuda variants trace rays with it."""
    try:
        ctypes.CDLL("nvoptix.dll" if sys.platform == "win32" else "libnvoptix.so.1")
    except OSError:
        return False
    return True


def select_variant(variant: str = "auto") -> str:
    """Set Mitsuba's variant for the calling thread and return its name.

    Args:
        variant: "auto" (cuda_ad_rgb where driver, OptiX and a CUDA build of torch answer, llvm_ad_rgb otherwise), or one of the two.

    Raises:
        BackendError: the variant cannot run here; the message says what is missing and how to get it.
        ValueError: a name that is neither "auto" nor one of the two variants.
    """
    if variant not in ("auto", LLVM_VARIANT, CUDA_VARIANT):
        raise ValueError(
            f"select_variant(): expected 'auto', {LLVM_VARIANT!r} or {CUDA_VARIANT!r}; got {variant!r}. "
            "Only these have derivatives and RGB radiance."
        )
    if variant == "auto":
        variant = CUDA_VARIANT if cuda_driver_found() and optix_found() and torch_has_cuda() else LLVM_VARIANT
    if variant == LLVM_VARIANT:
        prepare_llvm()
    elif not (cuda_driver_found() and optix_found()):
        missing = "an NVIDIA driver" if not cuda_driver_found() else "the OptiX runtime (libnvoptix.so.1)"
        raise BackendError(f"select_variant(): {CUDA_VARIANT} needs {missing}; none answers. Use --variant {LLVM_VARIANT}.")
    mitsuba = importlib.import_module("mitsuba")
    mitsuba.set_variant(variant)
    drjit = importlib.import_module("drjit")
    if drjit.thread_count() < FEWEST_THREADS:
        drjit.set_thread_count(FEWEST_THREADS)
    global _selected
    _selected = variant
    return variant


def torch_has_cuda() -> bool:
    """Whether the installed torch can use a GPU; tensors cross the bridge in place, so both sides must live on the same device."""
    import torch

    return torch.cuda.is_available()


_selected: str | None = None


def loaded_mitsuba() -> ModuleType:
    """The mitsuba module with the selected variant set for the *calling thread*: torch runs backward passes on threads of its own.

    Raises:
        BackendError: no variant was selected in this process yet.
    """
    mitsuba = importlib.import_module("mitsuba")
    if mitsuba.variant() is None:
        if _selected is None:
            raise BackendError("loaded_mitsuba(): no variant is selected yet. Call backend.select_variant() first.")
        mitsuba.set_variant(_selected)
    return mitsuba
