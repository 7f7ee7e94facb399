"""Plates and masks on a drawn video: a striped figure walks past a textured wall, and a bystander moves beside it."""

import numpy as np
import pytest

from mitsuba_avatar.registration.background import background_plate
from mitsuba_avatar.registration.foreground import bands_of, foreground_mask, soft_mask, widened

HEIGHT, WIDTH, FRAMES = 96, 72, 15


def figure(frame: int, grow: float = 0.0, shift: float = 0.0) -> np.ndarray:
    """[H, W] True on the walker: a tall ellipse."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    return ((x - 18 - 2.5 * frame - shift) / (8 + grow)) ** 2 + ((y - 50) / (34 + grow)) ** 2 < 1


def picture(frame: int) -> np.ndarray:
    rng = np.random.default_rng(frame)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    image = np.stack([120 + 40 * np.sin(x / 5), 110 + 30 * np.cos(y / 7), 100 + 0 * x], axis=-1)
    image[60:80, 60 + frame % 3 : 68 + frame % 3] = (30, 40, 160)  # somebody fidgets in the background
    image[figure(frame)] = (200, 90, 60)
    image[figure(frame) & (y % 12 < 6)] = (60, 160, 60)
    return (image + rng.normal(0, 2, image.shape)).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def plate() -> tuple[np.ndarray, np.ndarray]:
    covered = [widened(figure(frame), 5) for frame in range(FRAMES)]
    return background_plate([picture(frame) for frame in range(FRAMES)], covered)


def test_the_plate_shows_the_wall_without_a_ghost(plate):
    pixels, is_known = plate
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    wall = np.stack([120 + 40 * np.sin(x / 5), 110 + 30 * np.cos(y / 7), 100 + 0 * x], axis=-1)
    wall[60:80, 61:69] = (30, 40, 160)
    still = is_known.copy()
    still[60:80, 58:72] = False
    assert is_known.mean() > 0.9
    assert np.abs(pixels - wall)[still].max() < 8


def test_a_plain_median_would_keep_a_ghost_of_somebody_slow():
    """Somebody who covers a pixel in most frames: the plate knows better."""
    frames = [np.full((40, 40, 3), 200 if index < 10 else 50, np.uint8) for index in range(15)]
    covered = [np.full((40, 40), index < 10) for index in range(15)]
    covered[0][:, :20] = covered[3][:, :20] = True
    pixels, is_known = background_plate(frames, covered)
    assert is_known.all() and (pixels == 50).all() and (np.median(frames, axis=0) == 200).all()


def test_what_is_always_covered_is_unknown_and_filled():
    frames = [np.full((40, 40, 3), 90, np.uint8)] * 8
    covered = [np.zeros((40, 40), bool) for _ in range(8)]
    for mask in covered:
        mask[10:20, 10:20] = True
    frames = [np.where(mask[..., None], np.uint8(255), frame) for frame, mask in zip(frames, covered, strict=True)]
    pixels, is_known = background_plate(frames, covered)
    assert (~is_known).sum() == 100 and np.abs(pixels[10:20, 10:20].astype(int) - 90).max() < 3


def test_a_body_that_hides_everything_is_refused():
    with pytest.raises(ValueError, match="covers the whole image"):
        background_plate([np.zeros((8, 9, 3), np.uint8)] * 5, [np.ones((8, 9), bool)] * 5)


@pytest.mark.parametrize(("grow", "shift"), [(0.0, 2.0), (-2.0, 0.0), (2.0, -1.0)])
def test_the_mask_is_the_figure_though_the_projection_is_off(plate, grow, shift):
    frame = 7
    body, truth = figure(frame, grow, shift), figure(frame)
    mask = foreground_mask(picture(frame), *plate, body, bands_of(body, 0.08, 0.05))
    overlap, before = (float((given & truth).sum() / (given | truth).sum()) for given in (mask, body))
    assert overlap > 0.95 and overlap > before + 0.03


def test_the_bystander_stays_out(plate):
    frame = 3
    body = figure(frame)
    mask = foreground_mask(picture(frame), *plate, body, bands_of(body, 0.08, 0.05))
    assert not mask[60:80, 60:72].any()


def test_nobody_in_view_gives_an_empty_mask(plate):
    nobody = np.zeros((HEIGHT, WIDTH), bool)
    assert not foreground_mask(picture(0), *plate, nobody, bands_of(nobody, 0.1, 0.05)).any()


def test_soft_edges_keep_the_area():
    mask = figure(4)
    soft = soft_mask(mask)
    assert soft.dtype == np.float32 and soft.min() >= 0 and soft.max() <= 1 and ((soft > 0.01) & (soft < 0.99)).any()
    assert soft.sum() == pytest.approx(mask.sum(), rel=0.02)
