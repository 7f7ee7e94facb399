"""Write a capture of ours as a Goliath body capture, so that tools made for that data set can read it.

Zips are written one by one, whole or not at all, and those that are there already are kept: an interrupted export goes on where it
stopped. camera_calibration.json comes last; without it no reader takes the folder for a capture.
"""

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from PIL import Image

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour import encode_bytes
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.formats.archives import write_archive
from mitsuba_avatar.captures.formats.decoding import encode_ply
from mitsuba_avatar.captures.formats.goliath_documents import CALIBRATION_FILE, SENSOR_SCALE
from mitsuba_avatar.captures.formats.momentum import MomentumModel, save_momentum
from mitsuba_avatar.captures.formats.momentum_files import configuration_text, model_document, parse_configuration
from mitsuba_avatar.files import atomic_path

MILLIMETRES = 1e3  # of a metre
AVIF_OPTIONS = {"quality": 95, "subsampling": "4:4:4", "speed": 8}
PERSON_LABEL = 1  # our masks know one part, the person; 0 is background there as here
Track = Callable[[Sequence, str], Iterable]


@dataclass(frozen=True, eq=False)
class GoliathBody:
    """What of a body goes into a Goliath capture.

    Attributes:
        model: poses as the capture's rig does.
        poses: [N, P] parameters of every frame.
        ambient_occlusion: called with a frame's index, gives [S, S] occlusion in texture space, 1 where open; None leaves it out.
    """

    model: MomentumModel
    poses: Float64[np.ndarray, "N P"]
    ambient_occlusion: Callable[[int], Float32[np.ndarray, "S S"]] | None = None


def write_goliath(capture: Capture, path: Path | str, body: GoliathBody | None, track: Track = lambda items, _: items) -> Path:
    """Write a capture as a Goliath body capture.

    Images become linear AVIF at the size of `capture.cameras`; matrices are for twice that size, transposed, in millimetres; masks become
    labels 0 and 1; the registered mesh stands in for the scan as well. Validation frames are listed as test frames, because the
    format knows two splits.

    Args:
        capture: with straight cameras.
        path: folder; its name must contain "Body", by which that data set's tools choose their loader.
        body: model and poses; None writes images, masks and cameras alone.
        track: called with a sequence and a description, yields its items; a progress bar.

    Returns:
        the folder.

    Raises:
        ValueError: for another folder name, a distorted camera, or an image that cannot be read.
        FileExistsError: if the folder holds a finished capture.
    """
    path = Path(path)
    distorted = [name for name, camera in capture.cameras.items() if camera.is_distorted]
    if "Body" not in path.name or distorted:
        raise ValueError(
            f"write_goliath(): expected a folder name with 'Body' and straight cameras; got {path.name!r} and distortion of "
            f"{distorted[:5]}. Name it s--20260101--0000--ID--pilot--ProjectGoliath--ClothedBody--4cams, say, and undistort the images."
        )
    if (path / CALIBRATION_FILE).exists():
        raise FileExistsError(f"write_goliath(): expected a new folder at {path}; got a finished capture. Choose another, or delete it.")
    numbers = [frame.number for frame in capture.frames]
    has_masks = capture.images.has_masks
    for name in track(list(capture.cameras), "Writing images"):
        _write_zip(path / f"image/cam{name}.zip", f"cam{name}/", numbers, "avif", _image_encoder(capture, name))
        if has_masks:
            _write_zip(path / f"segmentation_parts/cam{name}.zip", f"cam{name}/", numbers, "png", _label_encoder(capture, name))
    _write_tables(capture, path)
    if capture.keypoints is not None:
        _write_zip(path / "keypoints_3d/keypoints_3d.zip", "", numbers, "json", lambda index: _keypoint_text(capture.keypoints[index]))
    faces = None if body is None else body.model.faces
    if capture.vertices is not None:
        tracking = path / "kinematic_tracking/registration_vertices.zip"
        _write_zip(tracking, "registration_vertices/", numbers, "ply", lambda index: encode_ply(_millimetres(capture, index)))
        _write_zip(path / "scan_mesh/scan_mesh.zip", "", numbers, "ply", lambda index: encode_ply(_millimetres(capture, index), faces))
    if body is not None:
        _write_body(path, body, numbers, track)
    _write_json(path / CALIBRATION_FILE, {"KRT": [calibration_entry(camera) for camera in capture.cameras.values()]})
    return path


def calibration_entry(camera: Camera) -> dict[str, Any]:
    """A camera as camera_calibration.json has it: transposed, millimetres, twice the size, pixel centres at integers."""
    intrinsics = np.eye(3)
    intrinsics[0, 0], intrinsics[1, 1] = SENSOR_SCALE * camera.fx, SENSOR_SCALE * camera.fy
    intrinsics[:2, 2] = SENSOR_SCALE * np.array([camera.cx, camera.cy]) - 0.5
    pose = camera.camera_from_world.copy()
    pose[:3, 3] *= MILLIMETRES
    return {"cameraId": camera.name, "K": intrinsics.T.tolist(), "T": pose.T.tolist(), "distortion": [0.0, 0.0, 0.0, 0.0]}


