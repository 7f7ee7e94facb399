"""Results of stages: read back while nothing changed, made again otherwise."""

import numpy as np

from mitsuba_avatar.registration.settings import PoseSettings
from mitsuba_avatar.registration.stage_folder import StageFolder, stage_key


def test_a_stage_runs_once_for_each_key(tmp_path):
    stages, calls = StageFolder(tmp_path), []

    def make() -> dict[str, np.ndarray]:
        calls.append(1)
        return {"values": np.arange(3.0) + len(calls)}

    for key, expected in (("a", 1), ("a", 1), ("b", 2), ("a", 3)):
        assert stages.arrays("fit", key, make)["values"][0] == expected
    assert len(calls) == 3


def test_a_damaged_result_is_made_again(tmp_path):
    stages = StageFolder(tmp_path)
    stages.arrays("fit", "a", lambda: {"values": np.zeros(3)})
    whole = (tmp_path / "fit.npz").read_bytes()
    (tmp_path / "fit.npz").write_bytes(whole[: len(whole) // 2])
    assert stages.arrays("fit", "a", lambda: {"values": np.ones(3)})["values"].all()


def test_what_a_stage_leaves_elsewhere_is_marked(tmp_path):
    stages = StageFolder(tmp_path)
    assert not stages.is_done("frames", "a")
    stages.mark_done("frames", "a")
    assert stages.is_done("frames", "a") and not stages.is_done("frames", "b")


def test_keys_tell_settings_apart():
    assert stage_key(PoseSettings()) == stage_key(PoseSettings()) != stage_key(PoseSettings(iterations=7))
