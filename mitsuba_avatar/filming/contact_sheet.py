"""One picture that shows a whole capture: all cameras at one moment, then moments of every take from two cameras."""

from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.files import atomic_path

COLUMNS = 13
CAPTION = 14  # pixels under each picture
TALLEST = 256  # pixels; larger images are shown smaller


def save_contact_sheet(capture: Capture, path: Path) -> None:
    """Draw the sheet and write it as PNG, whole or not at all."""
    names = list(capture.cameras)
    middle = len(capture.frames) // 2
    rows = [[(name, middle) for name in names[start : start + COLUMNS]] for start in range(0, len(names), COLUMNS)]
    spread = np.unique(np.linspace(0, len(capture.frames) - 1, 2 * COLUMNS).round().astype(int)).tolist()
    shown = [names[0], *capture.description.held_out_cameras[-1:]]
    rows += [[(name, index) for index in spread[start : start + COLUMNS]] for name in shown for start in range(0, len(spread), COLUMNS)]
    pictures = [[_captioned(capture, name, index) for name, index in row] for row in rows]
    width = max(sum(picture.shape[1] for picture in row) for row in pictures)
    lines = [np.concatenate(row, axis=1) for row in pictures]
    padded = [np.pad(line, ((0, 0), (0, width - line.shape[1]), (0, 0))) for line in lines]
    with atomic_path(path) as temporary:
        Image.fromarray(np.concatenate(padded)).save(temporary)


def _captioned(capture: Capture, name: str, index: int) -> UInt8[np.ndarray, "H W 3"]:
    """An image with camera, frame and split under it."""
    image = Image.fromarray(capture.encoded_image(name, index))
    if image.height > TALLEST:
        image = image.resize((max(1, round(image.width * TALLEST / image.height)), TALLEST), Image.Resampling.BOX)
    picture = Image.new("RGB", (image.width, image.height + CAPTION))
    picture.paste(image)
    frame = capture.frames[index]
    font = ImageFont.load_default(size=10)
    ImageDraw.Draw(picture).text((3, image.height + 1), f"{name} {frame.split} {frame.number}", font=font, fill=(200, 200, 200))
    return np.asarray(picture)
