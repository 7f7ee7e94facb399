"""`python -m mitsuba_avatar.fit`: what a fit leaves behind, how it is interrupted and resumed, and what it says about bad input."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from mitsuba_avatar.body.momentum_rig import momentum_from_rig, momentum_poses
from mitsuba_avatar.body.rig import load_rig
from mitsuba_avatar.captures.formats.goliath_writer import GoliathBody, write_goliath
from mitsuba_avatar.captures.images import image_size
from mitsuba_avatar.drive import main as drive
from mitsuba_avatar.evaluate import main as evaluate
from mitsuba_avatar.fit import main
from mitsuba_avatar.presets import load_settings
from mitsuba_avatar.reporting.evaluation import METHODS
from mitsuba_avatar.reporting.metrics import load_metrics, read_records
from mitsuba_avatar.training.run_folder import RunFolder
from tests.drawn_capture import HEIGHT, HELD_OUT, WIDTH
from tests.full_disk import full_disk
from tests.small_capture import write_small_capture
from tests.small_rig import make_small_rig

pytestmark = pytest.mark.usefixtures("one_thread")

# Two steps and the smallest report.
SHORTEST_FIT = (
    *("training.iterations=2", "training.checkpoint_every=2", "training.validate_every=2", "training.preview_every=2"),
    *("evaluation.frames_per_split=1", "evaluation.orbit_frames=1", "evaluation.samples_per_pixel=1"),
)


def fit(capture: Path | str, run: Path, *words: str) -> int:
    return main(["--config", "tiny", "--capture", str(capture), "--run", str(run), *words])


# ---- what a fit does


@pytest.mark.slow  # about ten seconds: a fit, and two commands with its avatar
def test_a_goliath_capture_is_fitted_evaluated_and_driven_where_it_lies(drawn_capture, tmp_path, private_cache, one_thread):
    """Zips in, avatar out: no image is written but the run's own, and a cache that was emptied fills itself again."""
    exported = tmp_path / "s--20260101--0000--TST001--pilot--ProjectGoliath--ClothedBody--3cams"
    rig = load_rig(drawn_capture.rig_path)
    poses = momentum_poses(np.array(drawn_capture.theta), np.array(drawn_capture.root))
    write_goliath(drawn_capture, exported, GoliathBody(momentum_from_rig(rig), poses))
    held_out = drawn_capture.camera_names(held_out=True)
    words = (f"capture.held_out_cameras={','.join(held_out)}", *SHORTEST_FIT)
    assert fit(f"goliath:{exported}", tmp_path / "run", *words) == 0
    assert load_settings(tmp_path / "run/settings.yaml").capture.path == f"goliath:{exported}"
    in_cache = list((private_cache / "in_place").rglob("capture.yaml"))
    assert len(in_cache) == 1 and not (in_cache[0].parent / "images").exists()
    shutil.rmtree(private_cache / "in_place")
    assert evaluate([str(tmp_path / "run"), "--frames", "1", "--no-flip", "--flicker-frames", "0"]) == 0
    assert load_metrics(tmp_path / "run/metrics.json")["avatar"]["test"]["held_out"]["images"] == len(held_out)
    assert drive([str(tmp_path / "run"), "--pose", f"goliath:{exported}", "--path", "front", "--format", "png"]) == 0
    assert main(["--run", str(tmp_path / "run"), "--resume", "training.iterations=3"]) == 0


def test_a_short_fit_reduces_the_error_of_held_out_cameras(fitted_run):
    """Against the untrained avatar, which is the posed template with the mean texture: on poses and cameras it never saw."""
    means = load_metrics(fitted_run / "metrics.json")
    trained, untrained = (means[method]["test"]["held_out"] for method in ("avatar", "template_mean_texture"))
    assert trained["psnr"] > untrained["psnr"] + 0.5
    assert trained["l1"] < 0.85 * untrained["l1"] and trained["mse"] < 0.8 * untrained["mse"]
    assert trained["vertex_mm"] < untrained["vertex_mm"]


def test_metrics_are_keyed_by_method_split_cameras_and_metric(fitted_run):
    means = load_metrics(fitted_run / "metrics.json")
    assert list(means) == list(METHODS)
    for method in METHODS:
        assert list(means[method]) == ["train", "test"]
        for split in ("train", "test"):
            assert set(means[method][split]) == {"seen", "held_out"}
            for cameras, count in (("seen", 8), ("held_out", 2)):
                values = means[method][split][cameras]
                assert set(values) == {"psnr", "ssim", "l1", "mse", "iou", "vertex_mm", "images"}
                assert values["images"] == count and 0 < values["iou"] <= 1


