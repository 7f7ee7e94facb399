"""Which runs an ablation consists of, and that runs made differently never share a table."""

from pathlib import Path

import pytest

from mitsuba_avatar.ablation.plan import PlannedRun, plan_runs
from mitsuba_avatar.ablation.rows import choose_rows
from mitsuba_avatar.presets import resolve, save_settings


def plan(folder: Path, *overrides: str, seeds: int = 2, budget: float = 0.5) -> list[PlannedRun]:
    return plan_runs(folder, choose_rows("ours,pose_face"), seeds, budget, Path("somewhere/capture"), list(overrides))


def test_seeds_are_the_outer_loop_and_the_budget_scales_all_schedules(tmp_path: Path):
    runs = plan(tmp_path, "training.iterations=90", "loss.geometry_iterations=30")
    assert [(run.row.name, run.settings.training.seed) for run in runs] == [("ours", 0), ("pose_face", 0), ("ours", 1), ("pose_face", 1)]
    assert {(run.settings.training.iterations, run.settings.loss.geometry_iterations) for run in runs} == {(45, 15)}
    assert runs[1].path == tmp_path / "pose_face" / "seed_0"
    assert all(Path(run.settings.capture.path).is_absolute() for run in runs)


def test_overrides_reach_every_row_and_leave_its_switches(tmp_path: Path):
    ours, pose_face, *_ = plan(tmp_path, "model.texture_size=128")
    assert ours.settings.model.texture_size == pose_face.settings.model.texture_size == 128
    assert ours.settings.model.use_latent and not pose_face.settings.model.use_latent


def test_a_folder_of_other_settings_is_refused_with_what_differs(tmp_path: Path):
    run = plan(tmp_path)[0]
    run.path.mkdir(parents=True)
    save_settings(run.path / "settings.yaml", run.settings)
    plan(tmp_path)
    with pytest.raises(ValueError, match=r"loss.kl 0.0005 -> 0.5. Name another folder with --out."):
        plan(tmp_path, "loss.kl=0.5")


@pytest.mark.parametrize(("seeds", "budget"), [(0, 1.0), (1, 0.0)])
def test_nothing_to_train_is_refused(tmp_path: Path, seeds: int, budget: float):
    with pytest.raises(ValueError, match="at least 1 and a positive budget"):
        plan(tmp_path, seeds=seeds, budget=budget)


def test_progress_is_read_from_the_log_even_where_its_last_line_is_cut(tmp_path: Path):
    run = PlannedRun(choose_rows("ours")[0], resolve("ablation/ours"), tmp_path)
    assert run.iterations_done() == 0
    (tmp_path / "metrics.jsonl").write_text('{"iteration": 10}\n{"iteration": 20}\n{"iterat')
    assert run.iterations_done() == 20
    run.save_measures({"name": "ours"})
    assert run.is_measured and run.iterations_done() == run.settings.training.iterations
    run.measures_path.write_text("{")
    with pytest.raises(ValueError, match="Remove it to measure again"):
        run.measures()
