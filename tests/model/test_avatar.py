"""The avatar as a whole: neutral before training, each switch, invariance to the root, gradients, driving, round trips."""

import dataclasses

import pytest
import torch
from torch.nn import functional

from mitsuba_avatar.body.driving import driving_masks
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.settings import ModelSettings

MINIATURE = ModelSettings(
    latent_size=3,
    conditioning_size=8,
    latent_channels=(3, 3),
    pose_embedding_channels=3,
    face_embedding_channels=2,
    decoder_channels=(4,),
    geometry_channels=(3,),
    geometry_size=16,
    texture_channels=(3,),
    texture_size=16,
    view_channels=(3,),
    view_size=8,
    encoder_size=8,
    encoder_channels=(3, 4),
    shadow_channels=(2, 3),
)


def test_an_untrained_avatar_is_the_posed_template_with_the_mean_texture(make_avatar, drive):
    avatar = make_avatar(trained=False)
    output = avatar.decode(**drive, z=torch.randn(2, 16))
    assert torch.equal(output.vertices, avatar.pose_template(drive["theta"], drive["root"]))
    assert torch.equal(output.rest_vertices, avatar.template_vertices.expand(2, -1, -1))
    assert torch.equal(output.textures, avatar.mean_texture.expand(2, 3, -1, -1, -1))
    assert torch.equal(output.gain, torch.ones(2, 1, 16, 16))


def test_template_is_the_rig_plus_the_mean_displacement(rig, make_avatar):
    avatar = make_avatar()
    assert torch.equal(avatar.template_vertices, torch.from_numpy(rig.rest_vertices) + avatar.mean_displacement)
    assert avatar.mean_displacement.abs().max() > 0.005


def test_outputs_follow_the_stated_equations(make_avatar, drive):
    avatar, z = make_avatar(), torch.randn(2, 16)
    output = avatar.decode(**drive, z=z)
    posed_from_rest = avatar.skeleton(drive["theta"], drive["root"])
    maps = avatar.decoder(
        avatar.standardize_theta(drive["theta"]),
        avatar.standardize_face(drive["face"]),
        z,
        avatar.view_maps(posed_from_rest, drive["camera_centers"]),
    )
    displacement = avatar.atlas.vertices_from_texels(maps.displacement)
    torch.testing.assert_close(output.rest_vertices, avatar.template_vertices + 0.02 * displacement)
    gain = functional.interpolate(avatar.shadow(drive["ambient_occlusion"]), size=64, mode="bilinear")
    for pose in range(2):
        for camera in range(3):
            from_view = functional.interpolate(maps.view_texture[pose, camera][None], size=64, mode="bilinear")[0]
            texture = avatar.mean_texture + 0.2 * (maps.texture[pose] + from_view)
            texture = torch.where(texture > 0, texture, 0.01 * texture) * gain[pose]
            torch.testing.assert_close(output.textures[pose, camera], texture, atol=1e-6, rtol=1e-5)
    assert (output.textures < 0).any()  # the soft clamp was at work
    assert (output.gain - 1).abs().min() > 0.01  # so was the shadow


