"""Image files: formats, sizes, and every damage that must be noticed."""

import cv2
import numpy as np
import pytest
from PIL import Image

from mitsuba_avatar.captures.images import image_size, is_complete, read_image, read_mask, write_image, write_mask


def picture(dtype=np.uint8) -> np.ndarray:
    """A smooth 36x52 picture without symmetry, so that lossy formats come close."""
    y, x = np.mgrid[:36, :52]
    channels = np.stack([4 * x, 3 * y + x, 200 - 2 * x - y], axis=-1)
    return channels.astype(dtype) if dtype == np.uint8 else (channels / 100).astype(dtype)


@pytest.mark.parametrize(("extension", "tolerance"), [("png", 0), ("jpg", 6), ("avif", 10), ("exr", 0)])
def test_round_trip(tmp_path, extension, tolerance):
    pixels = picture(np.float32 if extension == "exr" else np.uint8)
    path = tmp_path / "new" / f"000001.{extension}"
    write_image(path, pixels)
    read = read_image(path)
    assert read.dtype == pixels.dtype and read.shape == (36, 52, 3)
    assert np.abs(read.astype(float) - pixels).max() <= tolerance
    assert image_size(path) == (52, 36) and is_complete(path)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name], "temporary files must not stay"


@pytest.mark.parametrize("extension", ["png", "jpg", "avif", "exr"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.7])
def test_truncated_files_are_noticed(tmp_path, extension, kept):
    path = tmp_path / f"a.{extension}"
    write_image(path, picture(np.float32 if extension == "exr" else np.uint8))
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    assert not is_complete(path)
    with pytest.raises(ValueError, match=rf"a whole image in .*a.{extension}; got {int(kept * len(content))} bytes.*export it again"):
        read_image(path)


def test_masks_and_other_modes(tmp_path):
    mask = (np.arange(36 * 52).reshape(36, 52) % 256).astype(np.uint8)
    write_mask(tmp_path / "mask.png", mask)
    np.testing.assert_array_equal(read_mask(tmp_path / "mask.png"), mask)
    Image.fromarray(mask > 100).save(tmp_path / "binary.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "binary.png"), np.where(mask > 100, 255, 0))
    np.testing.assert_array_equal(read_image(tmp_path / "mask.png"), np.repeat(mask[..., None], 3, axis=2))
    Image.fromarray(np.dstack([picture(), mask])).save(tmp_path / "alpha.png")
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), picture())


def test_refusals(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected an image at .*none.png; got none. Restore the file"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("hello")
    for read in (read_image, image_size, read_mask):
        with pytest.raises(ValueError, match=r"a whole image in .*text.png; got 5 bytes: it is no image"):
            read(tmp_path / "text.png")
    (tmp_path / "text.exr").write_text("hello")
    with pytest.raises(ValueError, match=r"a whole image in .*text.exr; got 5 bytes"):
        image_size(tmp_path / "text.exr")
    Image.fromarray(np.zeros((4, 6), np.uint16)).save(tmp_path / "deep.png")
    with pytest.raises(ValueError, match=r"8 bits a channel of grey or RGB in .*deep.png; got Pillow mode 'I;16'"):
        read_mask(tmp_path / "deep.png")
    cv2.imwrite(str(tmp_path / "deep_colour.png"), np.full((4, 6, 3), 1000, np.uint16))  # Pillow calls it RGB
    with pytest.raises(ValueError, match=r"deep_colour.png; got Pillow mode 'RGB', 16 bits. Store deeper images"):
        read_image(tmp_path / "deep_colour.png")
    Image.new("CMYK", (6, 4)).save(tmp_path / "inks.jpg")
    with pytest.raises(ValueError, match=r"inks.jpg; got Pillow mode 'CMYK'.*CMYK as RGB"):
        read_image(tmp_path / "inks.jpg")
    with pytest.raises(ValueError, match="expected uint8 pixels for png, jpg and avif, float32 for exr; got float32"):
        write_image(tmp_path / "float.png", picture(np.float32))
    with pytest.raises(ValueError, match="got uint8 for .*a.bmp"):
        write_image(tmp_path / "a.bmp", picture())
