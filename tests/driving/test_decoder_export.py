"""The exported decoder says what the package says."""

import dataclasses
import json

import pytest
import torch

from mitsuba_avatar.driving.decoder_export import FACTS, DrivenDecoder, example_inputs, export_decoder
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from tests.driving.conftest import LATENT_SIZE, MODEL


@pytest.mark.slow  # tracing takes seconds; the test of the command compares one file in any case
def test_outputs_of_the_file_equal_the_packages(avatar, rig, tmp_path):
    path = tmp_path / "decoder.pt2"
    export_decoder(avatar, rig, path, poses=2)
    loaded = torch.export.load(path, extra_files=(facts := {FACTS: ""}))
    for seed in (1, 2):
        inputs = example_inputs(avatar, 2, seed)
        with torch.no_grad():
            theirs = loaded.module()(*inputs)
            theta, root, face, z, center, share = inputs
            ours = avatar.decode(theta, root, face, z, center[:, None], share)
        torch.testing.assert_close(theirs[0], ours.vertices, atol=1e-6, rtol=0)
        torch.testing.assert_close(theirs[1], ours.textures[:, 0], atol=1e-6, rtol=0)
        assert theirs[0].std() > 0.01 and (theirs[1][0] - theirs[1][1]).abs().max() > 1e-3, "the comparison is of something"
    described = json.loads(facts[FACTS])
    assert described["arguments"]["z"] == [2, LATENT_SIZE] and described["results"]["texture"] == [2, 3, 32, 32]
    assert described["pose_angles"] == list(rig.dofs.names)


@pytest.mark.slow
def test_a_decoder_without_latent_code_or_shadow_is_exported_too(rig, tmp_path):
    settings = dataclasses.replace(MODEL, use_latent=False, use_shadow=False)
    avatar = Avatar(rig, settings, DrivingStatistics.neutral(rig, 3, 32)).eval()
    export_decoder(avatar, rig, tmp_path / "plain.pt2")
    inputs = example_inputs(avatar, 1)
    with torch.no_grad():
        theirs, ours = torch.export.load(tmp_path / "plain.pt2").module()(*inputs), DrivenDecoder(avatar)(*inputs)
    torch.testing.assert_close(theirs[0], ours[0], atol=1e-6, rtol=0)


def test_another_ending_is_refused(avatar, rig, tmp_path):
    with pytest.raises(ValueError, match="ends in .pt2"):
        export_decoder(avatar, rig, tmp_path / "decoder.onnx")
    assert not list(tmp_path.iterdir())
