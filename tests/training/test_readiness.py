"""What a fit needs is asked for at once, not after the mean texture."""

import shutil

import pytest

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.training.distributed import Process
from mitsuba_avatar.training.readiness import check_trainable, open_as_set
from tests.drawn_capture import HEIGHT, WIDTH


@pytest.fixture
def copy(drawn_capture, tmp_path):
    """Folder of a fresh copy without its images."""
    return shutil.copytree(drawn_capture.path, tmp_path / "copy", ignore=shutil.ignore_patterns("*.png"))


def test_scale_and_held_out_cameras_follow_the_settings(drawn_capture):
    capture = open_as_set(drawn_capture.path, resolve("tiny", ["capture.held_out_cameras=left,back", "capture.image_scale=0.5"]).capture)
    assert capture.camera_names(held_out=True) == ["back", "left"]
    assert (capture.cameras["left"].width, capture.cameras["left"].height) == (WIDTH // 2, HEIGHT // 2)
    assert drawn_capture.camera_names(held_out=True) == ["above"]


def test_an_unknown_held_out_camera_is_refused(drawn_capture):
    with pytest.raises(ValueError, match=r"expected a camera of .*cameras\.json; got 'lefd'\. Did you mean 'left'"):
        open_as_set(drawn_capture.path, resolve("tiny", ["capture.held_out_cameras=lefd"]).capture)


@pytest.mark.parametrize("overrides", [(), ("model.use_shadow=false",)])
def test_a_whole_capture_is_accepted(drawn_capture, overrides):
    check_trainable(drawn_capture, resolve("tiny", overrides), Process(1, 2))


def test_meshes_are_needed_by_the_encoder_alone(copy):
    (copy / "vertices.npy").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"expected registered meshes .*vertices\.npy; got none\. Add .* or set model\.use_latent false"
    ):
        check_trainable(Capture.open(copy), resolve("tiny"), Process())
    check_trainable(Capture.open(copy), resolve("tiny", ["model.use_latent=false"]), Process())


def test_meshes_and_one_process_are_needed_where_pictures_teach_nothing(copy):
    settings = resolve("tiny", ["loss.image=0", "loss.mask=0", "model.use_latent=false"])
    with pytest.raises(ValueError, match="expected one process, because loss.image and loss.mask are 0; got 2"):
        check_trainable(Capture.open(copy), settings, Process(1, 2))
    (copy / "vertices.npy").unlink()
    with pytest.raises(FileNotFoundError, match="raise one of the two"):
        check_trainable(Capture.open(copy), settings, Process())


def test_one_training_frame_is_too_few(copy):
    text = (copy / "frames.csv").read_text()
    first, rest = text.split("train", 1)
    (copy / "frames.csv").write_text(first + "train" + rest.replace("train", "test"))
    with pytest.raises(ValueError, match=r"expected at least two training frames in .*frames\.csv; got one"):
        check_trainable(Capture.open(copy), resolve("tiny"), Process())


def test_batches_that_cannot_be_filled_are_refused(drawn_capture):
    with pytest.raises(ValueError, match="views_per_pose is 9, but the capture has 4 training cameras"):
        check_trainable(drawn_capture, resolve("tiny", ["training.views_per_pose=9"]), Process())
    with pytest.raises(ValueError, match="2 poses a batch cannot be shared by 4 processes"):
        check_trainable(drawn_capture, resolve("tiny"), Process(0, 4))
