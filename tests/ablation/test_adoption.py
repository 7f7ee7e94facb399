"""Runs measured elsewhere join a table, if they were made alike."""

import json
from pathlib import Path

import pytest

from mitsuba_avatar.ablation.adoption import adopt
from mitsuba_avatar.ablation.plan import PlannedRun, plan_runs
from mitsuba_avatar.ablation.rows import choose_rows
from mitsuba_avatar.ablation.table import write_tables

HERE, THERE = "a" * 64, "b" * 64


def plan(folder: Path, *overrides: str, seeds: int = 2, first_seed: int = 0, digest: str | None = HERE) -> list[PlannedRun]:
    rows = choose_rows("ours,pose_face")
    seeds_planned = range(first_seed, first_seed + seeds)
    return plan_runs(folder, rows, seeds_planned, 1.0, Path(f"captures/of_{folder.name}"), list(overrides), digest)


def measure(run: PlannedRun, test: float) -> None:
    """Leave what a worker leaves in the end."""
    run.path.mkdir(parents=True, exist_ok=True)
    images = {"train": {"mse": test / 2, "takes": {}}, "test": {"mse": test, "takes": {}}}
    seed = run.settings.training.seed
    run.save_measures({"name": run.row.name, "seed": seed, "iterations": 1, "capture_digest": run.digest, "images": images})


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """A table of the second seed, made on another machine of a capture that was filmed there."""
    runs = plan(tmp_path / "there", seeds=1, first_seed=1, digest=THERE)
    for number, run in enumerate(runs):
        measure(run, 100.0 + number)
    write_tables(tmp_path / "there", runs)
    return tmp_path / "there" / "table.json"


def test_seeds_of_another_table_are_not_trained_again(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    runs = plan(tmp_path / "here")
    assert [run.settings.training.seed for run in adopt(runs, table)] == [1, 1]
    assert f"measured on captures of digest {THERE[:12]}; that of this one is {HERE[:12]}" in capsys.readouterr().err
    assert [run.is_measured for run in runs] == [False, False, True, True]
    assert runs[2].measures()["adopted_from"] == str(table) and runs[2].measures()["images"]["test"]["mse"] == 100.0
    for run in runs[:2]:
        measure(run, 50.0)
    ours, pose_face = write_tables(tmp_path / "here", plan(tmp_path / "here"))  # the capture's digest does not stop the second plan
    assert (ours.seeds, ours.errors["test"].mean) == (2, 75.0) and pose_face.errors["test"].mean == 75.5


def test_what_is_begun_or_measured_here_stays(table: Path, tmp_path: Path):
    runs = plan(tmp_path / "here", digest=THERE)
    measure(runs[2], 7.0)
    (runs[3].path / "checkpoints").mkdir(parents=True)
    (runs[3].path / "checkpoints" / "checkpoints.json").write_text("{}")
    assert adopt(runs, table) == []
    assert runs[2].measures()["images"]["test"]["mse"] == 7.0 and not runs[3].is_measured


def test_the_same_capture_is_nothing_to_tell(table: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    assert len(adopt(plan(tmp_path / "here", digest=THERE), table)) == 2
    assert capsys.readouterr().err == ""


def test_runs_of_other_settings_are_refused_before_and_after(table: Path, tmp_path: Path):
    with pytest.raises(
        ValueError, match=r"ours, seed 1, of .*table.json to be of the same settings; got loss.kl .* -> 0.5. Leave --measured"
    ):
        adopt(plan(tmp_path / "here", "loss.kl=0.5"), table)
    assert not (tmp_path / "here").exists()
    adopt(plan(tmp_path / "here"), table)
    with pytest.raises(ValueError, match="ours/seed_1 to be new or of the same settings"):
        plan(tmp_path / "here", "loss.kl=0.5")


def test_a_setting_younger_than_the_table_had_its_default(table: Path, tmp_path: Path):
    rows = json.loads(table.read_text())
    for row in rows:
        del row["settings"]["training.precision"], row["settings"]["training.gradient_clip"]
    table.write_text(json.dumps(rows))
    assert len(adopt(plan(tmp_path / "here", "training.precision=float32"), table)) == 2
    with pytest.raises(ValueError, match="got training.precision float32 -> auto"):
        adopt(plan(tmp_path / "elsewhere"), table)


def test_a_table_that_is_none_or_does_not_tell_its_settings_is_refused(table: Path, tmp_path: Path):
    runs = plan(tmp_path / "here")
    with pytest.raises(FileNotFoundError, match="there is no .*nowhere.json. Correct --measured"):
        adopt(runs, tmp_path / "nowhere.json")
    rows = json.loads(table.read_text())
    for text in ("[1]", "{", '{"a": 1}'):
        table.write_text(text)
        with pytest.raises(ValueError, match="expected runs with name, seed and measures"):
            adopt(runs, table)
    del rows[0]["settings"]
    table.write_text(json.dumps(rows))
    with pytest.raises(ValueError, match="expected the settings of ours, seed 1, .*got none, as older versions wrote it. Train it again"):
        adopt(runs, table)
