"""What is learnt of each camera: blur and bias by value and gradient, the identity camera, and training that finds them."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.settings import CameraResponseSettings
from mitsuba_avatar.training.batches import FrameReader
from mitsuba_avatar.training.camera_response import LARGEST_VARIANCE, CameraResponse, diffused, stretched
from mitsuba_avatar.training.checkpoints import Checkpoints
from mitsuba_avatar.training.distributed import Process

pytestmark = pytest.mark.usefixtures("one_thread")

BOTH = CameraResponseSettings(blur=True, bias=True, bias_cells=3)


def pattern(count: int, channels: int, height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Numbers without symmetry."""
    return torch.from_numpy(np.random.default_rng(seed).uniform(0.1, 0.9, (count, channels, height, width))).double()


def response(*names: str, settings: CameraResponseSettings = BOTH, size: tuple[int, int] = (20, 14)) -> CameraResponse:
    cameras = {name: Camera(name, *size, 20.0, 21.0, 9.0, 8.0, np.eye(4)) for name in names}
    return CameraResponse(cameras, settings)


def test_blur_is_a_gaussian_of_its_variance():
    """A smooth picture, B = 2 with two variances, not square; away from the borders, where filters differ by convention."""
    rows, columns = np.mgrid[0:30, 0:41]
    picture = np.exp(-((rows - 14) ** 2 + 2 * (columns - 19) ** 2) / 40) + 0.3 * np.sin(0.7 * columns + 0.2 * rows)
    values = torch.from_numpy(picture)[None, None].repeat(2, 1, 1, 1)
    blurred = diffused(values, torch.tensor([0.6, 1.7], dtype=torch.float64)).numpy()
    for index, variance in enumerate((0.6, 1.7)):
        expected = gaussian_filter(picture, variance**0.5, mode="nearest", truncate=8)
        np.testing.assert_allclose(blurred[index, 0, 7:-7, 7:-7], expected[7:-7, 7:-7], atol=2e-3)
    assert np.abs(blurred[1] - values[1].numpy()).max() > 0.05, "it does blur"
    np.testing.assert_allclose(blurred.sum(axis=(2, 3)), values.numpy().sum(axis=(2, 3)), rtol=1e-12)


def test_an_impulse_spreads_by_the_variance():
    impulse = torch.zeros(1, 1, 31, 27, dtype=torch.float64)
    impulse[0, 0, 15, 13] = 1
    spread = diffused(impulse, torch.tensor([1.3], dtype=torch.float64))[0, 0].numpy()
    rows, columns = np.mgrid[0:31, 0:27]
    assert ((rows - 15) ** 2 * spread).sum() == pytest.approx(1.3) and ((columns - 13) ** 2 * spread).sum() == pytest.approx(1.3)


def test_blur_has_the_gradient_of_finite_differences_at_no_blur_too():
    values = pattern(2, 3, 7, 9).requires_grad_()
    weight = pattern(2, 3, 7, 9, seed=1)
    variance = torch.tensor([0.0, 0.8], dtype=torch.float64, requires_grad=True)
    (diffused(values, variance) * weight).sum().backward()
    for index in range(2):
        step = torch.zeros(2, dtype=torch.float64)
        step[index] = 1e-5
        with torch.no_grad():
            ahead, behind = (float((diffused(values, variance + sign * step) * weight).sum()) for sign in (1, -1))
        assert float(variance.grad[index]) == pytest.approx((ahead - behind) / 2e-5, rel=1e-6)
    assert abs(float(variance.grad[0])) > 1e-3
    step = 1e-4 * pattern(2, 3, 7, 9, seed=2)
    with torch.no_grad():
        ahead, behind = (float((diffused(values + sign * step, variance) * weight).sum()) for sign in (1, -1))
    assert float((values.grad * step).sum()) == pytest.approx((ahead - behind) / 2, rel=1e-6)


def test_cells_are_stretched_over_each_image_alone():
    cells = pattern(2, 3, 2, 3)
    film = stretched(cells, [(20, 14), (12, 9)], 14, 20)
    assert film.shape == (2, 3, 14, 20) and not film[1, :, 9:].any() and not film[1, :, :, 12:].any()
    torch.testing.assert_close(film[:, :, 0, 0], cells[:, :, 0, 0])
    torch.testing.assert_close(film[1, :, 8, 11], cells[1, :, 1, 2])
    same = stretched(cells, [(20, 14)] * 2, 14, 20)
    torch.testing.assert_close(same[0], film[0])


@pytest.fixture
def pictures(reader):
    """A batch of the drawn capture, and its images and masks as if rendered."""
    batch = reader.read([1, 4], [["left", "front"], ["right", "left"]])
    return batch, batch.images.clone(), batch.masks.clone()