def test_the_root_moves_the_surface_and_nothing_else(make_avatar, drive):
    avatar, z = make_avatar(), torch.randn(2, 16)
    before = avatar.decode(**drive, z=z)
    motion = drive["root"].flip(0)  # another rigid motion for each pose
    centers = drive["camera_centers"] @ motion[:, :3, :3].transpose(1, 2) + motion[:, None, :3, 3]
    after = avatar.decode(**(drive | {"root": motion @ drive["root"], "camera_centers": centers}), z=z)
    assert torch.equal(after.rest_vertices, before.rest_vertices)
    carried = before.vertices @ motion[:, :3, :3].transpose(1, 2) + motion[:, None, :3, 3]
    torch.testing.assert_close(after.vertices, carried, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(after.textures, before.textures, atol=1e-4, rtol=1e-4)


def test_texture_depends_on_the_camera_relative_to_the_body(make_avatar, drive):
    avatar = make_avatar()
    before = avatar.decode(**drive, z=None)
    after = avatar.decode(**(drive | {"camera_centers": drive["camera_centers"].flip(1)}), z=None)
    torch.testing.assert_close(after.textures, before.textures.flip(1))
    assert not torch.allclose(after.textures, before.textures, atol=1e-3)
    assert torch.equal(after.vertices, before.vertices)


@pytest.mark.parametrize(("signal", "entry"), [("theta", 3), ("face", 4)])
def test_a_driving_signal_shapes_the_surface_only_near_its_region(rig, make_avatar, drive, signal, entry):
    """Ambient occlusion is held still: long-range effects are the shadow branch's business."""
    avatar = make_avatar(conditioning_size=32, geometry_size=64)
    changed = drive[signal].clone()
    changed[:, entry] += 0.7
    before, after = avatar.decode(**drive, z=None), avatar.decode(**(drive | {signal: changed}), z=None)
    moved = (after.rest_vertices - before.rest_vertices).abs().amax((0, 2))
    masks = driving_masks(rig, 32)
    mask = masks.theta[entry] if signal == "theta" else masks.face
    reach = functional.max_pool2d(mask[None], 5, stride=1, padding=2)[None]  # one convolution and one doubling: 2 texels
    allowed = avatar.atlas.vertices_from_texels(functional.interpolate(reach, size=64))[0, :, 0] > 0
    assert not moved[~allowed].any()
    assert (~allowed).sum() > 20
    assert (moved > 0).sum() > 30


def test_without_localization_an_angle_reaches_everything(make_avatar, drive):
    avatar = make_avatar(use_localization=False)
    theta = drive["theta"].clone()
    theta[:, 3] += 0.7
    before, after = avatar.decode(**drive, z=None), avatar.decode(**(drive | {"theta": theta}), z=None)
    assert (after.rest_vertices != before.rest_vertices).any(2).all()


def test_without_latent_code_there_is_no_encoder(make_avatar, drive):
    avatar = make_avatar(use_latent=False)
    assert avatar.encoder is None
    assert not any("latent" in name or "encoder" in name for name in avatar.state_dict())
    output, posterior = avatar(None, **drive, noise=None)
    assert posterior is None
    assert output.textures.shape == (2, 3, 3, 64, 64)
    with pytest.raises(ValueError, match=r"offset_maps\(\): expected an avatar with an encoder"):
        avatar.offset_maps(output.rest_vertices)
    with pytest.raises(ValueError, match="expected z = None"):
        avatar.decode(**drive, z=torch.zeros(2, 16))


def test_without_compression_signals_enter_as_they_are(make_avatar, drive):
    avatar = make_avatar(use_compression=False)
    assert (avatar.decoder.pose_signal.channels, avatar.decoder.face_signal.channels) == (5, 6)
    assert avatar.decode(**drive, z=None).textures.isfinite().all()


def test_without_shadow_ambient_occlusion_is_not_read(make_avatar, drive):
    avatar = make_avatar(use_shadow=False)
    output = avatar.decode(**(drive | {"ambient_occlusion": None}), z=None)
    assert torch.equal(output.gain, torch.ones(2, 1, 16, 16))
    assert torch.equal(output.textures, avatar.decode(**drive, z=None).textures)


@pytest.mark.parametrize("shape", [None, (2, 1, 8, 8)])
def test_missing_or_misshapen_ambient_occlusion_is_refused(make_avatar, drive, shape):
    wrong = None if shape is None else torch.ones(shape)
    with pytest.raises(ValueError, match=r"ambient_occlusion must be \[2, 1, 16, 16\]"):
        make_avatar().decode(**(drive | {"ambient_occlusion": wrong}), z=None)


def test_no_latent_code_means_zero(make_avatar, drive):
    avatar = make_avatar()
    assert torch.equal(avatar.decode(**drive, z=None).vertices, avatar.decode(**drive, z=torch.zeros(2, 16)).vertices)


def test_driving_takes_three_lines_and_no_encoder(rig, settings, make_avatar, drive):
    trained = make_avatar()
    state, expected = trained.state_dict(), trained.decode(**drive, z=None)
    avatar = Avatar(rig, settings, DrivingStatistics.neutral(rig, 6, settings.texture_size))
    avatar.load_state_dict(state)
    avatar.encoder = None
    output = avatar.decode(**drive, z=None)
    assert torch.equal(output.vertices, expected.vertices)
    assert torch.equal(output.textures, expected.textures)


def test_state_holds_weights_and_statistics_only_and_lies_contiguous(make_avatar):
    avatar = make_avatar()
    extra = set(avatar.state_dict()) - {name for name, _ in avatar.named_parameters()}
    statistics = {f"standardize_{signal}.{value}" for signal in ("theta", "face") for value in ("mean", "std")}
    assert extra == statistics | {"mean_texture", "mean_displacement"}
    assert all(value.is_contiguous() for value in avatar.state_dict().values())


def test_the_encoder_sees_the_unposed_offset_from_the_template(make_avatar, drive):
    avatar = make_avatar()
    offset = 0.01 * torch.randn(avatar.template_vertices.shape)
    posterior = avatar.encode((avatar.template_vertices + offset).expand(2, -1, -1))
    maps = avatar.encoder_atlas.texels_from_vertices(offset[None] / 0.02)
    torch.testing.assert_close(posterior.mu[:1], avatar.encoder(maps).mu, atol=1e-4, rtol=1e-4)


def test_training_pass_is_unpose_encode_sample_decode(make_avatar, drive):
    avatar, noise = make_avatar(), torch.randn(2, 16)
    registered = avatar.pose_template(drive["theta"], drive["root"]) + 0.01 * torch.randn(2, len(avatar.template_vertices), 3)
    unposed = avatar.unpose(registered, drive["theta"], drive["root"])
    maps = avatar.offset_maps(unposed)
    output, posterior = avatar(maps, **drive, noise=noise)
    expected = avatar.encode(unposed)
    z = expected.mu + torch.exp(0.5 * expected.logvar) * noise
    assert torch.equal(posterior.logvar, expected.logvar)
    torch.testing.assert_close(output.textures, avatar.decode(**drive, z=z).textures)
    assert torch.equal(avatar(maps, **drive, noise=None)[0].vertices, avatar.decode(**drive, z=expected.mu).vertices)
    with pytest.raises(ValueError, match="expected offset maps of registered vertices to encode; got None"):
        avatar(None, **drive, noise=noise)


def test_every_parameter_gets_a_gradient(make_avatar, drive):
    avatar = make_avatar()
    registered = avatar.pose_template(drive["theta"], drive["root"]) + 0.01 * torch.randn(2, len(avatar.template_vertices), 3)
    maps = avatar.offset_maps(avatar.unpose(registered, drive["theta"], drive["root"]))
    output, _ = avatar(maps, **drive, noise=torch.randn(2, 16))
    (output.textures.square().sum() + output.vertices.square().sum()).backward()
    assert [name for name, parameter in avatar.named_parameters() if parameter.grad is None or not parameter.grad.any()] == []


def test_same_weights_same_output(make_avatar, drive):
    first, second = (make_avatar().decode(**drive, z=None) for _ in range(2))
    assert torch.equal(first.textures, second.textures)
    assert torch.equal(first.vertices, second.vertices)


@pytest.mark.parametrize("wanted", ["theta", "root", "face", "z", "camera_centers", "ambient_occlusion"])
def test_gradients_equal_finite_differences(rig, drive, wanted):
    torch.manual_seed(0)
    avatar = Avatar(rig, MINIATURE, DrivingStatistics.neutral(rig, 6, 16)).double()
    for parameter in avatar.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    values = {name: value.double() for name, value in drive.items()} | {"z": torch.randn(2, 3, dtype=torch.float64)}
    values["ambient_occlusion"] = values["ambient_occlusion"][:, :, :4, :4].contiguous()
    weights = [torch.randn(shape, dtype=torch.float64) for shape in ((2, 258, 3), (2, 3, 3, 16, 16))]

    def value(argument: torch.Tensor) -> torch.Tensor:
        output = avatar.decode(**(values | {wanted: argument}))
        return 10 * (output.vertices * weights[0]).sum() + (output.textures * weights[1]).sum()

    argument = values[wanted].requires_grad_()
    value(argument).backward()
    direction = torch.randn_like(argument)
    step = 1e-6
    with torch.no_grad():
        numeric = (value(argument + step * direction) - value(argument - step * direction)) / (2 * step)
    assert float((argument.grad * direction).sum()) == pytest.approx(float(numeric), rel=1e-5)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("theta", torch.zeros(4)),
        ("mean_texture", torch.zeros(3, 32, 32)),
        ("mean_displacement", torch.zeros(9, 3)),
    ],
)
def test_statistics_of_another_rig_or_size_are_refused(rig, settings, field, value):
    changes = {"theta_mean": value, "theta_std": value} if field == "theta" else {field: value}
    statistics = dataclasses.replace(DrivingStatistics.neutral(rig, 6, 64), **changes)
    with pytest.raises(ValueError, match=rf"statistics\.{field}.* must be"):
        Avatar(rig, settings, statistics)


