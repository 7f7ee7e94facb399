"""Colour calibration of cameras from pictures of a colour chart, with the colour-science package.

Each camera took one picture of the same chart; where it lies in the picture and what an ideal camera would have measured of it is in
`chart.json` beside the pictures. The fit finds the affine map (3 x 3 gains and crosstalk, 3 offsets) that takes what a camera recorded
to that reference, in linear values; patches that the camera clipped are left out. Training should see corrected images alone.

    chart/chart.json        layout, corners and reference values per camera
    chart/<camera>.png      encoded as the capture's images are
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from mitsuba_avatar.captures.colour import decode_bytes
from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.files import atomic_path

CHART_FILE = "chart.json"
FORMAT_VERSION = 1
PATCH_SHARE = 0.5  # of a patch's width and height, in its middle, that is averaged: edges mix with the frame
WHITE_LEVEL = 250  # of 255; from here on a pixel may be clipped
LARGEST_CLIPPED_SHARE = 0.05  # of a patch's pixels: noise carries a few of a dark patch to black
FEWEST_PATCHES = 8  # an affine map has four unknowns a channel; fewer patches than twice that leave no redundancy


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class ColourChart:
    """A chart as cameras saw it.

    Attributes:
        rows, columns: of patches, counted in reading order as the pictures show them.
        corners: camera -> [4, 2] upper left, upper right, lower right and lower left corner in pixels, origin at the image's corner.
        reference: camera -> [P, 3] linear values that an ideal camera measures from there, P = rows * columns.
    """

    rows: int
    columns: int
    corners: dict[str, Float64[np.ndarray, "4 2"]]
    reference: dict[str, Float64[np.ndarray, "P 3"]]

    def __post_init__(self) -> None:
        wrong = [name for name, values in self.reference.items() if values.shape != (self.rows * self.columns, 3)]
        if wrong or set(self.corners) != set(self.reference):
            raise ValueError(
                f"ColourChart(): expected corners and {self.rows} x {self.columns} reference values of the same cameras; got others for "
                f"{wrong or sorted(set(self.corners) ^ set(self.reference))}. Write both for every camera."
            )


def save_chart(folder: Path | str, chart: ColourChart) -> None:
    """Write `chart.json`, whole or absent."""
    cameras = {
        name: {"corners": chart.corners[name].tolist(), "reference": chart.reference[name].round(6).tolist()} for name in chart.corners
    }
    document = {"format_version": FORMAT_VERSION, "rows": chart.rows, "columns": chart.columns, "cameras": cameras}
    with atomic_path(Path(folder) / CHART_FILE) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def load_chart(folder: Path | str) -> ColourChart:
    """Read `chart.json`.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is of another version or lacks something.
    """
    path = Path(folder) / CHART_FILE
    if not path.is_file():
        raise FileNotFoundError(f"load_chart(): expected a chart's description at {path}; got none. Film or photograph a chart first.")
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        if document["format_version"] != FORMAT_VERSION:
            raise ValueError(f"format_version {document['format_version']}")
        cameras = document["cameras"]
        return ColourChart(
            rows=document["rows"],
            columns=document["columns"],
            corners={name: np.array(entry["corners"], dtype=np.float64) for name, entry in cameras.items()},
            reference={name: np.array(entry["reference"], dtype=np.float64) for name, entry in cameras.items()},
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"load_chart(): expected rows, columns and cameras of format_version {FORMAT_VERSION} in {path}; got {error!r}. "
            "Write it with save_chart()."
        ) from error


def calibrate_cameras(folder: Path | str, curve: str) -> dict[str, Float64[np.ndarray, "3 4"]]:
    """Colour correction of every camera from a folder of chart pictures.

    Args:
        folder: with `chart.json` and a picture per camera.
        curve: how pictures are encoded ("srgb" or "linear").

    Returns:
        camera -> [3, 4] for `correct_colours`.

    Raises:
        FileNotFoundError: if a picture is missing.
        ValueError: if a camera clipped too many patches.
    """
    chart = load_chart(folder)
    matrices = {}
    for name, corners in chart.corners.items():
        encoded = read_image(Path(folder) / f"{name}.png")
        recorded = patch_means(decode_bytes(encoded, curve), corners, chart.rows, chart.columns)
        is_clipped = (encoded == 0) | (encoded >= WHITE_LEVEL)
        clipped = patch_means(is_clipped.astype(np.float32), corners, chart.rows, chart.columns)
        usable = (clipped <= LARGEST_CLIPPED_SHARE).all(axis=1)
        if usable.sum() < FEWEST_PATCHES:
            raise ValueError(
                f"calibrate_cameras(): expected {FEWEST_PATCHES} patches between black and level {WHITE_LEVEL} in {name}.png of {folder}; "
                f"got {int(usable.sum())}. Change the exposure."
            )
        matrices[name] = fit_colour_matrix(recorded[usable], chart.reference[name][usable])
    return matrices


def patch_means(
    image: Float[np.ndarray, "H W 3"], corners: Float[np.ndarray, "4 2"], rows: int, columns: int
) -> Float64[np.ndarray, "P 3"]:
    """Mean of each patch's middle, in reading order.

    Args:
        image: linear values.
        corners: as in `ColourChart`; the chart may be turned and foreshortened.
        rows, columns: of patches.

    Raises:
        ValueError: if a patch is so small that no pixel lies in its middle.
    """
    height, width = image.shape[:2]
    square_from_pixel = _square_from_pixel(corners)
    y, x = np.mgrid[0:height, 0:width] + 0.5
    place = np.stack([x, y, np.ones_like(x)], axis=-1) @ square_from_pixel.T
    across, down = place[..., 0] / place[..., 2] * columns, place[..., 1] / place[..., 2] * rows
    is_middle = (np.abs(across % 1 - 0.5) < PATCH_SHARE / 2) & (np.abs(down % 1 - 0.5) < PATCH_SHARE / 2)
    is_middle &= (across > 0) & (across < columns) & (down > 0) & (down < rows)
    index = (np.floor(down) * columns + np.floor(across))[is_middle].astype(np.int64)
    pixels = image[is_middle].astype(np.float64)
    counts = np.bincount(index, minlength=rows * columns)
    if (counts == 0).any():
        raise ValueError(
            f"patch_means(): expected pixels in the middle of {rows} x {columns} patches; got none in {int((counts == 0).sum())} of them. "
            "Take the picture from nearer, or at a higher resolution."
        )
    sums = [np.bincount(index, weights=pixels[:, channel], minlength=rows * columns) for channel in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]


def _square_from_pixel(corners: Float[np.ndarray, "4 2"]) -> Float64[np.ndarray, "3 3"]:
    """Projective map from pixels to the chart's unit square: upper left (0, 0), lower right (1, 1)."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
    rows = []
    for (x, y), (u, v) in zip(corners.astype(np.float64), square, strict=True):
        rows += [[x, y, 1, 0, 0, 0, -u * x, -u * y, -u], [0, 0, 0, x, y, 1, -v * x, -v * y, -v]]
    return np.linalg.svd(np.array(rows))[2][-1].reshape(3, 3)


def fit_colour_matrix(recorded: Float[np.ndarray, "P 3"], reference: Float[np.ndarray, "P 3"]) -> Float64[np.ndarray, "3 4"]:
    """The affine map, in least squares, that takes recorded linear values to the reference: [3, 4], offsets in the last column."""
    import colour  # takes seconds to load, which readers of charts need not wait for

    return colour.matrix_colour_correction(recorded.astype(np.float64), reference.astype(np.float64), method="Vandermonde", degree=1)


def correct_colours(image: Float[np.ndarray, "*shape 3"], matrix: Float[np.ndarray, "3 4"]) -> Float[np.ndarray, "*shape 3"]:
    """Linear values through a camera's correction; dtype kept."""
    return (image @ matrix[:, :3].T + matrix[:, 3]).astype(image.dtype)
