"""Every example runs as it stands."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


EXAMPLES_AND_WHAT_THEY_MAKE = [
    ("01_gradient_of_an_image", None),
    ("02_write_a_capture", "capture.yaml"),
    ("03_drive_an_avatar", "examples/elbows_1.0.png"),
    ("04_drive_from_a_recording", "examples/driven.mp4"),
    ("05_export_to_gltf", "examples/avatar.glb"),
]


@pytest.mark.parametrize(("name", "made"), EXAMPLES_AND_WHAT_THEY_MAKE)
def test_an_example_runs(name: str, made: str | None, fitted_run: Path, tmp_path: Path, private_cache):
    folder = tmp_path / "folder"
    if name > "03":
        shutil.copytree(fitted_run, folder)
    command = [sys.executable, str(EXAMPLES / f"{name}.py"), *([] if made is None else [str(folder)])]
    environment = os.environ | {"PYTHONPATH": str(EXAMPLES.parent), "OMP_NUM_THREADS": "1"}
    result = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert made is None or (folder / made).stat().st_size > 100


def test_no_example_is_left_out():
    assert [path.stem for path in sorted(EXAMPLES.glob("*.py"))] == [name for name, _ in EXAMPLES_AND_WHAT_THEY_MAKE]