def test_a_run_folder_is_complete(fitted_run, drawn_capture):
    assert RunFolder.open(fitted_run).checkpoints.index().last == 40
    assert [record["iteration"] for record in read_records(fitted_run / "metrics.jsonl")] == [10, 20, 30, 40]
    last = read_records(fitted_run / "metrics.jsonl")[-1]
    assert {"loss", "image", "mask", "geometry", "laplacian", "kl", "validation_psnr", "learning_rate", "render_ms"} <= set(last)
    settings = yaml.safe_load((fitted_run / "settings.yaml").read_text())
    assert settings["training"]["iterations"] == 40 and settings["rendering"]["variant"] == "llvm_ad_rgb"
    assert settings["capture"]["path"] == str(drawn_capture.path)
    pictures = {str(path.relative_to(fitted_run)) for path in fitted_run.rglob("*.png")}
    held_out = {f"pictures/held_out/{HELD_OUT}_{number:06d}.png" for number in (28, 29)}
    assert pictures == {"previews/000040.png", "pictures/comparison.png", "pictures/curves.png"} | held_out
    assert image_size(fitted_run / f"pictures/held_out/{HELD_OUT}_000028.png") == (WIDTH, HEIGHT)
    assert (fitted_run / "orbit.mp4").stat().st_size > 1000
    assert not list(fitted_run.rglob(".*")), "no temporary file stays"


@pytest.mark.parametrize(
    ("missing", "overrides", "terms"),
    [
        (["vertices.npy"], ["model.use_latent=false"], {"image", "mask"}),
        ([], ["model.use_shadow=false", "model.use_latent=false"], {"image", "mask", "geometry", "laplacian"}),
    ],
    ids=["without meshes", "without latent code and shadow"],
)
def test_a_fit_with_less(tmp_path, private_cache, drawn_capture, missing, overrides, terms):
    shutil.copytree(drawn_capture.path, tmp_path / "copy")
    for name in missing:
        (tmp_path / "copy" / name).unlink()
    assert fit(tmp_path / "copy", tmp_path / "run", *SHORTEST_FIT, *overrides) == 0
    (record,) = read_records(tmp_path / "run/metrics.jsonl")
    assert terms == {"image", "mask", "geometry", "laplacian", "kl"} & set(record)
    assert ("vertex_mm" in load_metrics(tmp_path / "run/metrics.json")["avatar"]["test"]["seen"]) == (not missing)


def test_a_capture_without_test_frames_and_held_out_cameras_is_fitted(tmp_path, private_cache):
    write_small_capture(tmp_path / "small")
    frames = tmp_path / "small/frames.csv"
    frames.write_text(frames.read_text().replace("test", "train"))
    description = tmp_path / "small/capture.yaml"
    description.write_text(description.read_text().replace("held_out_cameras:\n- high", "held_out_cameras: []"))
    assert fit(tmp_path / "small", tmp_path / "run", *SHORTEST_FIT) == 0
    assert {split: list(means) for split, means in load_metrics(tmp_path / "run/metrics.json")["avatar"].items()} == {"train": ["seen"]}


def test_a_new_run_takes_a_free_name(tmp_path, private_cache, drawn_capture, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs/tiny").mkdir(parents=True)
    assert main(["--config", "tiny", "--capture", str(drawn_capture.path), *SHORTEST_FIT]) == 0
    assert (tmp_path / "runs/tiny-2/metrics.json").exists() and not any((tmp_path / "runs/tiny").iterdir())


def test_occlusion_of_many_frames_is_baked_beside_the_training(tmp_path, drawn_capture, monkeypatch, capsys):
    """The same losses, and maps of the same bytes. (That none is baked by the trainer: tests/rendering/test_occlusion_ahead.py.)"""
    losses, maps = [], []
    for at_once, name in ((10_000, "before"), (5, "beside")):
        monkeypatch.setattr("mitsuba_avatar.fitting.BAKED_AT_ONCE", at_once)
        monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(tmp_path / name))
        assert fit(drawn_capture.path, tmp_path / f"{name}_run", *SHORTEST_FIT) == 0
        assert ("by a process of their own" in capsys.readouterr().err) == (name == "beside")
        losses.append(read_records(tmp_path / f"{name}_run/metrics.jsonl")[-1]["image"])
        maps.append({path.name: path.read_bytes() for path in (tmp_path / name).rglob("*.npy")})
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    assert maps[1].items() <= maps[0].items() and len(maps[1]) >= 5


