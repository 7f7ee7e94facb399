import mitsuba as mi
import numpy as np
import pytest

import mitsuba_avatar.filming.path_integrator  # noqa: F401 - registers `split_path`

WIDTH, HEIGHT = 24, 16


@pytest.fixture(scope="module")
def scene() -> mi.Scene:
    return _ball_under_dome()


def _ball_under_dome(**more: object) -> mi.Scene:
    """A glossy sphere that nearly touches a coloured floor, under a dome that is a little brighter on one side; and more things."""
    dome = np.full((8, 16, 3), 0.75, dtype=np.float32)
    dome[:, :8] = [1.0, 0.9, 0.8]
    return mi.load_dict(
        {
            "type": "scene",
            "dome": {"type": "envmap", "bitmap": mi.Bitmap(dome)},
            "ball": {
                "type": "sphere",
                "radius": 0.5,
                "bsdf": {
                    "type": "principled",
                    "base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]},
                    "main_specular_sampling_rate": 0.2,
                },
            },
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, -0.55, 0]).rotate([1, 0, 0], -90),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}},
            },
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "to_world": mi.ScalarTransform4f().look_at(origin=[0.8, 1.2, 3], target=[0, -0.1, 0], up=[0, 1, 0]),
                "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgba", "rfilter": {"type": "box"}},
                "sampler": {"type": "multijitter"},
            },
            **more,
        }
    )


def _render(scene: mi.Scene, kind: str, samples: int, seed: int = 0, **parameters: object) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": kind, **parameters}), spp=samples, seed=seed))


def test_it_agrees_with_mitsubas_path_tracer(scene: mi.Scene):
    """Both are unbiased estimates of the same light, indirect light included; paths of two and of four segments."""
    for depth in (2, 4):
        reference = _render(scene, "path", 4096, max_depth=depth, hide_emitters=True)
        ours = _render(scene, "split_path", 1024, seed=1, max_depth=depth, splits=3)
        difference = np.abs(ours - reference)
        assert difference[..., :3].mean() < 0.004 and difference[..., :3].max() < 0.05, f"depth {depth}: {difference.mean()}"
        np.testing.assert_allclose(ours[..., 3], reference[..., 3], atol=0.05)


def test_a_lamp_with_a_shape_is_seen_by_paths_that_end_at_it(scene: mi.Scene):
    """A black lamp that no path meets changes no bit, although the last segment's end is then looked for; a bright one above lights."""
    black, bright = (
        _ball_under_dome(
            lamp={
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], 90),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}},
            }
        )
        for height, radiance in ((-50, 0.0), (1.5, 6.0))
    )
    without = _render(scene, "split_path", 16, max_depth=3, splits=2)
    np.testing.assert_array_equal(_render(black, "split_path", 16, max_depth=3, splits=2), without)
    assert _render(bright, "split_path", 16, max_depth=3, splits=2)[..., :3].mean() > 1.1 * without[..., :3].mean()


def test_indirect_light_is_there(scene: mi.Scene):
    direct, indirect = (_render(scene, "split_path", 256, max_depth=depth, splits=2)[..., :3].mean() for depth in (2, 3))
    assert indirect > 1.03 * direct


def test_splits_lower_the_noise_and_keep_the_mean(scene: mi.Scene):
    reference = _render(scene, "split_path", 1024, seed=9, splits=4)
    few, many = (_render(scene, "split_path", 16, seed=2, splits=splits) for splits in (1, 8))
    noise = [((image - reference)[..., :3] ** 2).mean() for image in (few, many)]
    assert noise[1] < 0.6 * noise[0]
    assert abs(many[..., :3].mean() / reference[..., :3].mean() - 1) < 0.02


def test_it_is_less_noisy_than_the_stock_path_tracer_at_equal_samples(scene: mi.Scene):
    reference = _render(scene, "split_path", 2048, seed=9, splits=4)
    stock = _render(scene, "path", 16, max_depth=3, hide_emitters=True)
    ours = _render(scene, "split_path", 16, max_depth=3, splits=1)
    noise = [((image - reference)[..., :3] ** 2).mean() for image in (stock, ours)]
    assert noise[1] < noise[0]
