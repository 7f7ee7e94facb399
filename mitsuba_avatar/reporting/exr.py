"""Multi-channel OpenEXR: what a renderer knows of a picture, in one file, under the layer names that compositing programs expect.

| layer    | shape      | channels                          | unit                                   |
|----------|------------|-----------------------------------|----------------------------------------|
| colour   | [H, W, 3/4]| R G B (A, premultiplied)          | linear radiance, Rec. 709 primaries    |
| depth    | [H, W]     | depth.Z                           | metres along the viewing axis          |
| normal   | [H, W, 3]  | normal.X normal.Y normal.Z        | unit vectors, world axes               |
| position | [H, W, 3]  | position.X position.Y position.Z  | metres, world axes                     |
| uv       | [H, W, 2]  | uv.U uv.V                         | texture coordinates                    |
| albedo   | [H, W, 3]  | albedo.R albedo.G albedo.B        | diffuse reflectance, premultiplied     |
| ambient_occlusion | [H, W] | ambient_occlusion            | 1 where open, premultiplied            |
| mask     | [H, W]     | mask                              | coverage, 0..1                         |

The colour space is recorded twice, as the standard `chromaticities` and as the colour interop identifier of OpenEXR 3.4.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from jaxtyping import Float

from mitsuba_avatar.files import atomic_path

_CHANNELS = {
    "colour": ("R", "G", "B", "A"),
    "depth": ("depth.Z",),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "position": ("position.X", "position.Y", "position.Z"),
    "uv": ("uv.U", "uv.V"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "ambient_occlusion": ("ambient_occlusion",),
    "mask": ("mask",),
}
_COLOUR_SPACE = "lin_rec709_scene"
_REC_709_CHROMATICITIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)  # x, y of red, green, blue, white
_LARGEST_HALF = 65504.0


def write_exr(path: Path | str, layers: Mapping[str, Float[np.ndarray, "H W *C"]], half: bool = False, comments: str = "") -> None:
    """Write one picture, whole or not at all, ZIP-compressed.

    Args:
        path: file to write.
        layers: layer name -> values, as in the module's table; float32 unless `half`.
        half: store colour, albedo, occlusion and mask as 16-bit floats (larger values are cut at 65504). Geometry stays 32-bit: half
            metres at 4 m are steps of 4 mm.
        comments: the header's standard attribute of that name, for instance what the picture was made with.

    Raises:
        ValueError: an unknown layer, a wrong number of channels, layers of different sizes, or none.
        OSError: if the file cannot be written.
    """
    if not layers:
        raise ValueError(f"write_exr(): expected at least one layer of {', '.join(_CHANNELS)}; got none. Give {path} a picture.")
    sizes = {name: values.shape[:2] for name, values in layers.items()}
    if len(set(sizes.values())) != 1:
        raise ValueError(f"write_exr(): expected layers of one height and width; got {sizes}. Render them at one size.")
    channels = {}
    for name, values in layers.items():
        dtype = np.float16 if half and name in ("colour", "albedo", "ambient_occlusion", "mask") else np.float32
        for channel, plane in zip(_channel_names(name, values), _planes(values), strict=True):
            stored = np.clip(plane, -_LARGEST_HALF, _LARGEST_HALF) if dtype is np.float16 else plane
            channels[channel] = np.ascontiguousarray(stored, dtype=dtype)
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "chromaticities": _REC_709_CHROMATICITIES,
        "colorInteropID": _COLOUR_SPACE,
    }
    if comments:
        header["comments"] = comments
    with atomic_path(path) as temporary, OpenEXR.File(header, channels) as file:
        try:
            file.write(str(temporary))
        except RuntimeError as error:  # the binding's word for every failure of the file system
            raise OSError(f"write_exr(): could not write {path}: {error}. Check permission and free space.") from error


def read_exr(path: Path | str) -> dict[str, Float[np.ndarray, "H W *C"]]:
    """Read the layers that `write_exr` writes, as float32; channels of other names are left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: not an EXR, of another colour space, or with part of a layer's channels only.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"read_exr(): expected an EXR file at {path}; there is none. Check the path.")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            # A file that says nothing is linear Rec. 709 by the OpenEXR specification.
            colour_space = file.header().get("colorInteropID", _COLOUR_SPACE)
            channels = {name: np.array(channel.pixels, dtype=np.float32) for name, channel in file.channels().items()}
    except RuntimeError as error:
        raise ValueError(f"read_exr(): expected an OpenEXR file; got {path}: {error}. Write it again.") from error
    if colour_space != _COLOUR_SPACE:
        raise ValueError(f"read_exr(): expected colour space {_COLOUR_SPACE} in {path}; got {colour_space}. Convert it first.")
    layers = {}
    for name, names in _CHANNELS.items():
        present = [channel for channel in names if channel in channels]
        required = names[:3] if name == "colour" else names
        if not present:
            continue
        if not set(required) <= set(present):
            raise ValueError(f"read_exr(): expected channels {required} in {path}; got {present}. Write the whole layer.")
        layers[name] = channels[present[0]] if len(names) == 1 else np.stack([channels[channel] for channel in present], axis=-1)
    return layers


def _channel_names(layer: str, values: np.ndarray) -> tuple[str, ...]:
    if layer not in _CHANNELS:
        raise ValueError(f"write_exr(): expected a layer of {', '.join(_CHANNELS)}; got {layer!r}. Rename it.")
    names = _CHANNELS[layer]
    allowed = {"colour": ((3,), (4,))}.get(layer, ((),) if len(names) == 1 else ((len(names),),))
    if values.shape[2:] not in allowed:
        raise ValueError(f"write_exr(): expected {layer} as [H, W, {len(names)}] for {names}; got {list(values.shape)}. Reshape it.")
    return names[: values.shape[2]] if values.ndim == 3 else names


def _planes(values: np.ndarray) -> list[np.ndarray]:
    return [values] if values.ndim == 2 else list(np.moveaxis(values, -1, 0))
