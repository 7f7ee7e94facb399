"""Pictures of a fit: the preview panel of one step, the comparison with the baselines, the curves of the log.

Images are display-encoded (sRGB), [H, W, 3] in 0..1, of any size: tiles are scaled to one height. Composition is numpy and Pillow,
quick enough for a training loop; only the curves need matplotlib.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.reporting.metrics import mse_in_mask, psnr_from_mse

_BACKGROUND = (24, 24, 28)
_TEXT = (235, 235, 235)
_GAP = 4  # pixels between tiles
_MAXIMUM_ERROR = 0.25  # display-encoded difference that the error map draws brightest


@dataclass(frozen=True)
class Tile:
    """One labelled picture of a figure."""

    label: str
    image: Float[np.ndarray, "H W 3"]  # display-encoded, 0..1


@dataclass(frozen=True)
class View:
    """What a camera saw: the picture that renders are held against."""

    label: str  # camera and frame
    image: Float[np.ndarray, "H W 3"]
    mask: Float[np.ndarray, "H W"]  # of the person; the PSNR in the labels is taken inside it


@dataclass(frozen=True)
class Preview:
    """What one step has to show for one view. A field that is None has no column."""

    view: View
    render: Float[np.ndarray, "H W 3"]
    mesh: Float[np.ndarray, "H W 3"] | None = None  # shaded without texture
    texture: Float[np.ndarray, "h w 3"] | None = None
    ambient_occlusion: Float[np.ndarray, "S S"] | None = None  # 1 where open
    shadow: Float[np.ndarray, "T T"] | None = None  # gain map, 1 where neutral


def error_map(
    image: Float[np.ndarray, "H W 3"], reference: Float[np.ndarray, "H W 3"], maximum: float = _MAXIMUM_ERROR
) -> Float[np.ndarray, "H W 3"]:
    """Absolute difference, mean over channels, as a heat map: black at 0, light yellow at `maximum` and above."""
    if image.shape != reference.shape:
        raise ValueError(
            f"error_map(): expected images of one size; got {image.shape} and {reference.shape}. Render at the capture's size."
        )
    return heat_map(np.abs(image - reference).mean(axis=-1), maximum)


def heat_map(values: Float[np.ndarray, "*shape"], maximum: float, colours: str = "inferno") -> Float[np.ndarray, "*shape 3"]:
    """Display-encoded colours of values: black at 0, brightest at `maximum` and above.

    Args:
        values: of any shape.
        maximum: above 0, in the values' unit.
        colours: a colour map of Matplotlib's.
    """
    return matplotlib.colormaps[colours](np.clip(values / maximum, 0, 1))[..., :3].astype(np.float32)


def preview_panel(previews: Sequence[Preview], height: int = 256) -> UInt8[np.ndarray, "h w 3"]:
    """One row a view: capture | render | error | mesh | texture | AO | shadow, each with its label.

    Args:
        previews: the views of one step.
        height: of every tile, in pixels.
    """
    return compose([_preview_tiles(preview) for preview in previews], height)


def comparison_grid(
    views: Sequence[View], methods: Mapping[str, Sequence[Float[np.ndarray, "H W 3"]]], height: int = 256
) -> UInt8[np.ndarray, "h w 3"]:
    """One row a view: the capture, then each method's picture and its error map.

    Args:
        views: N views of the capture.
        methods: name -> its N pictures of the same views, in the order of the columns: avatar, template, nearest frame.
        height: of every tile, in pixels.

    Raises:
        ValueError: if a method has more or fewer pictures than there are views.
    """
    for name, images in methods.items():
        if len(images) != len(views):
            raise ValueError(f"comparison_grid(): expected {len(views)} pictures of {name}; got {len(images)}. Render the same views.")
    rows = []
    for index, view in enumerate(views):
        row = [_capture_tile(view)]
        for name, images in methods.items():
            row += [Tile(name, images[index]), _error_tile(images[index], view)]
        rows.append(row)
    return compose(rows, height)


def compose(rows: Sequence[Sequence[Tile]], height: int = 256) -> UInt8[np.ndarray, "h w 3"]:
    """Set labelled tiles in columns; every tile gets one height, every column the width of its widest tile."""
    if not rows or not all(rows):
        raise ValueError(f"compose(): expected rows of tiles; got {[len(row) for row in rows]} tiles. Give each row one.")
    font = ImageFont.load_default(max(11, height // 18))
    bar = math.ceil(font.size * 1.5)
    scaled = [[_scaled(tile.image, height) for tile in row] for row in rows]
    widths = []
    for index in range(max(map(len, rows))):
        cells = [(row[index].label, pictures[index].width) for row, pictures in zip(rows, scaled, strict=True) if index < len(row)]
        widths.append(max(max(width, math.ceil(font.getlength(label)) + 2 * _GAP) for label, width in cells))
    canvas = Image.new("RGB", (sum(widths) + _GAP * (len(widths) + 1), (bar + height + _GAP) * len(rows) + _GAP), _BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    for line, (row, pictures) in enumerate(zip(rows, scaled, strict=True)):
        left, top = _GAP, _GAP + line * (bar + height + _GAP)
        for tile, picture, width in zip(row, pictures, widths, strict=False):  # a short row leaves its last columns empty
            draw.text((left + width / 2, top + bar / 2), tile.label, fill=_TEXT, font=font, anchor="mm")
            canvas.paste(picture, (left + (width - picture.width) // 2, top + bar))
            left += width + _GAP
    return np.array(canvas)


def loss_curves(path: Path | str, records: Sequence[Mapping[str, Any]], panels: Mapping[str, Sequence[str]]) -> None:
    """Draw curves over the iterations to a PNG, one panel below the other.

    Args:
        path: file to write.
        records: lines of the run's log; each has `iteration`, and any of the keys below.
        panels: heading with unit -> keys to draw in it. An axis is logarithmic where all its values are positive and span more
            than a factor of 20.

    Raises:
        ValueError: if no record has any of the keys.
    """
    # Figure rather than pyplot: no global state, no display, the Agg canvas for PNG.
    from matplotlib.figure import Figure

    curves = {heading: {key: _curve(records, key) for key in keys} for heading, keys in panels.items()}
    if not any(len(values) for group in curves.values() for _, values in group.values()):
        raise ValueError(
            f"loss_curves(): expected records with any of {[key for keys in panels.values() for key in keys]}; found none. Check the log."
        )
    figure = Figure(figsize=(9, 3.2 * len(curves)), layout="constrained")
    for axes, (heading, group) in zip(np.atleast_1d(figure.subplots(len(curves), 1, sharex=True)), curves.items(), strict=True):
        drawn = {key: curve for key, curve in group.items() if len(curve[1])}
        for key, (iterations, values) in drawn.items():
            axes.plot(iterations, values, label=key, linewidth=1.2, marker="o" if len(values) < 12 else None, markersize=3)
        smallest = min((values.min() for _, values in drawn.values()), default=0)
        if smallest > 0 and max(values.max() for _, values in drawn.values()) > 20 * smallest:
            axes.set_yscale("log")
        if drawn:
            axes.legend(fontsize="small", ncols=2)
        axes.set_title(heading, fontsize="medium", loc="left")
        axes.grid(alpha=0.3)
    axes.set_xlabel("iteration")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)


def save_image(path: Path | str, image: UInt8[np.ndarray, "H W 3"] | Float[np.ndarray, "H W 3"]) -> None:
    """Write a display-encoded picture, 0..255 integers or 0..1 floats, in the format of the file's ending; whole or not at all."""
    with atomic_path(path) as temporary:
        Image.fromarray(to_bytes(image)).save(temporary)


