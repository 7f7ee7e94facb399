"""Decoder: shapes of every preset, locality of the driving signal, reach of the latent code, the split view layer."""

import dataclasses

import pytest
import torch
from torch.nn import functional

from mitsuba_avatar.model.decoder import VIEW_COORDINATES, Decoder, ViewBranch
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.settings import ModelSettings

SMALL = ModelSettings(
    latent_size=3,
    conditioning_size=8,
    latent_channels=(4, 3),
    pose_embedding_channels=3,
    face_embedding_channels=2,
    decoder_channels=(4,),
    geometry_channels=(3,),
    geometry_size=16,
    texture_channels=(4,),
    texture_size=32,
    view_channels=(3, 4),
    view_size=16,
)


def make_decoder(settings: ModelSettings, pose_masks: torch.Tensor, face_masks: torch.Tensor) -> Decoder:
    """A decoder whose zero-initialised parameters are filled."""
    torch.manual_seed(0)
    decoder = Decoder(settings, pose_masks, face_masks)
    for parameter in decoder.parameters():
        if not parameter.any():
            torch.nn.init.normal_(parameter, std=0.3)
    return decoder


@pytest.mark.parametrize("preset", ["tiny", "default", "paper"])
def test_shapes_of_every_preset(preset):
    settings = resolve(preset).model
    size = settings.conditioning_size
    with torch.device("meta"):  # the paper's size needs shapes only, no memory
        decoder = Decoder(settings, torch.ones(100, size, size), torch.ones(60, size, size))
        view = torch.ones(2, 3, VIEW_COORDINATES, settings.view_size, settings.view_size)
        maps = decoder(torch.ones(2, 100), torch.ones(2, 60), torch.ones(2, settings.latent_size), view)
    assert maps.displacement.shape == (2, 3, settings.geometry_size, settings.geometry_size)
    assert maps.texture.shape == (2, 3, settings.texture_size, settings.texture_size)
    assert maps.view_texture.shape == (2, 3, 3, settings.view_size, settings.view_size)


def test_the_paper_preset_has_the_papers_sizes():
    settings = resolve("paper").model
    assert (settings.latent_size, settings.conditioning_size, settings.texture_size, settings.shadow_size) == (512, 32, 1024, 256)


def test_the_last_width_is_repeated_where_a_size_asks_for_more():
    decoder = Decoder(dataclasses.replace(SMALL, texture_size=128), torch.ones(2, 8, 8), torch.ones(1, 8, 8))
    assert decoder.texture.widths == [4, 4, 4, 4]
    same_size = Decoder(dataclasses.replace(SMALL, geometry_size=8), torch.ones(2, 8, 8), torch.ones(1, 8, 8))
    assert same_size.geometry(torch.randn(2, 4, 8, 8))[0].shape == (2, 3, 8, 8)


def test_an_angle_changes_maps_only_within_the_receptive_field_of_its_mask():
    masks = torch.zeros(2, 8, 8)
    masks[0, 1:3, 5:7], masks[1, 6, 1] = 1, 1
    decoder = make_decoder(SMALL, masks, torch.ones(1, 8, 8))
    face, z, view = torch.randn(2, 1), torch.randn(2, 3), torch.randn(2, 3, VIEW_COORDINATES, 16, 16)
    theta = torch.randn(2, 2)
    before, after = decoder(theta, face, z, view), decoder(theta + torch.tensor([1.0, 0.0]), face, z, view)
    # One 3x3 convolution at 8x8 and one or two transposed 4x4 ones widen the region by less than 3 texels of the conditioning map;
    # the view branch adds three 3x3 convolutions at 16x16, that is 1.5 more.
    for name, radius in (("displacement", 2), ("texture", 2), ("view_texture", 4)):
        difference = (getattr(after, name) - getattr(before, name)).abs().flatten(0, -3).amax(0)  # [size, size]
        reach = functional.max_pool2d(masks[:1], 2 * radius + 1, stride=1, padding=radius)[0]
        allowed = functional.interpolate(reach[None, None], size=difference.shape)[0, 0] > 0
        assert not difference[~allowed].any(), name
        assert (~allowed).any(), name
        inside = functional.interpolate(masks[None, :1], size=difference.shape)[0, 0] > 0
        assert difference[inside].all(), name