def _write_body(path: Path, body: GoliathBody, numbers: list[int], track: Track) -> None:
    """Poses, template, model and occlusion."""
    folder = path / "kinematic_tracking"
    _write_zip(folder / "pose.zip", "pose/", numbers, "txt", lambda index: _lines(body.poses[index]))
    _write_bytes(folder / "template_mesh.ply", encode_ply(body.model.rest_vertices, body.model.faces))
    _write_bytes(folder / "skeleton_scales.txt", _lines(np.zeros(body.model.num_scales)))
    if body.ambient_occlusion is not None:
        archive = path / "uv_image/ambient_occlusion.zip"
        if not archive.is_file():
            maps = [
                np.rint(255 * body.ambient_occlusion(index).clip(0, 1)).astype(np.uint8)
                for index in track(range(len(numbers)), "Tracing ambient occlusion")
            ]
            mean = np.mean(maps, axis=0, dtype=np.float64)
            _write_bytes(path / "uv_image/ambient_occlusion_mean.png", _png(np.rint(mean).astype(np.uint8)))
            _write_zip(archive, "ambient_occlusion/", numbers, "png", lambda index: _png(maps[index]))
    shared = path / "shared"
    document, text = model_document(body.model), configuration_text(body.model)
    _write_json(shared / "body_model.json", document)
    _write_bytes(shared / "body_model.cfg", text.encode("utf-8"))
    save_momentum(shared / "static_assets_body.npz", body.model)
    config = parse_configuration(text, body.model.joint_names)
    with atomic_path(shared / "static_assets_body.pt") as temporary:
        torch.save(_assets(body.model, document, config), temporary)


def _assets(model: MomentumModel, document: dict[str, Any], config: dict[str, Any]) -> dict[str, Any]:
    """The parts of static_assets_body.pt that a capture can give: plain containers and tensors, which open without running anything."""
    face = torch.from_numpy(np.array(model.face_weights))
    return {
        "topology": {"vi": torch.from_numpy(model.faces), "vt": torch.from_numpy(model.uv), "vti": torch.from_numpy(model.uv_faces)},
        "lbs_model_json": document,
        "lbs_config_dict": config
        | {
            "transform": torch.from_numpy(config["transform"]),
            "transform_offsets": torch.from_numpy(config["transform_offsets"]),
        },
        "global_scaling": model.global_scaling.tolist(),
        "mouth_eyes_mask_geom": face,
        "full_head_mask_geom": (face > 0).float(),
    }


def _write_tables(capture: Capture, path: Path) -> None:
    """Frame lists, the floor, and a note of the source."""
    frames = capture.frames
    splits = [(frame.number, "train" if frame.split == "train" else "test") for frame in frames]
    _write_bytes(path / "frame_splits_list.csv", _csv(("frame", "split"), splits))
    _write_bytes(path / "frame_segments_list.csv", _csv(("frame", "segment_name"), [(frame.number, frame.segment) for frame in frames]))
    # The world of our captures has its floor at z = 0 already.
    _write_bytes(path / "floor_transformation.txt", b"1 0 0 0\n0 1 0 0\n0 0 1 0\n")
    _write_bytes(path / "config.yml", f"source: {json.dumps(capture.description.name)}\nfps: {capture.description.fps}\n".encode())


def _write_zip(path: Path, folder: str, numbers: list[int], extension: str, contents: Callable[[int], bytes]) -> None:
    """A zip with a member for each frame, unless it is there already."""
    if not path.is_file():
        write_archive(path, [f"{folder}{number:06d}.{extension}" for number in numbers], contents)


def _image_encoder(capture: Capture, name: str) -> Callable[[int], bytes]:
    """Frame index -> AVIF bytes of linear values."""

    def encoded(index: int) -> bytes:
        buffer = io.BytesIO()
        Image.fromarray(encode_bytes(capture.image(name, index), "linear")).save(buffer, "AVIF", **AVIF_OPTIONS)
        return buffer.getvalue()

    return encoded


def _label_encoder(capture: Capture, name: str) -> Callable[[int], bytes]:
    """Frame index -> PNG bytes of labels."""
    return lambda index: _png(np.where(capture.mask(name, index) > 0.5, np.uint8(PERSON_LABEL), np.uint8(0)))


def _millimetres(capture: Capture, index: int) -> Float32[np.ndarray, "V 3"]:
    """Registered mesh of a frame."""
    return np.asarray(MILLIMETRES * capture.vertices[index].astype(np.float64), dtype=np.float32)


def _keypoint_text(rows: Float32[np.ndarray, "K 4"]) -> bytes:
    """[[id, x, y, z, confidence], ...] of the keypoints that were found, millimetres."""
    found = [
        [index, *(MILLIMETRES * row[:3].astype(np.float64)).tolist(), float(row[3])]
        for index, row in enumerate(np.asarray(rows))
        if row[3] > 0
    ]
    return json.dumps(found).encode("ascii")


def _lines(values: Float64[np.ndarray, "N"]) -> bytes:
    """One number a line."""
    return "".join(f"{float(value)!r}\n" for value in values).encode("ascii")


def _csv(header: tuple[str, str], rows: list[tuple[int, str]]) -> bytes:
    """Text of a table."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return text.getvalue().encode("utf-8")


def _png(pixels: UInt8[np.ndarray, "H W"]) -> bytes:
    """A grey PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG")
    return buffer.getvalue()


def _write_bytes(path: Path, data: bytes) -> None:
    """A small file, whole or absent."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _write_json(path: Path, document: Any) -> None:
    """A JSON document."""
    _write_bytes(path, json.dumps(document).encode("utf-8"))
