"""Which runs an ablation consists of, and that runs made differently, or of other captures, never share a table."""

import dataclasses
import shutil
from pathlib import Path

import pytest

from mitsuba_avatar.ablation.plan import CAPTURE_NOTE, PlannedRun, capture_digest, plan_runs
from mitsuba_avatar.ablation.rows import choose_rows
from mitsuba_avatar.presets import resolve, save_settings


def plan(folder: Path, *overrides: str, seeds: int = 2, budget: float = 0.5, digest: str | None = None) -> list[PlannedRun]:
    return plan_runs(folder, choose_rows("ours,pose_face"), range(seeds), budget, Path("somewhere/capture"), list(overrides), digest)


def begin(run: PlannedRun) -> None:
    """Leave what a worker leaves after its first checkpoint."""
    (run.path / "checkpoints").mkdir(parents=True, exist_ok=True)
    (run.path / "checkpoints" / "checkpoints.json").write_text("{}")


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Files as a capture has them; what is in them does not matter."""
    folder = tmp_path / "capture"
    for name in ("capture.yaml", "cameras.json", "frames.csv", "pose.npy", "root.npy", "face.npy", "vertices.npy", "keypoints.npy"):
        folder.mkdir(exist_ok=True)
        (folder / name).write_text(f"content of {name}")
    for name in ("images/front/000020.png", "images/back/000020.png", "masks/front/000020.png", "backgrounds/front.png", "truth/a.npz"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(f"content of {name}")
    return folder


def test_seeds_are_the_outer_loop_and_the_budget_scales_all_schedules(tmp_path: Path):
    runs = plan(tmp_path, "training.iterations=90", "loss.geometry_iterations=30", "loss.kl_warm_up=20")
    assert [(run.row.name, run.settings.training.seed) for run in runs] == [("ours", 0), ("pose_face", 0), ("ours", 1), ("pose_face", 1)]
    assert {run.settings.training.iterations for run in runs} == {45}
    assert {(run.settings.loss.geometry_iterations, run.settings.loss.kl_warm_up) for run in runs} == {(15, 10)}
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
    with pytest.raises(ValueError, match=rf"loss.kl {run.settings.loss.kl} -> 0.5. Name another folder with --out."):
        plan(tmp_path, "loss.kl=0.5")


def test_rendering_counts_as_settings_too_but_not_where_it_is_computed(tmp_path: Path):
    run = plan(tmp_path)[0]
    run.path.mkdir(parents=True)
    begun = dataclasses.replace(run.settings, rendering=dataclasses.replace(run.settings.rendering, variant="llvm_ad_rgb"))
    save_settings(run.path / "settings.yaml", begun)
    assert run.settings.rendering.variant == "auto"
    plan(tmp_path)
    with pytest.raises(ValueError, match=r"got rendering.samples_per_pixel \d+ -> 9, rendering.ambient_occlusion_rays \d+ -> 7. Name"):
        plan(tmp_path, "rendering.samples_per_pixel=9", "rendering.ambient_occlusion_rays=7")


def test_a_run_begun_or_measured_on_other_content_is_refused(tmp_path: Path):
    """The path is the same; what lies there is not."""
    first, second, *_ = plan(tmp_path, digest="a" * 64)
    first.note_capture()
    second.note_capture()
    plan(tmp_path, digest="b" * 64)  # nothing is begun
    begin(first)
    plan(tmp_path, digest="a" * 64)
    with pytest.raises(ValueError, match=r"ours/seed_0 to be new .*now \(digest bbbbbbbbbbbb\); got a run that was begun .*aaaaaaaaaaaa"):
        plan(tmp_path, digest="b" * 64)
    shutil.rmtree(first.path)
    second.save_measures({"name": "pose_face", "capture_digest": "a" * 64})
    plan(tmp_path, digest="a" * 64)
    with pytest.raises(ValueError, match=r"somewhere/capture now .* got a run that was measured on other content .* Name another folder"):
        plan(tmp_path, digest="b" * 64)


def test_runs_without_a_digest_and_captures_without_one_are_accepted(tmp_path: Path):
    first, second, *_ = plan(tmp_path)
    begin(first)
    second.save_measures({"name": "pose_face"})
    plan(tmp_path, digest="b" * 64)
    second.save_measures({"name": "pose_face", "capture_digest": "a" * 64})
    plan(tmp_path, digest=None)


def test_a_run_keeps_the_note_of_what_it_was_begun_on(tmp_path: Path):
    run, *_ = plan(tmp_path, digest="a" * 64)
    assert run.noted_digest() is None
    run.note_capture()
    newer = dataclasses.replace(run, digest="b" * 64)
    newer.note_capture()
    assert run.noted_digest() == "b" * 64, "nothing was learnt from the older one"
    dataclasses.replace(run, digest=None).note_capture()
    assert run.noted_digest() is None
    run.note_capture()
    begin(run)
    newer.note_capture()
    assert newer.noted_digest() == "a" * 64
    (run.path / CAPTURE_NOTE).write_text("[]")
    with pytest.raises(ValueError, match="expected the digest of a capture in .*capture.json; got .*Remove the run's folder"):
        run.noted_digest()


@pytest.mark.parametrize("name", ["capture.yaml", "cameras.json", "frames.csv", "pose.npy", "root.npy", "face.npy", "vertices.npy"])
def test_a_changed_byte_of_a_file_that_is_learnt_from_changes_the_digest(capture: Path, name: str):
    before = capture_digest(capture)
    (capture / name).write_text(f"Content of {name}")
    assert capture_digest(capture) != before
    if name != "capture.yaml":
        (capture / name).unlink()
        assert capture_digest(capture) != before


@pytest.mark.parametrize("name", ["images/front/000020.png", "masks/front/000020.png", "backgrounds/front.png"])
def test_number_and_size_of_pictures_change_the_digest(capture: Path, name: str):
    digests = [capture_digest(capture)]
    content = (capture / name).read_text()
    (capture / name).write_text(content + ".")
    digests.append(capture_digest(capture))
    (capture / name).write_text(content[:-1])
    (capture / name).with_name("000021.png").write_text(content[-1])
    digests.append(capture_digest(capture))
    assert len(set(digests)) == 3


def test_the_digest_is_of_the_content_alone(capture: Path):
    before = capture_digest(capture)
    (capture / "images" / "front" / ".000022.1234abcd.png").write_text("half of an image")
    (capture / "keypoints.npy").write_text("others")
    (capture / "truth" / "a.npz").unlink()
    moved = capture.rename(capture.with_name("moved"))
    assert capture_digest(moved) == before and len(before) == 64
    (moved / "capture.yaml").unlink()
    assert capture_digest(moved) is None and capture_digest(moved / "nowhere") is None


@pytest.mark.parametrize(("seeds", "budget"), [(0, 1.0), (1, 0.0)])
def test_nothing_to_train_is_refused(tmp_path: Path, seeds: int, budget: float):
    with pytest.raises(ValueError, match="one seed or more, counted from 0 or more, and a positive budget"):
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
