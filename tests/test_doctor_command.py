"""`python -m mitsuba_avatar.doctor`: "ready", or the exact fix; an old LLVM is refused before it can abort the process."""

import os
import re
import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from mitsuba_avatar import doctor

ROOT = Path(__file__).parents[1]


def test_a_sound_machine_is_ready(capsys):
    assert doctor.main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "ready"
    facts = dict(line.split(maxsplit=1) for line in lines[:-1])
    assert {"python", "cores", "memory", "LLVM", "CUDA", "OptiX", "variant", "render", *doctor.PACKAGES} <= facts.keys()
    assert int(facts["cores"]) >= 1 and float(facts["memory"].split()[0]) > 0
    assert re.fullmatch(r"16x12 image, coverage \d+\.\d+ pixels, gradient -?\d+\.\d+, .*", facts["render"])


def test_the_small_render_covers_the_triangle():
    """Its area is 0.54 m^2 at 2 m, seen with a focal length of 16 pixels: 0.5 * |1.2 * 0.9 - 0.7 * 0.1| * 64 pixels."""
    coverage, gradient, seconds = doctor.render_once()
    assert coverage == pytest.approx(0.5 * (1.2 * 0.9 - 0.7 * 0.1) * 64, rel=0.15)
    # Moving the lower left corner right narrows the triangle: d(area)/dx = -(0.8 / 2) * 64.
    assert gradient == pytest.approx(-0.4 * 64, rel=0.35)
    assert seconds > 0


def test_an_old_llvm_is_refused_without_aborting(tmp_path):
    """In a process of its own, because Dr.Jit would take it down."""
    old = tmp_path / "libLLVM-14.so.1"
    old.write_bytes(b"not even a library")
    environment = os.environ | {"DRJIT_LIBLLVM_PATH": str(old), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "mitsuba_avatar.doctor", "--variant", "llvm_ad_rgb"]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 1 and not ended.stderr, ended.stderr
    last = ended.stdout.splitlines()[-1]
    assert last.startswith("not ready: ") and "libLLVM 17 or newer" in last and "14" in last
    for command in ("apt-get install", "dnf install", "brew install", "conda install"):
        assert command in last


@pytest.mark.parametrize(
    ("words", "chosen", "message"),
    [
        (["--variant", "llvm_ad_rgb"], "/nowhere/libLLVM.so.19", "names /nowhere/libLLVM.so.19, which does not exist"),
        (["--variant", "scalar_rgb"], None, "got 'scalar_rgb'"),
    ],
)
def test_what_is_wrong_is_said_in_the_last_line(monkeypatch, capsys, words, chosen, message):
    if chosen:
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", chosen)
    assert doctor.main(words) == 1
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("not ready: ") and message in last


def test_a_missing_package_is_named(monkeypatch, capsys):
    def version(name):
        if name == "safetensors":
            raise PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(doctor, "version", version)
    assert doctor.main([]) == 1
    assert capsys.readouterr().out.splitlines()[-1].startswith("not ready: safetensors is not installed. Run: pip install -e .")


def test_the_packages_are_those_of_the_project():
    block = re.search(r"^dependencies = \[\n(.*?)^\]", (ROOT / "pyproject.toml").read_text(), re.DOTALL | re.MULTILINE).group(1)
    assert re.findall(r'^\s+"([A-Za-z0-9-]+)', block, re.MULTILINE) == list(doctor.PACKAGES)


def test_a_render_without_a_gradient_is_not_ready(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "render_once", lambda: (20.0, float("nan"), 0.1))
    assert doctor.main([]) == 1
    assert "not ready: the renderer gave no image or no gradient" in capsys.readouterr().out