def to_bytes(image: UInt8[np.ndarray, "*shape"] | Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """0..1 floats to 0..255 integers, rounded; values outside are cut, and what is not a number turns black."""
    if image.dtype == np.uint8:
        return image
    return np.round(255 * np.clip(np.nan_to_num(image), 0, 1)).astype(np.uint8)


def _preview_tiles(preview: Preview) -> list[Tile]:
    tiles = [_capture_tile(preview.view), Tile("render", preview.render), _error_tile(preview.render, preview.view)]
    if preview.mesh is not None:
        tiles.append(Tile("mesh", preview.mesh))
    if preview.texture is not None:
        tiles.append(Tile("texture", preview.texture))
    if preview.ambient_occlusion is not None:
        tiles.append(Tile("AO", _grey(preview.ambient_occlusion)))
    if preview.shadow is not None:
        tiles.append(Tile(f"shadow {preview.shadow.min():.2f}..{preview.shadow.max():.2f}", _grey(preview.shadow / 2)))  # 1 is mid-grey
    return tiles


def _capture_tile(view: View) -> Tile:
    return Tile(f"capture {view.label}", view.image)


def _error_tile(image: np.ndarray, view: View) -> Tile:
    # A held-out camera may see nobody: then there is nothing to take a mean over.
    label = f"error, {psnr_from_mse(mse_in_mask(image, view.image, view.mask)):.1f} dB" if view.mask.any() else "error, empty mask"
    return Tile(label, error_map(image, view.image))


def _grey(values: np.ndarray) -> np.ndarray:
    return np.repeat(values[..., None].astype(np.float32), 3, axis=-1)


def _scaled(image: np.ndarray, height: int) -> Image.Image:
    picture = Image.fromarray(to_bytes(image))
    if picture.height == height:
        return picture
    # Whole multiples keep texels visible as squares; anything else is resampled.
    sampling = Image.Resampling.NEAREST if height % picture.height == 0 else Image.Resampling.LANCZOS
    return picture.resize((max(1, round(picture.width * height / picture.height)), height), sampling)


def _curve(records: Sequence[Mapping[str, Any]], key: str) -> tuple[np.ndarray, np.ndarray]:
    points = [(record["iteration"], record[key]) for record in records if record.get(key) is not None]
    return tuple(np.array(points, dtype=np.float64).reshape(-1, 2).T)
