"""Contact sheet of a reprojection check: images with the outlines of mask and projected mesh, as one PNG.

Orange is the projected mesh, blue the mask, white where both agree; the mesh's interior is tinted. Orange and blue stay apart for
colour-blind eyes.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw, ImageFont

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.silhouettes import outline, silhouette
from mitsuba_avatar.files import atomic_path

MESH_COLOUR = (255, 145, 20)
MASK_COLOUR = (40, 150, 255)
BOTH_COLOUR = (255, 255, 255)
CAPTION_HEIGHT = 22
MARGIN = 8
BACKGROUND = (24, 24, 26)


@dataclass(frozen=True)
class Tile:
    """One picture of the sheet: an image with its overlay, and what is written under it."""

    pixels: UInt8[np.ndarray, "H W 3"]
    caption: str
    is_suspicious: bool = False


def overlay(
    image: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None,
    camera: Camera,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    height: int = 384,
) -> UInt8[np.ndarray, "H W 3"]:
    """Draw the projected mesh and the mask over an image.

    Args:
        image: [h, w, 3] encoded for display.
        mask: [h, w] True on the person; None draws the mesh alone.
        camera: at the image's size.
        vertices: [V, 3] metres, world axes.
        faces: [F, 3].
        height: of the result in pixels; small images are enlarged, so that the outlines are finer than their pixels.
    """
    tile_camera = camera.resized(height / camera.height)
    size = (tile_camera.width, tile_camera.height)
    # Nearest neighbour when enlarging keeps pixels visible as squares, against which half a pixel can be judged.
    resampling = Image.Resampling.NEAREST if size[1] >= image.shape[0] else Image.Resampling.BOX
    pixels = np.array(Image.fromarray(image).resize(size, resampling))
    projected = silhouette(tile_camera, vertices, faces)
    tint = np.array(MESH_COLOUR, dtype=np.float32)
    pixels[projected] = (0.8 * pixels[projected] + 0.2 * tint).astype(np.uint8)
    mesh_outline = outline(projected)
    pixels[mesh_outline] = MESH_COLOUR
    if mask is not None:
        mask_outline = outline(np.array(Image.fromarray(mask).resize(size, Image.Resampling.NEAREST)))
        pixels[mask_outline] = MASK_COLOUR
        pixels[mask_outline & mesh_outline] = BOTH_COLOUR
    return pixels


def save_contact_sheet(path: Path | str, rows: list[list[Tile]], title: str) -> None:
    """Write tiles as one PNG, a row for each list, under a title and a legend.

    Raises:
        ValueError: if there is no tile.
    """
    if not rows or not all(rows):
        raise ValueError(f"save_contact_sheet(): expected tiles in every row; got {[len(row) for row in rows]}. Choose frames and cameras.")
    font = ImageFont.load_default(size=14)
    row_heights = [max(tile.pixels.shape[0] for tile in row) + CAPTION_HEIGHT + MARGIN for row in rows]
    width = MARGIN + max(sum(tile.pixels.shape[1] + MARGIN for tile in row) for row in rows)
    header = 2 * CAPTION_HEIGHT + MARGIN
    width = max(width, round(font.getlength(title)) + 2 * MARGIN, 420)
    sheet = Image.new("RGB", (width, header + sum(row_heights)), BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, 4), title, font=font, fill=(235, 235, 235))
    x = MARGIN
    for label, colour in (("projected mesh", MESH_COLOUR), ("mask", MASK_COLOUR), ("both", BOTH_COLOUR)):
        draw.rectangle((x, CAPTION_HEIGHT + 8, x + 12, CAPTION_HEIGHT + 20), fill=colour)
        draw.text((x + 18, CAPTION_HEIGHT + 4), label, font=font, fill=(200, 200, 200))
        x += 36 + round(font.getlength(label))
    y = header
    for row, row_height in zip(rows, row_heights, strict=True):
        x = MARGIN
        for tile in row:
            sheet.paste(Image.fromarray(tile.pixels), (x, y))
            fill = MESH_COLOUR if tile.is_suspicious else (200, 200, 200)
            draw.text((x, y + tile.pixels.shape[0] + 2), tile.caption, font=font, fill=fill)
            x += tile.pixels.shape[1] + MARGIN
        y += row_height
    with atomic_path(path) as temporary:
        sheet.save(temporary)
