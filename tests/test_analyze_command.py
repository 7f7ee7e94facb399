"""The analysis of a run, from end to end."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.analyze import main
from mitsuba_avatar.loaded_run import LoadedRun


@pytest.mark.usefixtures("one_thread", "private_cache")
def test_report_and_pictures_are_written(fitted_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    assert main([str(fitted_run), "--out", str(tmp_path / "analysis"), "--frames", "2"]) == 0
    report = json.loads((tmp_path / "analysis" / "report.json").read_text())
    assert json.loads(capsys.readouterr().out) == report
    assert report["geometry"]["test"]["driven_mm"] > 0 and 0 <= report["share_outside_region"]["face"] <= 1
    for name in ("effects", "effects_colour", "geometry", "uncertainty_shape", "uncertainty_texture"):
        with Image.open(tmp_path / "analysis" / f"{name}.png") as picture:
            assert len(np.unique(np.asarray(picture.convert("L")))) > 10


@pytest.mark.usefixtures("one_thread", "private_cache")
def test_with_another_capture_the_own_one_is_driven_with_every_imputation_too(
    fitted_run: Path, tmp_path: Path, capsys: pytest.CaptureFixture
):
    run = shutil.copytree(fitted_run, tmp_path / "run")  # codes of its training frames are kept in it
    own = str(LoadedRun.open(run).capture.path)
    other = tmp_path / "other"
    shutil.copytree(own, other)
    assert main([str(run), "--out", str(tmp_path / "analysis"), "--frames", "1", "--drives", str(other)]) == 0
    figures = json.loads(capsys.readouterr().out)["imputation"]
    assert list(figures) == [own, str(other)]
    assert figures[own]["nearest"]["from_truth_mm"] > 0 and figures[str(other)]["nearest"]["from_truth_mm"] is None
    assert figures[own]["zero"]["step_mm"] == pytest.approx(figures[str(other)]["zero"]["step_mm"], rel=1e-3)


def test_a_folder_that_is_no_run_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture):
    assert main([str(tmp_path)]) == 2
    assert "analyze: RunFolder.open(): expected a run" in capsys.readouterr().err
