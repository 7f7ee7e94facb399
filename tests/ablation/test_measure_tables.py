"""Tables of what was measured of every run beside its errors."""

from pathlib import Path

from mitsuba_avatar.ablation.measure_tables import measures_markdown
from mitsuba_avatar.ablation.plan import PlannedRun
from mitsuba_avatar.ablation.rows import choose_rows
from mitsuba_avatar.presets import resolve


def measured(folder: Path, name: str, seed: int, **measures: dict) -> PlannedRun:
    run = PlannedRun(choose_rows(name)[0], resolve(f"ablation/{name}", [f"training.seed={seed}"]), folder / name / str(seed))
    run.path.mkdir(parents=True)
    run.save_measures(measures)
    return run


def test_figures_are_means_over_seeds_and_what_was_not_measured_is_a_dash(tmp_path: Path):
    swap = {"latent_swap": {"body_keypoints_mm": 0.5, "vertices_mm": {"garment": 3.0}}}
    runs = [
        measured(tmp_path, "ours", 0, disentanglement=swap, shading={"train": {"slope": 0.1}, "test": {"slope": 0.25}}),
        measured(tmp_path, "ours", 1, disentanglement=swap, shading={"train": {"slope": 0.2}}),
        measured(tmp_path, "pose_face", 0, shading={"train": {"slope": 0.3}, "test": {"slope": 0.4}}),
        PlannedRun(choose_rows("without_shadow")[0], resolve("ablation/without_shadow"), tmp_path / "to_come"),
    ]
    shading, disentanglement = measures_markdown(runs).split("## ")[1:]  # nobody measured geometry
    title, _, heading, _, ours, pose_face = shading.strip().splitlines()
    assert title == "Shading" and heading.startswith("| model | train: slope | test: slope |")
    assert ours == "| ours | 0.15 ± 0.07 | - | - | - | - | - |", "one seed alone has the slope on test frames"
    assert pose_face == "| pose+face | 0.30 | 0.40 | - | - | - | - |"
    ours, pose_face = disentanglement.strip().splitlines()[-2:]
    assert ours.startswith("| ours | 0.50 ± 0.00 | - | 3.0 ± 0.0 | - |") and set(pose_face) == set("| pose+face -")
    assert measures_markdown(runs[3:]) == ""


def test_errors_with_the_mean_code_stand_beside_what_its_offset_costs(tmp_path: Path):
    errors = {"train": {"mse": 42.6}, "test": {"mse": 58.2}}
    runs = [
        measured(tmp_path, "ours", 0, images_mean_code=errors, disentanglement={"offset_nats": 3.43}),
        measured(tmp_path, "pose_face", 0, images={"train": {"mse": 53.0}}),
    ]
    lines = measures_markdown(runs).strip().splitlines()
    assert lines[0] == "## Driven with the mean code"
    assert lines[-2:] == ["| ours | 42.60 | - | 58.20 | 3.4 |", "| pose+face | - | - | - | - |"]