# ---- interrupting and resuming


def start_fit(capture: Path, run: Path, *words: str) -> subprocess.Popen:
    arguments = ["--config", "tiny", "--capture", str(capture), "--run", str(run), *words]
    return subprocess.Popen(
        [sys.executable, "-m", "mitsuba_avatar.fit", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[1])},
    )


def wait_for(condition, process: subprocess.Popen, seconds: float = 120) -> None:
    """Wait until a condition holds; a process that ends before that fails the test with its words."""
    deadline = time.monotonic() + seconds
    while not condition():
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            pytest.fail(f"the fit ended or hung: {process.communicate()[1]}")
        time.sleep(0.05)


def test_control_c_saves_and_says_how_to_resume(tmp_path, private_cache, drawn_capture):
    run = tmp_path / "a run"
    process = start_fit(drawn_capture.path, run, *SHORTEST_FIT, "training.iterations=100000", "training.checkpoint_every=100000")
    log = run / "metrics.jsonl"
    wait_for(lambda: log.exists() and log.read_text().count("\n") >= 1, process)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=60)[1]
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    last = RunFolder.open(run).checkpoints.index().last
    said = f"everything up to iteration {last} is saved. Continue with: python -m mitsuba_avatar.fit --run '{run}' --resume"
    assert said in errors
    assert main(["--run", str(run), "--resume", f"training.iterations={last + 2}"]) == 0
    assert RunFolder.open(run).checkpoints.index().last == last + 2
    assert RunFolder.open(run).settings.training.iterations == last + 2, "the settings that ran are the ones that are saved"
    iterations = [record["iteration"] for record in read_records(log)]
    assert iterations == sorted(set(iterations)) and iterations[-1] == last + 2