def test_a_trunk_of_single_texels_keeps_an_angle_to_half_a_cell_around_its_mask():
    """Two 3x3 convolutions carry it two cells on; two of one texel leave the doublings alone, which reach less than one cell."""
    masks = torch.zeros(2, 8, 8)
    masks[0, 1:3, 4:6], masks[1, 6, 1] = 1, 1
    cells = {}
    for kernel in (1, 3):
        settings = dataclasses.replace(SMALL, decoder_channels=(4, 5), decoder_kernel=kernel)
        decoder = make_decoder(settings, masks, torch.ones(1, 8, 8))
        theta, face, z = torch.randn(2, 2), torch.randn(2, 1), torch.randn(2, 3)
        moved = decoder.displacement(theta + torch.tensor([1.0, 0.0]), face, z) != decoder.displacement(theta, face, z)
        rows, columns = (torch.nonzero(moved.flatten(0, 1).any(0).any(axis))[:, 0] for axis in (1, 0))
        cells[kernel] = [int(rows.min()), int(rows.max()), int(columns.min()), int(columns.max())]
    assert cells == {1: [1, 6, 7, 12], 3: [0, 10, 3, 15]}, "texels of 16x16; the mask covers 2..5 and 8..11"


def test_the_latent_code_reaches_every_texel():
    decoder = make_decoder(SMALL, torch.ones(2, 8, 8), torch.ones(1, 8, 8))
    view = torch.randn(2, 1, VIEW_COORDINATES, 16, 16)
    arguments = torch.randn(2, 2), torch.randn(2, 1)
    before, after = decoder(*arguments, torch.zeros(2, 3), view), decoder(*arguments, torch.ones(2, 3), view)
    assert (after.texture != before.texture).any(1).all()
    assert (after.displacement != before.displacement).any(1).all()


def test_splitting_the_first_view_layer_changes_nothing():
    torch.manual_seed(0)
    branch = ViewBranch(5, SMALL)
    torch.nn.init.normal_(branch.last[0].weight)
    features, view = torch.randn(2, 5, 16, 16), torch.randn(2, 3, VIEW_COORDINATES, 16, 16)
    result = branch(features, view)
    weight = torch.cat([branch.from_features[0].weight, branch.from_view.weight], dim=1)
    for pose in range(2):
        for camera in range(3):
            joined = torch.cat([features[pose], view[pose, camera]])[None]
            hidden = functional.conv2d(joined, weight, padding=1)
            torch.testing.assert_close(result[pose, camera], branch.last(branch.hidden(hidden))[0], atol=1e-5, rtol=1e-4)


def test_cameras_do_not_influence_each_other_nor_the_common_maps():
    decoder = make_decoder(SMALL, torch.ones(2, 8, 8), torch.ones(1, 8, 8))
    arguments = torch.randn(2, 2), torch.randn(2, 1), torch.randn(2, 3)
    view = torch.randn(2, 3, VIEW_COORDINATES, 16, 16)
    moved = view.clone()
    moved[1, 2] += 1.0
    before, after = decoder(*arguments, view), decoder(*arguments, moved)
    assert torch.equal(before.texture, after.texture)
    assert torch.equal(before.displacement, after.displacement)
    changed = (before.view_texture != after.view_texture).flatten(2).any(2)
    assert changed.tolist() == [[False, False, False], [False, False, True]]


def test_gradients_equal_finite_differences():
    settings = dataclasses.replace(SMALL, conditioning_size=4, geometry_size=8, texture_size=8, view_size=4, shadow_channels=(2,))
    decoder = make_decoder(settings, torch.ones(2, 4, 4), torch.ones(1, 4, 4)).double()

    def outputs(*arguments):
        maps = decoder(*arguments)
        return maps.displacement, maps.texture, maps.view_texture

    shapes = ((2, 2), (2, 1), (2, 3), (2, 2, VIEW_COORDINATES, 4, 4))
    assert torch.autograd.gradcheck(
        outputs, [torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in shapes], fast_mode=True
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"view_size": 32}, "expected view_size to be at most half of texture_size (16); got 32"),
        ({"view_size": 4}, "expected view_size to be at least conditioning_size (8); got 4"),
        ({"texture_size": 8}, "expected texture_size to be at least twice conditioning_size (16); got 8"),
        ({"latent_channels": (4, 4, 4, 4, 4)}, "expected latent_channels to halve a map of 8 texels to no less than one"),
        ({"encoder_size": 4, "encoder_channels": (2, 2, 2)}, "expected encoder_channels to halve a map of 4 texels to no less than one"),
    ],
)
def test_sizes_that_do_not_fit_each_other_are_refused(changes, message):
    with pytest.raises(ValueError) as caught:
        dataclasses.replace(SMALL, **changes)
    assert message in str(caught.value)
