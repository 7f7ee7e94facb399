"""What made the images, kept beside a capture for scoring and out of reach of training: the folder `truth/`.

truth/<layer>/albedo.exr, roughness.exr     linear reflectance and roughness in the layer's atlas
truth/garment_body_vertices.npy             which vertices of the registered mesh are the simulated garment's
truth/light/<scene>.xml and its files       the light, as a Mitsuba scene that opens where it lies
truth/sensors.json                          each camera's response to colour, noise
truth/ambient_occlusion/<frame>.png         of the true surface, 8 bits, white where open
"""

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int

from mitsuba_avatar.body.rig import Topology
from mitsuba_avatar.captures.images import write_mask
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.filming.sensor import Sensor
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.filming.stage import Layer
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion
from mitsuba_avatar.resources import find_resource

TRUTH_FOLDER = "truth"
GARMENT = "garment_body_vertices.npy"


def write_truth(
    folder: Path | str,
    layers: Sequence[Layer],
    garment: Int[np.ndarray, "G"] | None,
    camera_names: Sequence[str],
    settings: StudioSettings,
) -> None:
    """Write all truth that does not change from frame to frame.

    Args:
        folder: the capture's; `truth/` is made in it.
        layers: what is filmed.
        garment: vertices of the registered mesh that are the simulated garment's; None where nothing is simulated.
        camera_names: training cameras first, as the sensors are.
        settings: what the capture is filmed with.
    """
    truth = Path(folder) / TRUTH_FOLDER
    for layer in layers:
        layer.appearance.save(truth / layer.name)
    if garment is not None:
        with atomic_path(truth / GARMENT) as temporary:
            np.save(temporary, garment)
    copy_scene(find_resource("scenes", settings.light.scene, ".xml"), truth / "light")
    sensor = Sensor.of(settings)
    document = {
        "shot_noise": sensor.shot_noise,
        "read_noise": sensor.read_noise,
        "responses": {name: response.tolist() for name, response in zip(camera_names, sensor.responses, strict=True)},
    }
    with atomic_path(truth / "sensors.json") as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def copy_scene(scene: Path, folder: Path | str) -> None:
    """Copy a Mitsuba scene and the files it names into a folder, so that the copy opens without the original.

    Raises:
        FileNotFoundError: if a file that the scene names beside itself is missing.
        ValueError: if the scene names a file outside its own folder.
    """
    named = [node.get("value", "") for node in ElementTree.parse(scene).iter("string") if node.get("name") == "filename"]
    for name in [scene.name, *named]:
        source = scene.parent / name
        if not source.is_file():
            raise FileNotFoundError(f"copy_scene(): expected {source}, which {scene} names; got none. Restore it or edit the scene.")
        if not source.resolve().is_relative_to(scene.parent.resolve()):
            raise ValueError(f"copy_scene(): expected the files of {scene} beside or below it; got {name!r}. Move the file there.")
        with atomic_path(Path(folder) / name) as temporary:
            temporary.write_bytes(source.read_bytes())


class OcclusionTruth:
    """Ambient occlusion of the true surface, frame by frame, in the body's atlas."""

    def __init__(self, folder: Path | str, topology: Topology, size: int):
        """Prepare for a topology and maps of `size` x `size` texels; files go to `truth/` in the capture's folder."""
        self._folder = Path(folder) / TRUTH_FOLDER / "ambient_occlusion"
        self._baker = AmbientOcclusion(topology, size)

    def write(self, frame: int, vertices: Float32[np.ndarray, "V 3"]) -> None:
        """Bake and write one frame; a frame that is there already is left alone. Metres, world axes."""
        path = self._folder / f"{frame:06d}.png"
        if not path.is_file():
            occlusion = self._baker.bake(torch.from_numpy(vertices), seed=frame).numpy()
            write_mask(path, np.rint(255 * occlusion.clip(0, 1)).astype(np.uint8))
