import dataclasses
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
from mitsuba_avatar.filming.film import CONTACT_SHEET, Performance, default_capture_path, film_capture
from mitsuba_avatar.filming.settings import StudioSettings


@pytest.fixture(scope="module")
def folder(settings: StudioSettings, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("studio") / "tiny"
    film_capture(settings, path)
    return path


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


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


def test_the_template_fits_better_dressed_than_bare(folder: Path, performance: Performance):
    offsets = np.linalg.norm(performance.rest_vertices - load_rig(folder / "rig.npz").rest_vertices, axis=-1)
    assert np.median(offsets) < 0.003


def test_the_same_settings_give_the_same_capture(folder: Path, settings: StudioSettings, tmp_path: Path):
    film_capture(settings, tmp_path / "again")
    assert _files(folder) == _files(tmp_path / "again")


def test_interrupted_filming_goes_on_where_it_stopped(folder: Path, settings: StudioSettings, tmp_path: Path):
    def interrupt(done: int, total: int) -> None:
        if done == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        film_capture(settings, tmp_path / "part", progress=interrupt)
    assert not (tmp_path / "part" / "capture.yaml").exists()
    first = tmp_path / "part" / "images" / "train_00" / "000000.png"
    written = first.stat().st_mtime_ns
    steps: list[tuple[int, int]] = []
    film_capture(settings, tmp_path / "part", progress=lambda done, total: steps.append((done, total)))
    assert steps[-1] == (12, 12) and first.stat().st_mtime_ns == written
    assert _files(tmp_path / "part") == _files(folder)


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
