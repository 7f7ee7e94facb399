"""capture.yaml: what a capture is. Its presence says that the capture is whole, because the writer adds it last."""

import dataclasses
import difflib
import math
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import yaml

from mitsuba_avatar.captures.cameras import UpAxis
from mitsuba_avatar.captures.colour import ColourCurve
from mitsuba_avatar.captures.images import ImageExtension
from mitsuba_avatar.files import atomic_path

FORMAT_VERSION = 1
Distortion = Literal["auto", "apply", "ignore"]
CHOICE_REMEDIES = {
    "colour_curve": "Encode the images with one of these curves.",
    "face_signal": "Say what face.npy holds.",
    "image_extension": "Convert the images.",
    "up": "Name the axis of the data set's world that points up.",
    "distortion": "Say what to do with stored lens coefficients.",
}


@dataclass(frozen=True)
class ImagesFrom:
    """The data set of another format that a capture's images, masks and plates are read from, straightened on reading.

    Attributes:
        format: of the data set; captures/formats/opening.py knows them.
        path: its folder.
        state: fingerprint of its files when the capture was made (captures/formats/source_state.py); empty is not compared.
        has_masks: whether it has masks.
        up: axis of its world that points up, as it was opened; "auto" asks its cameras.
        distortion: whether stored lens coefficients are applied.
    """

    format: str
    path: str
    state: str = ""
    has_masks: bool = True
    up: UpAxis = "auto"
    distortion: Distortion = "auto"


@dataclass(frozen=True)
class CaptureDescription:
    """Contents of capture.yaml.

    Attributes:
        name: what people call the capture.
        fps: frames per second of the recording.
        format_version: of the layout on disk; 1.
        units: of every length in the capture; only "metres" is accepted, so that a converter has to say that it converted.
        colour_curve: of the image files: "srgb", or "linear" (always for exr).
        exposure: factor from scene radiance to the images' linear values; a record for relighting, not applied when reading.
        lighting: emitters or an environment map, as the studio or the light stage describes them; empty if unknown.
        background: linear radiance (r, g, b) behind the person, the same in every pixel of every camera; None if it is not known or not
            uniform. Plates in backgrounds/ go before it.
        rig: file with topology, skeleton and skinning weights, relative to the capture.
        face_signal: what face.npy holds: "keypoints" (rest-space positions, metres) or "action_codes" (facial action weights).
        face_names: name of each column of face.npy; empty if unnamed.
        keypoint_names: name of each keypoint of keypoints.npy; empty if unnamed.
        held_out_cameras: cameras that no training may look at.
        image_extension: of the image files.
        images_from: where images lie that are not in this folder; None where they are.
        licence: under which the capture may be used.
        source: where it comes from.

    Raises:
        ValueError: for a value outside these sets.
    """

    name: str
    fps: float
    format_version: int = FORMAT_VERSION
    units: str = "metres"
    colour_curve: ColourCurve = "srgb"
    exposure: float = 1.0
    lighting: dict[str, Any] = field(default_factory=dict)
    background: tuple[float, float, float] | None = None
    rig: str = "rig.npz"
    face_signal: Literal["keypoints", "action_codes"] = "keypoints"
    face_names: tuple[str, ...] = ()
    keypoint_names: tuple[str, ...] = ()
    held_out_cameras: tuple[str, ...] = ()
    image_extension: ImageExtension = "png"
    images_from: ImagesFrom | None = None
    licence: str = ""
    source: str = ""

    def __post_init__(self) -> None:
        self._require(
            self.format_version == FORMAT_VERSION, "format_version", FORMAT_VERSION, "Use the version of this package that wrote it."
        )
        self._require(self.units == "metres", "units", "metres", "Convert cameras, vertices, keypoints and root translations to metres.")
        self._require(self.fps > 0, "fps", "> 0", "Write the recording's frames per second.")
        self._require(self.exposure > 0, "exposure", "> 0", "Leave it out if unknown.")
        if self.image_extension == "exr":
            self._require(self.colour_curve == "linear", "colour_curve", "linear for exr images", "exr files hold radiance.")

    def _require(self, is_met: bool, key: str, expected: object, remedy: str) -> None:
        """Refuse a value, naming the key."""
        if not is_met:
            raise ValueError(f"CaptureDescription(): expected {key}: {expected}; got {getattr(self, key)!r}. {remedy}")


