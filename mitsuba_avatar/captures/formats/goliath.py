"""Goliath body captures (Codec Avatar Studio): read in place, straight out of their zips.

Matrices of camera_calibration.json are stored transposed, in millimetres, and for a sensor of twice the images' size, with pixel
centres at integers. Poses are parameters of a momentum body model, whose assets lie with the data set's code and not in a capture.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.formats.archives import Archive
from mitsuba_avatar.captures.formats.decoding import (
    decode_image,
    decode_labels,
    decode_ply,
    encoded_size,
    parse_json,
    parse_numbers,
    require_file,
)
from mitsuba_avatar.captures.formats.goliath_documents import (
    CALIBRATION_FILE,
    METRES,
    calibration_entries,
    frame_rows,
    goliath_camera,
    keypoint_rows,
)
from mitsuba_avatar.captures.formats.momentum import MomentumModel
from mitsuba_avatar.captures.formats.momentum_files import load_momentum
from mitsuba_avatar.captures.formats.source import (
    Source,
    SourceInfo,
    SourceOptions,
    chosen_cameras,
    common_frames,
    timed_frames,
    turned_camera,
    turned_points,
    up_notes,
    upright_world,
)
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.captures.rigid import is_rigid
from mitsuba_avatar.captures.undistortion import Lens

FPS = 30.0  # of frame numbers; releases hold a part of the frames
ASSETS_FILES = ("static_assets_body.npz", "static_assets_body.pt")
LICENCE = "CC BY-NC 4.0"


@dataclass(frozen=True, eq=False)
class MomentumTracking:
    """Tracked poses of a momentum model.

    Attributes:
        model: skeleton, parameters, weights.
        template: [V, 3] unposed surface of this person, centimetres.
        scales: [S] scale parameters of this person.
        poses: [N, P] of every frame.
        world_from_model: [4, 4] rigid; the model's world (after `global_scaling`, in metres) in ours.
    """

    model: MomentumModel
    template: Float32[np.ndarray, "V 3"]
    scales: Float64[np.ndarray, "S"]
    poses: Float64[np.ndarray, "N P"]
    world_from_model: Float64[np.ndarray, "4 4"]


def find_assets(path: Path) -> Path | None:
    """File of the body model in shared/ in a capture, or beside it; None if there is none."""
    folders = (path / "shared", path, path.parent / "shared", path.parent)
    return next((folder / name for folder in folders for name in ASSETS_FILES if (folder / name).is_file()), None)


class GoliathSource(Source):
    """A body capture in Goliath's layout; zips may also be unpacked folders of the same names.

    Raises:
        FileNotFoundError: if the folder or its calibration is missing.
        ValueError: for files of another schema, or no frame that every camera has.
    """

    def __init__(self, path: Path | str, options: SourceOptions = SourceOptions()):  # noqa: B008 - frozen
        self.path, self.options = Path(path), options
        require_file(self.path / CALIBRATION_FILE, "Name the folder of one body capture.")
        native, lenses, notes = self._native_cameras()
        floor = self._world_from_floor_file(notes)
        native = {name: turned_camera(camera, floor) for name, camera in native.items()}
        turn = upright_world(native.values(), options.up, self.path)
        self._world_from_native = turn @ floor
        self._poses = self._archive("kinematic_tracking/pose.zip")
        self._vertices = self._archive("kinematic_tracking/registration_vertices.zip")
        self._keypoints = self._archive("keypoints_3d/keypoints_3d.zip")
        self._scans = self._archive("scan_mesh/scan_mesh.zip")
        self._occlusion = self._archive("uv_image/ambient_occlusion.zip")
        frames, missing = self._frames()
        ids, problem = self._keypoint_ids(frames)
        self._ids = ids
        lacks = [] if self._poses else ["poses (kinematic_tracking/pose.zip)"]
        if self.assets_path is None:
            lacks.append("the body model: static_assets_body.pt of the data set's code (--assets)")
        self.info = SourceInfo(
            name=self.path.resolve().name,
            fps=options.fps or FPS,
            cameras={name: turned_camera(camera, turn) for name, camera in native.items()},
            lenses=lenses,
            frames=frames,
            missing=missing,
            colour_curve="linear",
            image_extension="avif",
            has_masks=bool(self._parts),
            lacks=tuple(lacks),
            notes=(*notes, *up_notes(native.values(), turn, options, self.path), *([problem] if problem else [])),
            keypoint_names=tuple(ids),
            licence=LICENCE,
            source=f"Goliath body capture {self.path.resolve().name}",
        )

    def where(self, camera_name: str, frame_index: int) -> str:
        """The image inside its zip."""
        return self._images[camera_name].where(self._member(frame_index, "avif"))

    def encoded_image(self, camera_name: str, frame_index: int) -> bytes:
        """Bytes of the AVIF image. Raises as `Source.encoded_image`."""
        return self._images[camera_name].read(self._member(frame_index, "avif"))

    def segmentation(self, camera_name: str, frame_index: int) -> UInt8[np.ndarray, "H W"] | None:
        """Labels of body parts [H, W], 0 background; None if the capture has none for this camera. Raises as `image`."""
        archive = self._parts.get(camera_name)
        if archive is None:
            return None
        name = self._member(frame_index, "png")
        labels = decode_labels(archive.read(name), archive.where(name))
        self._check_size(labels, camera_name, archive.where(name))
        return labels

    def mask(self, camera_name: str, frame_index: int) -> UInt8[np.ndarray, "H W"] | None:
        """255 wherever any body part is segmented. Raises as `image`."""
        labels = self.segmentation(camera_name, frame_index)
        return None if labels is None else np.where(labels != 0, np.uint8(255), np.uint8(0))

    def vertices(self, frame_index: int) -> Float32[np.ndarray, "V 3"] | None:
        """Registered mesh, metres, world axes."""
        if self._vertices is None:
            return None
        name = self._member(frame_index, "ply")
        vertices, _ = decode_ply(self._vertices.read(name), self._vertices.where(name))
        return turned_points(METRES * vertices, self._world_from_native)

    def keypoints(self, frame_index: int) -> Float32[np.ndarray, "K 4"] | None:
        """3D keypoints in the order of `info.keypoint_names`, metres; confidence 0 where a frame has none."""
        if self._keypoints is None or not self._ids:
            return None
        found = keypoint_rows(self._keypoint_document(self.info.frames[frame_index].number)) or {}
        rows = np.zeros((len(self._ids), 4), np.float32)
        for index, name in enumerate(self._ids):
            if name in found:
                rows[index, :3] = turned_points(METRES * found[name][None, :3], self._world_from_native)[0]
                rows[index, 3] = found[name][3]
        return rows

    def scan(self, frame_index: int) -> tuple[Float32[np.ndarray, "V 3"], Int64[np.ndarray, "F 3"] | None] | None:
        """Scanned surface of a frame, metres, world axes, and its triangles; None if there is none."""
        name = self._member(frame_index, "ply")
        if self._scans is None or name not in self._scans.names:
            return None
        vertices, faces = decode_ply(self._scans.read(name), self._scans.where(name))
        return turned_points(METRES * vertices, self._world_from_native), faces

    def ambient_occlusion(self, frame_index: int) -> Float32[np.ndarray, "S S"] | None:
        """Ambient occlusion of a frame in texture space, 1 where open; None if there is none."""
        name = self._member(frame_index, "png")
        if self._occlusion is None or name not in self._occlusion.names:
            return None
        return decode_labels(self._occlusion.read(name), self._occlusion.where(name)).astype(np.float32) / np.float32(255)

    def mean_ambient_occlusion(self) -> Float32[np.ndarray, "S S"] | None:
        """Mean of `ambient_occlusion`; None if there is none."""
        path = self.path / "uv_image/ambient_occlusion_mean.png"
        return decode_labels(path.read_bytes(), str(path)).astype(np.float32) / np.float32(255) if path.is_file() else None

    def mean_texture(self) -> UInt8[np.ndarray, "S S 3"] | None:
        """Mean texture in the images' values; None if there is none."""
        path = self.path / "uv_image/color_mean.png"
        return decode_image(path.read_bytes(), str(path)) if path.is_file() else None

    @property
    def assets_path(self) -> Path | None:
        """File of the body model: the user's choice, or `find_assets`."""
        return self.options.assets if self.options.assets is not None else find_assets(self.path)

    def pose(self, frame_index: int, count: int | None = None) -> Float64[np.ndarray, "P"] | None:
        """Pose parameters of a frame (104 in the releases: 6 of the root, 98 local); None if the capture has none.

        Raises:
            ValueError: if the file does not hold `count` numbers.
        """
        if self._poses is None:
            return None
        name = self._member(frame_index, "txt")
        return parse_numbers(self._poses.read(name), self._poses.where(name), count)

    @property
    def tracking_is_there(self) -> bool:
        """Whether body model and poses can be read."""
        return self.assets_path is not None and self._poses is not None

    def tracking(self) -> MomentumTracking | None:
        """Body model and all poses; None if either is missing.

        Raises:
            ValueError: if model, template, scales and poses do not fit each other.
        """
        if not self.tracking_is_there:
            return None
        model = load_momentum(self.assets_path)
        scales_path = self.path / "kinematic_tracking/skeleton_scales.txt"
        scales = np.zeros(model.num_scales)
        if scales_path.is_file():
            scales = parse_numbers(scales_path.read_bytes(), str(scales_path), model.num_scales)
        template = self._template(model)
        poses = np.stack([self.pose(index, model.num_pose) for index in range(len(self.info.frames))])
        return MomentumTracking(model, template, scales, poses, self._world_from_native)

    def _template(self, model: MomentumModel) -> Float32[np.ndarray, "V 3"]:
        """Unposed surface of this person; heads' releases name it .obj where the tools ask for .ply."""
        path = self.path / "kinematic_tracking/template_mesh.ply"
        if path.is_file():
            template, _ = decode_ply(path.read_bytes(), str(path))
        elif path.with_suffix(".obj").is_file():
            path = path.with_suffix(".obj")
            lines = [line.split()[1:4] for line in path.read_text(encoding="utf-8-sig").splitlines() if line.startswith("v ")]
            template = np.array(lines, dtype=np.float32).reshape(-1, 3)
        else:
            return model.rest_vertices
        if len(template) != len(model.rest_vertices):
            raise ValueError(
                f"GoliathSource: expected {len(model.rest_vertices)} vertices, those of the body model, in {path}; got {len(template)}. "
                "Take model and capture of one release."
            )
        return template

    @cached_property
    def _images(self) -> dict[str, Archive]:
        """Image archives of the cameras."""
        return {name: Archive(self.path / f"image/cam{name}.zip") for name in self._names}

    @cached_property
    def _parts(self) -> dict[str, Archive]:
        """Segmentation archives; either every camera has one, or those without lose their frames."""
        paths = {name: self.path / f"segmentation_parts/cam{name}.zip" for name in self._names}
        return {name: Archive(path) for name, path in paths.items() if Archive.is_at(path)}

    def _archive(self, name: str) -> Archive | None:
        """An archive that a capture may lack."""
        return Archive(self.path / name) if Archive.is_at(self.path / name) else None

    def _member(self, frame_index: int, extension: str) -> str:
        """File name of a frame."""
        return f"{self.info.frames[frame_index].number:06d}.{extension}"

    def _native_cameras(self) -> tuple[dict[str, Camera], dict[str, Lens], list[str]]:
        """Cameras in metres and the capture's own world; lenses to undo; notes. Sets the names of the cameras to read."""
        path = self.path / CALIBRATION_FILE
        entries = calibration_entries(path)
        folder = self.path / "image"
        recorded = {entry.name.removesuffix(".zip").removeprefix("cam") for entry in folder.glob("cam*")} if folder.is_dir() else set()
        self._names, notes = chosen_cameras(list(entries), recorded, self.options.cameras, self.path)
        cameras, bent = {}, {}
        for name in self._names:
            archive = self._images[name]
            first = min(archive.numbers("avif"), default=None)
            if first is None:
                raise ValueError(f"GoliathSource: expected images NNNNNN.avif in {archive.path}; got none. Copy the zip again.")
            data = archive.read(f"{first:06d}.avif")
            cameras[name] = goliath_camera(name, entries[name], encoded_size(data, archive.where(f"{first:06d}.avif")), path)
            lens = Lens(tuple(float(value) for value in entries[name].get("distortion") or ()))
            if not lens.is_pinhole:
                bent[name] = lens
        if bent and self.options.distortion != "apply":
            notes.append(f"lens distortion of {len(bent)} cameras ignored, as the data set's own tools do (--distortion apply undoes it)")
            bent = {}
        return cameras, bent, notes

    def _world_from_floor_file(self, notes: list[str]) -> Float64[np.ndarray, "4 4"]:
        """World of the ground plane from the capture's own, metres; the identity if the capture does not say. Adds to the notes."""
        path = self.path / "floor_transformation.txt"
        matrix = np.eye(4)
        if path.is_file():
            numbers = parse_numbers(path.read_bytes(), str(path))
            if len(numbers) not in (12, 16):
                raise ValueError(f"GoliathSource: expected 3 or 4 rows of 4 numbers in {path}; got {len(numbers)} numbers. Copy it again.")
            matrix[:3] = numbers[:12].reshape(3, 4)
            matrix[:3, 3] *= METRES
            if not is_rigid(matrix):
                notes.append("floor_transformation.txt ignored: it is no rigid transform")
                return np.eye(4)
        return matrix

    def _frames(self) -> tuple[tuple[Frame, ...], tuple]:
        """Frames that have everything, and the others."""
        splits_path = self.path / "frame_splits_list.csv"
        rows = frame_rows(splits_path, "split")
        if any(split not in ("train", "validation", "test") for split in rows.values()):
            raise ValueError(f"GoliathSource: expected the splits train and test in {splits_path}; got {sorted(set(rows.values()))}.")
        segments_path = self.path / "frame_segments_list.csv"
        segments = frame_rows(segments_path, "segment_name") if segments_path.is_file() else None
        available = {f"image of {name}": archive.numbers("avif") for name, archive in self._images.items()}
        if self._parts:
            available |= {
                f"segmentation of {name}": self._parts[name].numbers("png") if name in self._parts else set() for name in self._names
            }
        if self._poses:
            available["pose"] = self._poses.numbers("txt")
        if self._vertices:
            available["registered mesh"] = self._vertices.numbers("ply")
        numbers, missing = common_frames(list(rows), available, self.path)
        return timed_frames(numbers, self.options.fps or FPS, self.options.test_frames, rows, segments), missing

    def _keypoint_document(self, number: int) -> object:
        """The JSON document of a frame; None if the frame has none."""
        name = f"{number:06d}.json"
        if self._keypoints is None or name not in self._keypoints.names:
            return None
        return parse_json(self._keypoints.read(name), self._keypoints.where(name))

    def _keypoint_ids(self, frames: tuple[Frame, ...]) -> tuple[list[str], str]:
        """Names of all keypoints, and a note if their schema is unknown: nobody documents it, so nothing may depend on it."""
        if self._keypoints is None or self.options.images_only:
            return [], ""
        ids: dict[str, None] = {}
        for frame in frames:
            document = self._keypoint_document(frame.number)
            rows = keypoint_rows(document)
            if rows is None and document is not None:
                return [], f"keypoints left out: unknown schema of {frame.number:06d}.json in {self._keypoints.path}"
            ids |= dict.fromkeys(rows or {})
        return list(ids), ""