def test_a_response_begins_as_the_identity_and_one_camera_stays_so(pictures):
    batch, image, mask = pictures
    learnt = response("left", "front", "right", settings=dataclasses.replace(BOTH, identity_camera="front"), size=(40, 56))
    torch.testing.assert_close(learnt(image, mask, batch), image, atol=1e-6, rtol=0)
    with torch.no_grad():
        learnt.variance.fill_(1.0)
        learnt.bias.fill_(0.1)
    seen = learnt(image, mask, batch)
    torch.testing.assert_close(seen[1], image[1], atol=1e-6, rtol=0)
    assert all((seen[index] - image[index]).abs().max() > 0.05 for index in (0, 2, 3))
    seen.square().sum().backward()
    free = [learnt.names.index(name) for name in ("left", "right")]
    assert learnt.variance.grad[free].abs().min() > 0 and learnt.bias.grad[free].abs().max() > 0
    assert not learnt.variance.grad[1].any() and not learnt.bias.grad[1].any()
    assert learnt.facts()["front"] == {"blur_pixels": 0.0, "mean_bias": [0.0, 0.0, 0.0]}
    assert learnt.facts()["left"] == {"blur_pixels": 1.0, "mean_bias": pytest.approx([0.1] * 3)}


def test_bias_is_added_where_the_person_is_and_moves_no_silhouette(pictures):
    batch, image, mask = pictures
    mask.requires_grad_()
    learnt = response("front", "left", "right", settings=dataclasses.replace(BOTH, blur=False), size=(40, 56))
    with torch.no_grad():
        learnt.bias[1] = 0.25
    seen = learnt(image, mask, batch)
    torch.testing.assert_close(seen[0], image[0] + 0.25 * mask[0], atol=1e-6, rtol=0)
    seen.sum().backward()
    assert mask.grad.abs().max() < 1e-5, "the background that is put back cancels what was taken"


@pytest.mark.parametrize(("sign", "end"), [(1.0, 0.0), (-1.0, LARGEST_VARIANCE)])
def test_variances_stay_where_the_taps_reach(sign, end):
    learnt = response("front", "left", settings=dataclasses.replace(BOTH, learning_rate=50.0))
    (sign * learnt.variance.sum()).backward()
    learnt.step(1.0, Process())
    assert learnt.variance.tolist() == pytest.approx([end] * 2)


def test_an_identity_camera_that_is_not_trained_on_is_named():
    with pytest.raises(ValueError, match=r"identity_camera to be a training camera, one of \['front', 'left'\]; got 'above'"):
        response("front", "left", settings=dataclasses.replace(BOTH, identity_camera="above"))


class BlurredReader(FrameReader):
    """A reader whose camera "left" is out of focus and sees stray light on the person."""

    def __init__(self, reader, variance: float, stray: float):
        super().__init__(reader.capture, reader.occlusion)
        self.variance, self.stray = variance, stray

    def read(self, frames, camera_names):
        batch = super().read(frames, camera_names)
        is_left = torch.tensor([float(name == "left") for names in camera_names for name in names])
        images = diffused(batch.images + self.stray * is_left[:, None, None, None] * batch.masks, self.variance * is_left)
        return dataclasses.replace(batch, images=images)


def test_training_tells_a_camera_that_is_out_of_focus(make_trainer, reader, tmp_path):
    """Blur goes to the camera that has it; the checkpoint keeps it, and one of other cells is refused."""
    words = ("camera_response.blur=true", "camera_response.bias=true", "camera_response.learning_rate=0.02", "training.iterations=16")
    trainer = make_trainer(*words, "camera_response.identity_camera=front", "loss.kl=0", reader=BlurredReader(reader, 1.5, 0.1))
    trainer.run(lambda iteration, terms: True)
    facts = trainer.response.facts()
    others = [facts[name]["blur_pixels"] for name in facts if name != "left"]
    assert facts["left"]["blur_pixels"] > max(others) + 0.1 and facts["front"]["blur_pixels"] == 0
    assert np.mean(facts["left"]["mean_bias"]) > max(np.mean(facts[name]["mean_bias"]) for name in facts if name != "left")
    checkpoints = Checkpoints(tmp_path / "checkpoints", "rig")
    trainer.save(checkpoints, None)
    trainer.response.write_facts(tmp_path / "facts.json")
    assert json.loads((tmp_path / "facts.json").read_text()) == facts
    again = make_trainer(*words, "camera_response.identity_camera=front", reader=reader)
    again.resume(checkpoints)
    torch.testing.assert_close(again.response.state_dict(), trainer.response.state_dict(), rtol=0, atol=0)
    other = make_trainer(*words, "camera_response.bias_cells=4", reader=reader)
    with pytest.raises(ValueError, match="expected a checkpoint with the response of .*Resume with the cameras"):
        other.resume(checkpoints)


def test_a_response_that_is_off_is_not_there(make_trainer):
    assert make_trainer().response is None
    assert make_trainer("camera_response.blur=true", "loss.image=0", "loss.mask=0").response is None