def test_an_interruption_before_the_first_checkpoint_says_so(tmp_path, private_cache, drawn_capture, monkeypatch, capsys):
    def interrupt(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("mitsuba_avatar.fitting.training_statistics", interrupt)
    assert fit(drawn_capture.path, tmp_path / "run") == 130
    assert "Interrupted before the first checkpoint: no training to resume. Filmed images" in capsys.readouterr().err


def test_a_finished_run_can_be_presented_again(fitted_run, private_cache, tmp_path):
    shutil.copytree(fitted_run, tmp_path / "run")
    (tmp_path / "run/metrics.json").unlink()
    assert main(["--run", str(tmp_path / "run"), "--resume"]) == 0
    again, first = load_metrics(tmp_path / "run/metrics.json"), load_metrics(fitted_run / "metrics.json")
    assert again["avatar"]["test"]["held_out"]["psnr"] == pytest.approx(first["avatar"]["test"]["held_out"]["psnr"], abs=0.01)
    assert read_records(tmp_path / "run/metrics.jsonl") == read_records(fitted_run / "metrics.jsonl")


def test_a_disk_that_fills_up_while_a_checkpoint_is_written(fitted_run, private_cache, tmp_path, capsys):
    run = tmp_path / "run"
    shutil.copytree(fitted_run, run)
    size = min(path.stat().st_size for path in (run / "checkpoints").glob("*_000040.*"))
    with full_disk(size // 2):
        words = ("training.iterations=42", "training.validate_every=100", "training.preview_every=100", "training.checkpoint_every=1")
        assert main(["--run", str(run), "--resume", *words]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("fit:")]
    assert "expected room and permission for the checkpoint of iteration 41" in line and "the one of iteration 40 is kept" in line
    assert RunFolder.open(run).checkpoints.index().last == 40
    RunFolder.open(run).load_avatar("last")


# ---- bad input: one line that names file, expectation and remedy, before any long work


@pytest.fixture
def copy(drawn_capture, tmp_path):
    """Folder of a fresh copy of the capture."""
    return shutil.copytree(drawn_capture.path, tmp_path / "copy")


@pytest.fixture
def no_long_work(monkeypatch):
    """Whatever takes minutes on a real capture must not have begun."""

    def forbidden(*arguments, **keywords):
        pytest.fail("long work began before the input was checked")

    for name in ("training_statistics", "frame_occlusion", "film_capture"):
        monkeypatch.setattr(f"mitsuba_avatar.fitting.{name}", forbidden)


def complaint(capsys) -> str:
    """The one line that the command wrote."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("fit: "), lines
    return lines[0]


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def edit_array(name, index, value):
    def edit(folder: Path) -> None:
        array = np.load(folder / name)
        array[index] = array[index] * value
        np.save(folder / name, array)

    return edit


def edit_camera(folder: Path) -> None:
    document = json.loads((folder / "cameras.json").read_text())
    document["cameras"][1]["camera_from_world"][0] = [2 * value for value in document["cameras"][1]["camera_from_world"][0]]
    (folder / "cameras.json").write_text(json.dumps(document))


def drop_vertices(folder: Path) -> None:
    np.save(folder / "vertices.npy", np.load(folder / "vertices.npy")[:, :-2])


IMAGE, MASK = "images/back/000023.png", f"masks/{HELD_OUT}/000029.png"
BAD_CAPTURES = {
    "missing image": (lambda folder: (folder / IMAGE).unlink(), [IMAGE, "got none", "Restore the file"]),
    "truncated image": (lambda folder: truncate(folder / IMAGE), [IMAGE, "a whole image", "Copy or export it again"]),
    "truncated mask": (lambda folder: truncate(folder / MASK), [MASK, "a whole image", "Copy or export it again"]),
    "mask of another size": (
        lambda folder: Image.new("L", (HEIGHT, WIDTH)).save(folder / MASK),
        [MASK, f"expected {WIDTH}x{HEIGHT} pixels", f"got {HEIGHT}x{WIDTH}", "Export it"],
    ),
    "NaN in poses": (edit_array("pose.npy", (3, 1), np.nan), ["pose.npy", "finite joint angles", "frame index 3 (number 23)", "Track"]),
    "NaN in vertices": (edit_array("vertices.npy", (4, 7, 2), np.nan), ["vertices.npy", "finite vertices", "number 24", "Register"]),
    "non-rigid camera": (edit_camera, ["cameras.json", "right", "rigid 4x4 matrix", "Divide out the scale"]),
    "person in millimetres": (edit_array("vertices.npy", slice(None), 3000), ["vertices.npy", "a person in metres", "m tall", "Divide"]),
    "vertices of another rig": (drop_vertices, ["vertices.npy", "258 vertices of the topology", "got 256", "same source"]),
    "missing rig": (lambda folder: (folder / "rig.npz").unlink(), ["rig.npz", "does not exist", "Give the rig.npz"]),
    "missing pose": (lambda folder: (folder / "pose.npy").unlink(), ["pose.npy", "got none", "add the files"]),
    "missing masks": (lambda folder: shutil.rmtree(folder / "masks"), ["/masks", "got none", "Segment"]),
    "missing vertices": (lambda folder: (folder / "vertices.npy").unlink(), ["vertices.npy", "got none", "model.use_latent false"]),
    "unfinished": (
        lambda folder: (folder / "capture.yaml").unlink(),
        ["capture.yaml", "got no capture.yaml", "as FORMAT:DIR"],
    ),
}


@pytest.mark.parametrize("case", BAD_CAPTURES)
def test_bad_captures_are_refused_at_once(copy, tmp_path, capsys, no_long_work, case):
    damage, expected = BAD_CAPTURES[case]
    damage(copy)
    assert fit(copy, tmp_path / "run") == 2
    line = complaint(capsys)
    for part in expected:
        assert part in line, f"expected {part!r} in {line!r}"
    assert not (tmp_path / "run").exists(), "a fit that did not begin leaves nothing behind"


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["training.iteration=5"], ["'training.iteration=5'", "Did you mean 'training.iterations'"]),
        (["--confgi", "tiny"], ["'--confgi'", "Did you mean '--config'"]),
        (["--config", "tinny"], ["'tinny'", "Known names: tiny"]),
        (["training.iterations=many"], ["expected training.iterations to be an integer; got 'many'"]),
        (["training.learning_rate=-1"], ["learning_rate to be positive; got -1"]),
        (["--variant", "scalar_rgb"], ["'scalar_rgb'", "llvm_ad_rgb"]),
        (["training.views_per_pose=9"], ["training.views_per_pose is 9", "4 training cameras", "Lower it"]),
        (["capture.held_out_cameras=lefd"], ["cameras.json", "'lefd'", "Did you mean 'left'"]),
        (["capture.image_scale=2"], ["image_scale <= 1; got 2"]),
    ],
)
def test_bad_settings_are_refused_at_once(drawn_capture, tmp_path, capsys, no_long_work, words, expected):
    assert fit(drawn_capture.path, tmp_path / "run", *words) == 2
    line = complaint(capsys)
    for part in expected:
        assert part in line
    assert not (tmp_path / "run").exists()


def test_an_unknown_key_of_a_preset_is_refused(drawn_capture, tmp_path, capsys, no_long_work):
    preset = tmp_path / "mine.yaml"
    preset.write_text("training:\n  learning_rates: 1e-3\n")
    assert main(["--config", str(preset), "--capture", str(drawn_capture.path), "--run", str(tmp_path / "run")]) == 2
    line = complaint(capsys)
    assert str(preset) in line and "'training.learning_rates'" in line and "Did you mean 'training.learning_rate'" in line


def test_a_run_folder_that_cannot_be_written_is_refused_before_the_capture_is_filmed(tmp_path, capsys, no_long_work):
    """Without --capture, the embedded capture would be filmed first."""
    (tmp_path / "file").write_text("not a folder")
    assert main(["--config", "tiny", "--run", str(tmp_path / "file/run")]) == 2
    line = complaint(capsys)
    assert f"expected a folder at {tmp_path}/file/run; got {tmp_path}/file, which is a file. Name another place." in line


def test_a_taken_run_folder_is_refused(fitted_run, drawn_capture, capsys, no_long_work):
    assert fit(drawn_capture.path, fitted_run) == 2
    assert f"expected a new run at {fitted_run}; got one. Continue it with --resume" in complaint(capsys)


def test_resuming_what_is_not_there_is_refused(tmp_path, capsys, no_long_work):
    assert main(["--run", str(tmp_path / "run"), "--resume"]) == 2
    assert f"expected a run to resume with {tmp_path}/run/settings.yaml; got none. Name its folder with --run" in complaint(capsys)


def test_a_checkpoint_of_another_rig_is_refused(fitted_run, tmp_path, capsys, no_long_work, copy):
    from mitsuba_avatar.body.rig import save_rig

    rig = make_small_rig()
    faces = rig.topology.faces[::-1].copy()
    other = type(rig.topology)(rig.topology.num_vertices, faces, rig.topology.uv, rig.topology.uv_faces[::-1].copy())
    save_rig(copy / "rig.npz", type(rig)(**{**vars(rig), "topology": other}))
    shutil.copytree(fitted_run, tmp_path / "run")
    assert main(["--run", str(tmp_path / "run"), "--resume", "--capture", str(copy)]) == 2
    line = complaint(capsys)
    assert f"expected the rig of run {tmp_path}/run" in line and f"{copy}/rig.npz" in line and "train anew" in line


def test_a_cut_checkpoint_is_refused(fitted_run, tmp_path, capsys, no_long_work):
    shutil.copytree(fitted_run, tmp_path / "run")
    truncate(tmp_path / "run/checkpoints/avatar_000040.safetensors")
    assert main(["--run", str(tmp_path / "run"), "--resume", "training.iterations=50"]) == 2
    assert "avatar_000040.safetensors cannot be read" in complaint(capsys)


def test_a_resumed_run_keeps_its_model(fitted_run, tmp_path, capsys, no_long_work):
    shutil.copytree(fitted_run, tmp_path / "run")
    assert main(["--run", str(tmp_path / "run"), "--resume", "model.latent_size=8"]) == 2
    assert "got model.latent_size 16 -> 8. A trained model keeps its sizes: train anew." in complaint(capsys)


def test_divergence_is_one_line(drawn_capture, private_cache, tmp_path, capsys):
    words = ("training.learning_rate=1e30", "training.learning_rate_final=1e30", "training.iterations=20")
    assert fit(drawn_capture.path, tmp_path / "run", *words) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("fit:")]
    assert "is not finite at iteration" in line and "frames [" in line and "cameras [[" in line and "Lower training.learning_rate" in line


def test_skipped_steps_are_in_the_log(drawn_capture, private_cache, tmp_path, monkeypatch):
    """One bad batch: the fit ends well, and its log names the batch."""
    from mitsuba_avatar.training.batches import FrameReader

    read, calls = FrameReader.read, []

    def read_damaged(self, frames, camera_names):
        batch = read(self, frames, camera_names)
        calls.append(frames)
        if len(calls) == 1:
            batch.masks[0, 0, 0, 0] = float("nan")
        return batch

    monkeypatch.setattr(FrameReader, "read", read_damaged)
    assert fit(drawn_capture.path, tmp_path / "run", *SHORTEST_FIT) == 0
    (record,) = read_records(tmp_path / "run/metrics.jsonl")
    (skipped,) = record["skipped"]
    assert record["skipped_in_all"] == 1 and skipped["iteration"] == 0 and "mask" in skipped["reason"]
    assert skipped["frames"] == [index + 20 for index in calls[0]] and len(skipped["cameras"]) == 2
