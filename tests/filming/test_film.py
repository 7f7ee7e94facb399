import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.body.rig import load_rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import unpose_vertices
from mitsuba_avatar.captures.checks import check_values
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.filming import cloth_simulation
from mitsuba_avatar.filming.film import CONTACT_SHEET, default_capture_path, film_capture
from mitsuba_avatar.filming.performance import Performance
from mitsuba_avatar.filming.plan import Shard, plan_filming
from mitsuba_avatar.filming.settings import StudioSettings
from tests.filming.acted import Acted


@pytest.fixture(scope="module")
def folder(settings: StudioSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("studio") / "tiny"
    film_capture(settings, path)
    return path


@pytest.fixture(scope="module")
def displaced(settings: StudioSettings, tmp_path_factory: pytest.TempPathFactory) -> Capture:
    """A shorter capture in displaced clothes; not to be written to."""
    return film_capture(_displaced(settings), tmp_path_factory.mktemp("displaced") / "tiny")


def _files(folder: Path) -> dict[str, bytes]:
    """All but what says how long it took."""
    files = {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
    return {name: content for name, content in files.items() if name not in ("info.json", "truth/filming_log.csv")}


def _displaced(settings: StudioSettings, **changes: object) -> StudioSettings:
    """Without simulation, and shorter."""
    clothing = dataclasses.replace(settings.clothing, is_simulated=False, **changes)
    motion = dataclasses.replace(settings.motion, train_frames=3, test_frames=2)
    return dataclasses.replace(settings, clothing=clothing, motion=motion)


def test_a_filmed_capture_is_whole_and_passes_every_check(folder: Path, settings: StudioSettings):
    capture = Capture.open(folder)
    rig = load_rig(capture.rig_path)
    check_values(capture, rig)
    assert (len(capture.camera_names(held_out=False)), len(capture.camera_names(held_out=True))) == (3, 1)
    assert (len(capture.frame_indices("train")), len(capture.frame_indices("test"))) == (8, 4)
    image, mask = capture.image("train_01", 5), capture.mask("train_01", 5)
    assert image.shape == (settings.cameras.height, settings.cameras.width, 3) and 0.03 < mask.mean() < 0.6
    np.testing.assert_array_equal(image[mask == 0][0], np.float32(capture.description.background))
    assert (folder / CONTACT_SHEET).is_file()


def test_arrays_tell_the_truth(folder: Path):
    """Unposing the registered surface and reading its landmarks gives the face signal; keypoints are the posed joints."""
    capture = Capture.open(folder)
    rig = load_rig(capture.rig_path)
    skeleton = Skeleton(rig)
    transforms = skeleton(torch.from_numpy(np.array(capture.theta)), torch.from_numpy(np.array(capture.root)))
    rest = unpose_vertices(torch.from_numpy(np.array(capture.vertices)), transforms, torch.from_numpy(rig.skinning_weights))
    np.testing.assert_allclose(face_keypoints(rig, rest).numpy(), capture.face, atol=2e-5)
    joints = skeleton.posed_joints(transforms).numpy()[:, rig.keypoint_joints]
    np.testing.assert_allclose(capture.keypoints[..., :3], joints, atol=2e-5)
    assert (capture.keypoints[..., 3] == 1).all()
    train = capture.frame_indices("train")
    np.testing.assert_allclose(rest.numpy()[train].mean(axis=0), rig.rest_vertices, atol=2e-4)


def test_the_template_fits_better_dressed_than_bare(folder: Path, performance: Acted):
    offsets = np.linalg.norm(performance.rest_vertices - load_rig(folder / "rig.npz").rest_vertices, axis=-1)
    assert np.median(offsets) < 0.003


def test_interrupted_filming_goes_on_where_it_stopped(folder: Path, settings: StudioSettings, tmp_path: Path):
    """And the same settings, in another folder and in two runs, give the same bytes."""

    def interrupt(stage: str, done: int, total: int) -> None:
        if (stage, done) == ("filming", 5):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film_capture(settings, tmp_path / "part", progress=interrupt)
    assert not (tmp_path / "part" / "capture.yaml").exists()
    first = tmp_path / "part" / "images" / "train_00" / "000000.png"
    written = first.stat().st_mtime_ns
    steps: list[tuple[str, int, int]] = []
    film_capture(settings, tmp_path / "part", progress=lambda *step: steps.append(step))
    assert {stage for stage, _, _ in steps} == {"filming", "collecting surfaces"}, "cloth is not simulated again"
    assert ("filming", 12, 12) in steps and first.stat().st_mtime_ns == written
    assert _files(tmp_path / "part") == _files(folder)


def test_shards_in_any_order_make_the_whole(displaced: Capture, settings: StudioSettings, tmp_path: Path):
    """Three processes' shares, the last first, give the files of one run; only the one that finds nothing missing finishes."""
    results = [film_capture(_displaced(settings), tmp_path / "shared", shard=Shard(index, 3)) for index in (2, 0, 1)]
    assert results[:2] == [None, None] and results[2] is not None
    assert _files(tmp_path / "shared") == _files(displaced.path)


def test_only_segments_that_a_shard_shows_are_simulated(settings: StudioSettings, tmp_path: Path):
    short = dataclasses.replace(settings, motion=dataclasses.replace(settings.motion, train_frames=3, test_frames=1))
    assert film_capture(short, tmp_path / "capture", shard=Shard(0, 4)) is None
    simulated = list((tmp_path / "capture" / "truth" / "garment_vertices").iterdir())
    assert [path.name for path in simulated] == ["000_range_of_motion_trunk_and_head.npy"]


def test_a_garment_that_explodes_is_never_filmed(settings: StudioSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cloth_simulation, "LARGEST_STRETCH", 0.0)
    monkeypatch.setattr(cloth_simulation, "STRETCH_SLACK", 0.0)
    with pytest.raises(ValueError, match=r"at frame 0 of segment 'range_of_motion_trunk_and_head'. Raise clothing.substeps_per_second"):
        film_capture(settings, tmp_path / "capture")
    assert not list((tmp_path / "capture").rglob("*.png")) and not list((tmp_path / "capture").rglob("garment_vertices/*"))


def test_tracking_noise_is_in_the_capture_and_the_truth_beside_it(displaced: Capture, settings: StudioSettings, tmp_path: Path):
    noisy = film_capture(_displaced(settings, tracking_noise=0.004), tmp_path / "noisy")
    truth = np.load(tmp_path / "noisy" / "truth" / "vertices.npy")
    np.testing.assert_array_equal(truth, displaced.vertices)
    error = np.linalg.norm(noisy.vertices - truth, axis=-1)
    assert np.sqrt((error**2).mean()) == pytest.approx(0.004, rel=0.02)
    assert not (displaced.path / "truth" / "vertices.npy").exists()
    np.testing.assert_array_equal(noisy.encoded_image("train_01", 2), displaced.encoded_image("train_01", 2))


def test_the_unmatched_settings_are_the_same_person_otherwise(displaced: Capture, settings: StudioSettings, tmp_path: Path):
    """A headset hides the upper face, whose signal comes as codes; the skeleton and the cameras' places are those of the plain capture."""
    codes = dataclasses.replace(_displaced(settings, headset=True, attire="leafy"))
    codes = dataclasses.replace(codes, motion=dataclasses.replace(codes.motion, face_signal="action_codes"))
    other = film_capture(codes, tmp_path / "other")
    np.testing.assert_array_equal(other.theta, displaced.theta)
    assert other.description.face_signal == "action_codes" and other.face.shape[1] == 52 == len(other.description.face_names)
    np.testing.assert_array_equal(other.face, np.load(tmp_path / "other" / "truth" / "actions.npy"))
    changed = (other.encoded_image("train_00", 0) != displaced.encoded_image("train_00", 0)).any(axis=-1)
    assert 0.02 < changed.mean() < 0.6


def test_figures_of_the_capture_are_kept(folder: Path):
    info = json.loads((folder / "info.json").read_text())
    assert (info["frames"], info["cameras"], info["images"]) == (12, 4, 48)
    assert info["hidden_mm"] == pytest.approx(min(info["hidden_state"]["linear"]["rms_mm"], info["hidden_state"]["nearest"]["rms_mm"]))
    assert info["seconds"] > 0 and set(info["test_pose_distance_deg"]) == {"test_recombined", "test_conversation"}


def test_the_capture_takes_the_room_that_was_planned(folder: Path, settings: StudioSettings):
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert size == pytest.approx(plan_filming(settings).bytes, rel=0.5)


def test_the_truth_holds_what_made_the_images(folder: Path, settings: StudioSettings, simulated: Performance):
    truth = folder / "truth"
    assert {path.name for path in truth.iterdir()} >= {"person", "garment", "light", "sensors.json", "actions.npy"}
    assert len(list((truth / "ambient_occlusion").iterdir())) == 12
    garments = sorted((truth / "garment_vertices").iterdir())
    assert sum(len(np.load(path)) for path in garments) == 12
    capture, mesh = Capture.open(folder), simulated.person.outfit.mesh
    np.testing.assert_array_equal(capture.vertices[0][mesh.body_vertices], np.load(garments[0])[0][: len(mesh.body_vertices)])


def test_a_finished_capture_is_taken_as_it_is(folder: Path, settings: StudioSettings):
    before = _files(folder)
    assert film_capture(settings, folder).path == folder
    assert _files(folder) == before


def test_another_capture_in_the_folder_is_refused(folder: Path, settings: StudioSettings):
    with pytest.raises(FileExistsError, match="finished capture"):
        film_capture(dataclasses.replace(settings, seed=5), folder)


def test_the_default_path_names_settings(settings: StudioSettings):
    path = default_capture_path(settings)
    assert path.name.startswith("tiny-") and path == default_capture_path(dataclasses.replace(settings))
    assert default_capture_path(dataclasses.replace(settings, seed=1)) != path
