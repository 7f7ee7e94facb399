"""Effects of controls and spreads of codes, on decoders that are told what to move."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from mitsuba_avatar.analysis.effects import FACE, control_effects, liveliest_controls, shape_uncertainty, texture_uncertainty
from mitsuba_avatar.analysis.measures import Study
from mitsuba_avatar.analysis.regions import NEAR, with_surroundings
from mitsuba_avatar.body.driving import driving_regions
from mitsuba_avatar.body.uv import UvAtlas
from mitsuba_avatar.loaded_run import LoadedRun
from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")
ELBOW = 2


@pytest.fixture
def loaded(fitted_run: Path) -> LoadedRun:
    return LoadedRun.open(fitted_run)


@pytest.fixture
def study(loaded: LoadedRun) -> Study:
    return Study.of(loaded.avatar, loaded.run.rig, loaded.capture)


@pytest.fixture
def occlusion(loaded: LoadedRun) -> FrameOcclusion:
    return FrameOcclusion(loaded.occlusion(), loaded.run.rig, loaded.avatar.template_vertices, loaded.capture.theta)


def test_the_surroundings_of_a_region_are_measured_on_the_body(study: Study):
    region = driving_regions(study.rig).theta[ELBOW]
    near = with_surroundings(study.rig, region)
    assert region.any() and near[region].all() and not near.all()
    points = study.rig.rest_vertices
    gap = np.linalg.norm(points[near & ~region][:, None] - points[region][None], axis=-1).min(1)
    assert gap.max() <= NEAR


def test_an_effect_is_as_large_as_the_change_and_tells_what_lies_outside(
    study: Study, occlusion: FrameOcclusion, monkeypatch: pytest.MonkeyPatch
):
    region = with_surroundings(study.rig, driving_regions(study.rig).theta[ELBOW])
    inside, outside = np.flatnonzero(region)[:3], np.flatnonzero(~region)[:1]
    std = study.drive.theta[study.frames("train")][:, ELBOW].std()

    def leaking(theta, face, z):
        rest = study.avatar.template_vertices.repeat(len(theta), 1, 1)
        rest[:, torch.from_numpy(np.concatenate([inside, outside])), 1] += 0.01 * theta[:, [ELBOW]] / (2 * std)
        return rest

    def repainting(theta, root, face, z, centers, occlusion):
        assert z is None and occlusion.shape[0] == len(theta) == 1
        maps = colour * float(theta[0, ELBOW] / (2 * std))
        return SimpleNamespace(textures=maps.expand(1, 1, 3, *maps.shape))

    patch = np.zeros(study.rig.topology.num_vertices, np.float32)
    patch[np.concatenate([inside, outside])] = 0.4
    colour = UvAtlas(study.rig.topology, 64).texels_from_vertices(torch.from_numpy(patch)[None, :, None])[0, 0]
    monkeypatch.setattr(study.avatar, "decode_rest_vertices", leaking)
    monkeypatch.setattr(study.avatar, "decode", repainting)
    elbow, face = control_effects(study, [study.rig.dofs.names[ELBOW], FACE], occlusion)
    assert elbow.moved_mm[inside] == pytest.approx(10.0, rel=1e-3) and elbow.share_outside == pytest.approx(0.25, rel=1e-3)
    painted = UvAtlas(study.rig.topology, 64).vertices_from_texels(colour[None, None])[0, :, 0].numpy()
    assert elbow.recoloured == pytest.approx(painted, abs=1e-5) and painted.max() > 0
    assert elbow.share_recoloured_outside == pytest.approx(painted[~region].sum() / painted.sum(), rel=1e-3)
    assert 0.05 < elbow.share_recoloured_outside < 0.95
    assert face.share_outside == face.share_recoloured_outside == 0 and not face.moved_mm.any() and not face.recoloured.any()


def test_controls_are_the_angles_that_vary_most_one_a_joint_and_the_face(study: Study):
    names = liveliest_controls(study, count=2)
    std = study.drive.theta[study.frames("train")].std(0)
    assert names[0] == study.rig.dofs.names[int(std.argmax())] and names[-1] == FACE and len(names) == 3
    with pytest.raises(ValueError, match="expected names of pose angles or 'face'"):
        control_effects(study, ["left_wing"], None)


def test_spreads_are_those_of_the_decoder(study: Study, monkeypatch: pytest.MonkeyPatch):
    def spreading(theta, face, z):
        return study.avatar.template_vertices + 0.01 * z[:, None, :3]

    monkeypatch.setattr(study.avatar, "decode_rest_vertices", spreading)
    spread = shape_uncertainty(study, frame=9, samples=400)
    assert spread == pytest.approx(10 * np.sqrt(3), rel=0.1)


def test_texture_spread_is_a_map_and_asks_for_a_latent_code(study: Study, monkeypatch: pytest.MonkeyPatch):
    centers = torch.tensor([[1.0, -2.0, 1.0], [0.5, 2.0, 1.5]])
    size, open_everywhere = study.avatar.settings.texture_size, torch.ones(1, 1, *2 * [study.avatar.settings.shadow_size])
    spread = texture_uncertainty(study, 9, centers, open_everywhere, samples=3)
    assert spread.shape == (size, size) and (spread >= 0).all() and spread.max() > 0
    with pytest.raises(ValueError, match="use_latent is false"):
        monkeypatch.setattr(study.avatar, "settings", replace(study.avatar.settings, use_latent=False))
        shape_uncertainty(study, 9)