def save_description(path: Path | str, description: CaptureDescription) -> None:
    """Write capture.yaml; the file is whole or absent."""
    with atomic_path(path) as temporary:
        temporary.write_text(description_text(description), encoding="utf-8")


def description_text(description: CaptureDescription) -> str:
    """The text of capture.yaml: equal descriptions give equal text."""
    # Tuples as lists: YAML has no plain notation for tuples.
    values = {key: list(value) if isinstance(value, tuple) else value for key, value in dataclasses.asdict(description).items()}
    if description.images_from is None:
        del values["images_from"]
    return yaml.safe_dump(values, sort_keys=False, allow_unicode=True)


def load_description(path: Path | str) -> CaptureDescription:
    """Read capture.yaml.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for text that is not YAML, an unknown key (names the nearest known one), a missing name or fps, or a value
            that is refused.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"load_description(): expected a capture's description at {path}; got none. Name a capture folder.")
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8-sig"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"load_description(): expected YAML in {path}; got: {error}. Repair the file.") from error
    if not isinstance(document, dict) or not {"name", "fps"} <= set(document):
        raise ValueError(f"load_description(): expected the keys 'name' and 'fps' in {path}; got {document!r}. Add them.")
    try:
        return _built(CaptureDescription, document)
    except ValueError as error:
        raise ValueError(f"load_description(): {path} is not usable. {error}") from error


def _built(kind: type, document: dict) -> Any:
    """A dataclass of the file's mapping; unknown keys are refused."""
    known = [entry.name for entry in dataclasses.fields(kind)]
    for key in document:
        if key not in known:
            nearest = difflib.get_close_matches(str(key), known, n=1, cutoff=0.0)[0]
            raise ValueError(f"Expected known keys; got {key!r}. Did you mean {nearest!r}?")
    return kind(**{key: _typed(kind, key, value) for key, value in document.items()})


def _typed(owner: type, key: str, value: Any) -> Any:
    """A value of the file in the type of its field: YAML reads `name: 2024` as a number and `fps: fast` as text."""
    if key == "background":
        if value is not None and (not isinstance(value, list) or len(value) != 3 or not all(_is_radiance(part) for part in value)):
            raise ValueError(f"Expected background to be three numbers >= 0, linear radiance; got {value!r}. Leave it out if unknown.")
        return None if value is None else tuple(float(part) for part in value)
    if key == "images_from":
        if not isinstance(value, dict) or not {"format", "path"} <= set(value):
            raise ValueError(f"Expected images_from with format and path; got {value!r}. `capture convert --in-place` writes it.")
        return _built(ImagesFrom, value)
    kind = typing.get_type_hints(owner)[key]
    if typing.get_origin(kind) is Literal:
        choices = typing.get_args(kind)
        if value not in choices:
            raise ValueError(f"Expected {key} to be one of {', '.join(choices)}; got {value!r}. {CHOICE_REMEDIES[key]}")
        return value
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise ValueError(f"Expected {key} to be a list of names; got {value!r}. Write one name a line, each after a dash.")
        return tuple(str(name) for name in value)
    if kind is bool:
        if not isinstance(value, bool):
            raise ValueError(f"Expected {key} to be true or false; got {value!r}. Write one of them.")
        return value
    if kind in (int, float):
        if isinstance(value, bool) or not isinstance(value, int | kind) or not math.isfinite(value):
            raise ValueError(f"Expected {key} to be a number; got {value!r}. Write it without quotes and units.")
        return kind(value)
    if kind is str:
        return str(value)
    if not isinstance(value, dict):
        raise ValueError(f"Expected {key} to be a mapping; got {value!r}. Leave it out if unknown.")
    return value


def _is_radiance(value: Any) -> bool:
    """Whether a value of the file is a finite number >= 0."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
