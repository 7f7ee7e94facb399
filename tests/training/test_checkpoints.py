"""Checkpoints are whole or absent: what a full disk, a cut file or another rig does to them."""

import errno
import os

import pytest
import torch
from safetensors.torch import save_file

from mitsuba_avatar.training.checkpoints import CheckpointIndex, Checkpoints
from tests.full_disk import full_disk

FINGERPRINT = "0123456789abcdef"


def state(value: float) -> dict[str, torch.Tensor]:
    return {"weight": torch.full((300, 50), value), "view": torch.arange(12.0).view(3, 4).t(), "empty": torch.zeros(0)}


def training_state(value: float, size: int = 1000) -> dict:
    parameter = torch.nn.Parameter(torch.ones(size))
    optimizer = torch.optim.Adam([parameter], lr=value)
    (parameter.sum() * value).backward()
    optimizer.step()
    return {"optimizer": optimizer.state_dict()}


@pytest.fixture
def checkpoints(tmp_path):
    return Checkpoints(tmp_path / "checkpoints", FINGERPRINT)


def names(checkpoints):
    return sorted(path.name for path in checkpoints.folder.iterdir())


def test_what_was_saved_comes_back(checkpoints):
    """A transposed tensor too: safetensors stores no strides."""
    checkpoints.save(state(0.25), training_state(0.5), 20, 21.5)
    for which in ("last", "best"):
        loaded = checkpoints.load_avatar(which)
        assert loaded.keys() == state(0).keys()
        for name, value in state(0.25).items():
            torch.testing.assert_close(loaded[name], value, rtol=0, atol=0)
    iteration, training = checkpoints.load_training()
    assert iteration == 20 and training["optimizer"]["param_groups"][0]["lr"] == 0.5
    torch.testing.assert_close(training["optimizer"]["state"][0]["exp_avg"], training_state(0.5)["optimizer"]["state"][0]["exp_avg"])


def test_last_and_best_are_kept_and_others_are_removed(checkpoints):
    for iteration, psnr in ((10, 20.0), (20, 24.0), (30, None), (40, 23.0)):
        checkpoints.save(state(iteration), training_state(1.0), iteration, psnr)
    assert checkpoints.index() == CheckpointIndex(last=40, best=20, best_psnr=24.0)
    assert names(checkpoints) == [
        "avatar_000020.safetensors",
        "avatar_000040.safetensors",
        "checkpoints.json",
        "training_000020.pt",
        "training_000040.pt",
    ]
    assert float(checkpoints.load_avatar("best")["weight"][0, 0]) == 20 and float(checkpoints.load_avatar("last")["weight"][0, 0]) == 40
    checkpoints.save(state(50), training_state(1.0), 50, 25.0)
    assert checkpoints.index() == CheckpointIndex(50, 50, 25.0) and len(names(checkpoints)) == 3


def test_without_a_validation_the_last_is_the_best(checkpoints):
    checkpoints.save(state(1), training_state(1.0), 1, None)
    checkpoints.save(state(2), training_state(1.0), 2, None)
    assert checkpoints.index() == CheckpointIndex(2, 2, None)
    checkpoints.save(state(3), training_state(1.0), 3, 11.0)
    checkpoints.save(state(4), training_state(1.0), 4, None)
    assert checkpoints.index() == CheckpointIndex(4, 3, 11.0)