def test_statistics_with_nan_are_refused(rig, settings):
    statistics = dataclasses.replace(DrivingStatistics.neutral(rig, 6, 64), theta_std=torch.full((5,), float("nan")))
    with pytest.raises(ValueError, match=r"expected finite statistics\.theta_std"):
        Avatar(rig, settings, statistics)


def test_the_papers_full_size_decodes_with_the_right_shapes(rig, drive):
    settings = resolve("paper").model
    avatar = Avatar(rig, settings, DrivingStatistics.neutral(rig, 6, 1024)).to("meta")  # shapes without the arithmetic
    arguments = {name: value.to("meta") for name, value in drive.items()} | {"ambient_occlusion": torch.ones(2, 1, 256, 256, device="meta")}
    output, posterior = avatar(
        torch.ones(2, 3, settings.encoder_size, settings.encoder_size, device="meta"), **arguments, noise=torch.ones(2, 512, device="meta")
    )
    assert output.textures.shape == (2, 3, 3, 1024, 1024)
    assert output.gain.shape == (2, 1, 256, 256)
    assert output.vertices.shape == (2, 258, 3)
    assert posterior.mu.shape == (2, 512)


def test_rest_vertices_alone_are_those_of_the_whole_decoder(make_avatar, drive):
    """And need neither cameras nor occlusion; with and without a latent code."""
    z = torch.randn((2, 16), generator=torch.Generator().manual_seed(4))
    for avatar, code in ((make_avatar(), z), (make_avatar(), None), (make_avatar(use_latent=False), None)):
        rest_vertices = avatar.decode_rest_vertices(drive["theta"], drive["face"], code)
        torch.testing.assert_close(rest_vertices, avatar.decode(z=code, **drive).rest_vertices)
    assert (make_avatar().decode_rest_vertices(drive["theta"], drive["face"], z) - rest_vertices).abs().max() > 1e-4
    with pytest.raises(ValueError, match="model.use_latent is false"):
        avatar.decode_rest_vertices(drive["theta"], drive["face"], z)


def test_the_driving_signal_as_one_vector(make_avatar, drive):
    avatar = make_avatar()
    driving = avatar.standardized_driving(drive["theta"], drive["face"])
    assert driving.shape == (2, 5 + 6)
    torch.testing.assert_close(driving[:, 5:], avatar.standardize_face(drive["face"]))
