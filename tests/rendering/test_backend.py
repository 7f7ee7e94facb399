"""Finding libLLVM by version, refusing an old one, and the variant of each thread."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from mitsuba_avatar.rendering import backend

NAMES = {
    "libLLVM.so.19.1": 19,
    "libLLVM-17.so": 17,
    "libLLVM-15.so.1": 15,
    "libLLVM.18.dylib": 18,
    "libLLVM.so.20.1-rc2": 20,
}


@pytest.fixture
def installed(monkeypatch, tmp_path):
    """A machine whose only libraries lie in the returned folder; the environment is put back afterwards."""
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(backend, "llvm_search_folders", lambda: [tmp_path])
    return tmp_path


@pytest.mark.parametrize(("name", "major"), NAMES.items())
def test_version_is_read_from_the_name(tmp_path, name, major):
    (tmp_path / name).touch()
    assert backend.llvm_version(tmp_path / name) == major


def test_version_is_read_from_where_a_link_points(tmp_path):
    (tmp_path / "libLLVM.so.19.1").touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM.so.19.1")
    assert backend.llvm_version(tmp_path / "libLLVM.so") == 19


def test_a_library_that_tells_nothing_has_version_zero(tmp_path):
    (tmp_path / "libLLVM.so").write_bytes(b"not a library")
    assert backend.llvm_version(tmp_path / "libLLVM.so") == 0


@pytest.mark.skipif(sys.platform != "linux", reason="shared libraries are named otherwise there")
def test_the_newest_library_is_taken(installed):
    for name in ("libLLVM-15.so.1", "libLLVM.so.19.1", "libLLVM-17.so"):
        (installed / name).touch()
    assert backend.find_llvm() == backend.LlvmLibrary(installed / "libLLVM.so.19.1", 19)
    assert backend.prepare_llvm().major == 19


def test_an_old_library_is_refused_with_the_way_out(installed):
    (installed / ("libLLVM-15.dylib" if sys.platform == "darwin" else "libLLVM-15.so.1")).touch()
    with pytest.raises(backend.BackendError) as caught:
        backend.prepare_llvm()
    message = str(caught.value)
    assert "expected libLLVM 17 or newer; the newest found is 15" in message
    assert all(command in message for command in backend.LLVM_INSTALLATION.values())


def test_no_library_is_refused_with_the_way_out(installed):
    assert backend.find_llvm() is None
    with pytest.raises(backend.BackendError, match="found none. Install LLVM: apt: apt-get install"):
        backend.prepare_llvm()


def test_the_environment_names_the_library(installed, monkeypatch):
    (installed / "libLLVM.so.19.1").touch()
    chosen = installed / "libLLVM-18.so"
    chosen.touch()
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(chosen))
    assert backend.prepare_llvm() == backend.LlvmLibrary(chosen, 18)


def test_an_environment_that_names_an_old_or_missing_library_is_refused(installed, monkeypatch):
    old = installed / "libLLVM-14.so"
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(old))
    with pytest.raises(backend.BackendError, match="which does not exist. Unset it"):
        backend.prepare_llvm()
    old.touch()
    with pytest.raises(backend.BackendError, match="the newest found is 14"):
        backend.prepare_llvm()


def test_an_old_library_ends_in_a_message_not_in_an_abort(tmp_path):
    """In a process of its own: with such a library Dr.Jit would take the whole process down."""
    old = tmp_path / "libLLVM-15.so.1"
    old.touch()
    code = f"import os; os.environ['DRJIT_LIBLLVM_PATH'] = {str(old)!r}\n"
    code += "from mitsuba_avatar.rendering.backend import select_variant; select_variant('llvm_ad_rgb')"
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "expected libLLVM 17 or newer; the newest found is 15" in done.stderr


def test_unknown_variants_are_refused():
    with pytest.raises(ValueError, match="expected 'auto', 'llvm_ad_rgb' or 'cuda_ad_rgb'; got 'scalar_rgb'"):
        backend.select_variant("scalar_rgb")


def test_cuda_without_a_driver_is_refused(monkeypatch):
    monkeypatch.setattr(backend, "cuda_driver_found", lambda: False)
    with pytest.raises(backend.BackendError, match="cuda_ad_rgb needs an NVIDIA driver; none answers. Use --variant llvm_ad_rgb"):
        backend.select_variant("cuda_ad_rgb")
    monkeypatch.setattr(backend, "cuda_driver_found", lambda: True)
    monkeypatch.setattr(backend, "optix_found", lambda: False)
    with pytest.raises(backend.BackendError, match="needs the OptiX runtime"):
        backend.select_variant("cuda_ad_rgb")


def test_other_threads_get_the_selected_variant():
    """torch runs backward passes on threads of its own, where Mitsuba knows of no variant."""
    variants = []
    thread = threading.Thread(target=lambda: variants.append(backend.loaded_mitsuba().variant()))
    thread.start()
    thread.join()
    assert variants == [backend.loaded_mitsuba().variant()]


def test_a_process_that_selected_nothing_is_told():
    code = "from mitsuba_avatar.rendering.backend import loaded_mitsuba; loaded_mitsuba()"
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    assert "no variant is selected yet. Call backend.select_variant() first" in done.stderr


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not bind processes to cores")
def test_one_core_is_enough_to_read_a_scene_with_an_image():
    program = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from mitsuba_avatar.rendering import backend; backend.select_variant('llvm_ad_rgb')\n"
        "import mitsuba as mi; from mitsuba_avatar.resources import find_resource\n"
        "file = find_resource('scenes', 'dome', '.xml').with_name('dome.exr')\n"
        "print(mi.load_dict({'type': 'envmap', 'filename': str(file)}).class_name())\n"
    )
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert finished.returncode == 0 and "EnvironmentMap" in finished.stdout, finished.stderr