@pytest.mark.parametrize(
    ("free_bytes", "size"),
    [pytest.param(20_000, 1000, id="weights"), pytest.param(70_000, 40_000, id="optimizer"), pytest.param(20, 1, id="nothing-fits")],
)
def test_a_disk_that_fills_up_leaves_the_old_checkpoint(checkpoints, free_bytes, size):
    """The write fails in its middle, in Rust or C++, which raise errors of their own."""
    checkpoints.save(state(0.25), training_state(0.5), 20, 21.5)
    before = names(checkpoints)
    with (
        full_disk(free_bytes),
        pytest.raises(
            OSError, match=r"save\(\): expected room .* iteration 40 in .*checkpoints; got: .*the one of iteration 20 is kept"
        ) as caught,
    ):
        checkpoints.save(state(0.75), training_state(0.5, size), 40, 30.0)
    assert "\n" not in str(caught.value)
    assert checkpoints.index() == CheckpointIndex(20, 20, 21.5)
    assert float(checkpoints.load_avatar("last")["weight"][0, 0]) == 0.25 and checkpoints.load_training()[0] == 20
    assert set(before) <= set(names(checkpoints)) <= {*before, "avatar_000040.safetensors"}, "no temporary file stays"
    checkpoints.save(state(0.5), training_state(0.5), 60, 31.0)
    assert names(checkpoints) == ["avatar_000060.safetensors", "checkpoints.json", "training_000060.pt"], "leavings are swept up later"


def test_no_space_left_on_device(checkpoints, monkeypatch):
    """The error that Python itself raises, after half of the file was written."""

    def save_half(tensors, path, metadata):
        save_file(tensors, path, metadata=metadata)
        os.truncate(path, path.stat().st_size // 2)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    checkpoints.save(state(0.25), training_state(0.5), 20, None)
    before = names(checkpoints)
    monkeypatch.setattr("mitsuba_avatar.training.checkpoints.save_file", save_half)
    with pytest.raises(OSError, match="No space left on device. Free disk space, then --resume: the one of iteration 20 is kept"):
        checkpoints.save(state(0.75), training_state(0.5), 40, None)
    assert names(checkpoints) == before
    assert float(checkpoints.load_avatar()["weight"][0, 0]) == 0.25


def test_a_checkpoint_of_another_rig_is_refused(checkpoints):
    checkpoints.save(state(1), training_state(1.0), 20, None)
    with pytest.raises(
        ValueError, match=r"avatar_000020\.safetensors was trained on another rig \(fingerprint 0123456789ab, this rig has ffff"
    ):
        Checkpoints(checkpoints.folder, "f" * 16).load_avatar()


def test_foreign_weights_without_a_fingerprint_are_refused(checkpoints):
    checkpoints.save(state(1), training_state(1.0), 20, None)
    save_file({"weight": torch.zeros(2)}, checkpoints.folder / "avatar_000020.safetensors")
    with pytest.raises(ValueError, match=r"trained on another rig \(fingerprint unknown"):
        checkpoints.load_avatar()


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_cut_files_are_named(checkpoints, share):
    checkpoints.save(state(1), training_state(1.0), 20, None)
    for name in ("avatar_000020.safetensors", "training_000020.pt"):
        path = checkpoints.folder / name
        path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(ValueError, match=r"load_avatar\(\): .*avatar_000020\.safetensors cannot be read: .+ Restore it"):
        checkpoints.load_avatar()
    with pytest.raises(ValueError, match=r"load_training\(\): .*training_000020\.pt cannot be read: .+ Restore it") as caught:
        checkpoints.load_training()
    assert "\n" not in str(caught.value)


def test_a_checkpoint_cannot_run_code(checkpoints):
    """An optimizer state that pickles a function is refused unread."""
    checkpoints.save(state(1), training_state(1.0), 20, None)
    torch.save({"optimizer": os.system}, checkpoints.folder / "training_000020.pt")
    with pytest.raises(ValueError, match=r"training_000020\.pt cannot be read: Weights only load failed"):
        checkpoints.load_training()


def test_a_damaged_index_is_named(checkpoints):
    checkpoints.save(state(1), training_state(1.0), 20, None)
    for text in ('{"last": 20, "be', '{"latest": 20}', "[]"):
        (checkpoints.folder / "checkpoints.json").write_text(text)
        with pytest.raises(ValueError, match=r"expected last, best and best_psnr in .*checkpoints\.json; got"):
            checkpoints.load_avatar()


def test_a_run_without_a_checkpoint_says_so(checkpoints):
    assert checkpoints.index() is None
    with pytest.raises(FileNotFoundError, match=r"no checkpoint in .*checkpoints\. Start the fit again without --resume"):
        checkpoints.load_training()
