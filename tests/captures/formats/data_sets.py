"""Tiny data sets in other projects' formats, written from their description: known points in space, drawn as spots of known places.

Each frame shows three points, a red, a green and a blue spot, in every camera. Cameras differ in focal lengths, principal points, roll
and, where a format allows it, size and lens. `trap` makes one of the mistakes that the format invites.
"""

import io
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from mitsuba_avatar.captures.cameras import Camera, look_at
from mitsuba_avatar.captures.formats.opencv_yaml import opencv_yaml_text
from mitsuba_avatar.captures.undistortion import Lens, distort_points

FRAMES = 4
SIGMA = 1.8  # pixels of a spot
LENS = Lens((-0.45, 0.12, 0.004, -0.003, 0.0))
Y_UP = Rotation.from_euler("x", -90, degrees=True).as_matrix()  # native_from_ours: our Z is the data set's Y
Y_DOWN = Rotation.from_euler("x", 90, degrees=True).as_matrix()


@dataclass(frozen=True)
class Scene:
    """What is filmed: cameras in our conventions, and points [frames, 3, 3] in our world."""

    cameras: dict[str, Camera]
    points: np.ndarray


def make_scene(names, sizes=((96, 72),)) -> Scene:
    """Three cameras around three moving points."""
    places = ([0.3, -2.4, 1.3], [2.2, 0.4, 0.8], [-1.4, 1.7, 1.6])
    cameras = {}
    for index, (name, place) in enumerate(zip(names, places, strict=True)):
        width, height = sizes[index % len(sizes)]
        pose = look_at(np.array(place), np.array([0.05, -0.02, 0.95]))
        roll = np.eye(4)
        roll[:3, :3] = Rotation.from_euler("z", 3.0 * index - 4.0, degrees=True).as_matrix()
        scale = width / 96
        cameras[name] = Camera(
            name,
            width,
            height,
            (118.0 + 3 * index) * scale,
            (121.0 - index) * scale,
            46.2 * scale + index,
            37.1 * scale - index,
            roll @ pose,
        )
    base = np.array([[0.3, -0.4, 1.3], [-0.45, 0.3, 0.85], [0.3, 0.4, 0.6]])
    points = base + 0.02 * np.arange(FRAMES)[:, None, None] * np.array([1.0, -0.5, 0.7])
    return Scene(cameras, points)


def native_camera(camera: Camera, native_from_ours: np.ndarray) -> Camera:
    """The camera in a turned world."""
    turn = np.eye(4)
    turn[:3, :3] = native_from_ours.T
    return replace(camera, camera_from_world=camera.camera_from_world @ turn)


def draw(camera: Camera, points: np.ndarray, lens: Lens | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Image [H, W, 3] of one spot a channel, and mask [H, W] bool around them."""
    pixels = camera.project(points)[0]
    if lens is not None:
        pixels = distort_points(pixels, camera, lens)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    sigma = SIGMA * camera.width / 96
    spots = [np.exp(-0.5 * ((x - px) ** 2 + (y - py) ** 2) / sigma**2) for px, py in pixels]
    image = np.rint(255 * np.stack(spots, axis=-1)).astype(np.uint8)
    return image, image.max(axis=-1) > 60


def spot_errors(image: np.ndarray, camera: Camera, points: np.ndarray) -> np.ndarray:
    """[3] pixels between each spot's centroid and where the camera projects its point."""
    expected = camera.project(points)[0]
    x, y = np.meshgrid(np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0]) + 0.5)
    errors = []
    for channel in range(3):
        values = image[..., channel].astype(np.float64)
        top = np.unravel_index(values.argmax(), values.shape)
        centre = np.array([top[1] + 0.5, top[0] + 0.5])
        for _ in range(8):  # the window follows the centroid, so that cutting off the spot's flanks does not pull it aside
            weight = values * np.exp(-0.5 * ((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / SIGMA**2)
            centre = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        errors.append(np.hypot(*(centre - expected[channel])))
    return np.array(errors)


def save(path: Path, pixels: np.ndarray) -> None:
    """An image file; JPEG as good as it gets."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"quality": 100, "subsampling": 0} if path.suffix == ".jpg" else {}
    Image.fromarray(pixels).save(path, **options)


def integer_centred(camera: Camera) -> np.ndarray:
    """K [3, 3] with pixel centres at integers."""
    return np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])


def write_actorshq(path: Path, trap: str = "") -> Scene:
    """Actor/Sequence/4x below `path`; the world's Y is up."""
    scene = make_scene(("Cam001", "Cam002", "Cam003"))
    rows = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
    for name, camera in scene.cameras.items():
        native = native_camera(camera, Y_UP)
        pose = native.camera_from_world if trap == "world to camera" else native.world_from_camera
        turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
        shift = 0.5 if trap == "pixel centre" else 0.0
        unit = (1, 1) if trap == "focal in pixels" else (camera.width, camera.height)
        values = [*turn, *pose[:3, 3], camera.fx / unit[0], camera.fy / unit[1]]
        values += [(camera.cx - shift) / unit[0], (camera.cy - shift) / unit[1]]
        rows.append(f"{name},{camera.width},{camera.height}," + ",".join(repr(float(value)) for value in values))
        for frame in range(FRAMES):
            image, mask = draw(camera, scene.points[frame])
            save(path / f"rgbs/{name}/{name}_rgb{frame:06d}.jpg", image)
            save(path / f"masks/{name}/{name}_mask{frame:06d}.png", np.where(mask, 255, 0).astype(np.uint8))
    (path / "calibration.csv").write_text("\ufeff" + "\r\n".join(rows) + "\r\n", encoding="utf-8")
    return scene


def write_easymocap(path: Path, trap: str = "") -> Scene:
    """An EasyMocap folder: bent images, the second camera's twice as large, one rotation as Rodrigues vector, keypoints of two people."""
    scene = make_scene(("01", "cam-b", "3"), sizes=((96, 72), (192, 150), (96, 72)))
    intrinsics, extrinsics = {"names": list(scene.cameras)}, {"names": list(scene.cameras)}
    for index, (name, camera) in enumerate(scene.cameras.items()):
        matrix = integer_centred(camera)
        matrix[:2, 2] += 0.5 if trap == "pixel centre" else 0.0
        intrinsics |= {f"K_{name}": matrix, f"H_{name}": camera.height, f"W_{name}": camera.width}
        intrinsics[f"dist_{name}" if index else f"D_{name}"] = np.array([LENS.coefficients]) * (0 if trap == "distortion" else 1)
        pose = camera.world_from_camera if trap == "camera to world" else camera.camera_from_world
        rotation = pose[:3, :3].T if trap == "transposed" else pose[:3, :3]
        extrinsics[f"R_{name}"] = Rotation.from_matrix(rotation).as_rotvec()[:, None]
        if index:
            extrinsics[f"Rot_{name}"] = rotation
        extrinsics[f"T_{name}"] = pose[:3, 3:]
        for frame in range(FRAMES):
            image, mask = draw(camera, scene.points[frame], LENS)
            save(path / f"images/{name}/{frame:06d}.jpg", image)
            save(path / f"mask/{name}/{frame:06d}.png", mask.astype(np.uint8))
    path.joinpath("intri.yml").write_text(opencv_yaml_text(intrinsics))
    path.joinpath("extri.yml").write_text(opencv_yaml_text(extrinsics))
    (path / "keypoints3d").mkdir()
    for frame in range(FRAMES):
        rows = np.concatenate([scene.points[frame], np.full((3, 1), 0.75)], axis=1)
        people = [{"id": 0, "keypoints3d": rows.tolist()}, {"id": 1, "keypoints3d": (rows + 1).tolist()}]
        (path / f"keypoints3d/{frame:06d}.json").write_text(json.dumps(people))
    return scene


def write_zju(path: Path, trap: str = "") -> Scene:
    """A capture in neuralbody's layout: bent images, translations in millimetres, labels as masks."""
    scene = make_scene(("Camera_B1", "Camera_B2", "Camera_B3"))
    unit = 1.0 if trap == "metres" else 1000.0
    cams = {"K": [], "D": [], "R": [], "T": []}
    for name, camera in scene.cameras.items():
        cams["K"].append(integer_centred(camera) + (np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]) if trap == "pixel centre" else 0))
        cams["D"].append(np.array(LENS.coefficients)[:, None] * (0 if trap == "distortion" else 1))
        cams["R"].append(camera.camera_from_world[:3, :3])
        cams["T"].append(unit * camera.camera_from_world[:3, 3:])
        for frame in range(FRAMES):
            image, mask = draw(camera, scene.points[frame], LENS)
            save(path / f"{name}/{frame:06d}.jpg", image)
            save(path / f"mask_cihp/{name}/{frame:06d}.png", np.where(mask, 5, 0).astype(np.uint8))
    lists = [{"ims": [f"{name}/{frame:06d}.jpg" for name in scene.cameras]} for frame in range(FRAMES)]
    np.save(path / "annots.npy", np.array({"cams": cams, "ims": lists}, dtype=object), allow_pickle=True)
    (path / "vertices").mkdir()
    (path / "params").mkdir()
    for frame in range(FRAMES):
        np.save(path / f"vertices/{frame}.npy", scene.points[frame].astype(np.float32))
        smpl = {"poses": np.zeros((1, 72)), "Rh": np.full((1, 3), 0.1 * frame), "Th": np.ones((1, 3)), "shapes": np.zeros((1, 10))}
        np.save(path / f"params/{frame}.npy", np.array(smpl, dtype=object), allow_pickle=True)
    return scene


def write_avatarrex(path: Path, trap: str = "", is_thuman4: bool = False) -> Scene:
    """AvatarReX (cameras named by serial numbers, a list of missing images) or THuman4.0; the world's Y points down."""
    scene = make_scene(("cam00", "cam01", "cam02") if is_thuman4 else ("22010708", "22010710", "22053907"))
    document = {}
    for name, camera in scene.cameras.items():
        native = native_camera(camera, Y_DOWN)
        pose = native.world_from_camera if trap == "camera to world" else native.camera_from_world
        matrix = integer_centred(camera)
        matrix[:2, 2] += 0.5 if trap == "pixel centre" else 0.0
        document[name] = {"K": matrix.ravel().tolist(), "R": pose[:3, :3].ravel().tolist(), "T": pose[:3, 3].tolist()}
        document[name] |= {} if is_thuman4 else {"imgSize": [camera.width, camera.height], "distCoeff": [0.0] * 5}
        for frame in range(FRAMES):
            image, mask = draw(camera, scene.points[frame])
            folders = (f"images/{name}", f"masks/{name}") if is_thuman4 else (name, f"{name}/mask/pha")
            save(path / f"{folders[0]}/{frame:08d}.jpg", image)
            save(path / f"{folders[1]}/{frame:08d}.jpg", np.where(mask, 255, 0).astype(np.uint8))
    (path / ("calibration.json" if is_thuman4 else "calibration_full.json")).write_text(json.dumps(document))
    if not is_thuman4:
        (path / "missing_img_files.txt").write_text("avatarrex_zzr\\22010710\\00000003.jpg\n")
    np.savez(path / "smpl_params.npz", body_pose=np.zeros((FRAMES, 63)), transl=np.ones((FRAMES, 3)))
    return scene


def write_thuman4(path: Path, trap: str = "") -> Scene:
    """THuman4.0."""
    return write_avatarrex(path, trap, is_thuman4=True)


def write_dna(path: Path, trap: str = "") -> Scene:
    """A subject of DNA-Rendering: bent images in two groups of cameras, poses camera to world, the world's Y up."""
    import h5py

    scene = make_scene(("00", "01", "48"), sizes=((96, 72), (96, 72), (192, 150)))
    with h5py.File(path / "0007_01.smc", "w") as images, h5py.File(path / "0007_01_annots.smc", "w") as annotations:
        for index, (name, camera) in enumerate(scene.cameras.items()):
            native = native_camera(camera, Y_UP)
            group = annotations.create_group(f"Camera_Parameter/{name}")
            group["K"] = integer_centred(camera) + (np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]) if trap == "pixel centre" else 0)
            group["D"] = np.array(LENS.coefficients) * (0 if trap == "distortion" else 1)
            group["RT"] = native.camera_from_world if trap == "world to camera" else native.world_from_camera
            kind = "Camera_12mp" if index == 2 else "Camera_5mp"
            for frame in range(FRAMES):
                image, mask = draw(camera, scene.points[frame], LENS)
                data = encoded(image, "JPEG", quality=100, subsampling=0)
                images[f"{kind}/{int(name)}/color/{frame}"] = np.frombuffer(data, np.uint8)
                data = encoded(np.where(mask, 255, 0).astype(np.uint8), "PNG")
                annotations[f"Mask/{name}/mask/{frame}"] = np.frombuffer(data, np.uint8)
        annotations["Keypoints_3D/keypoints3d"] = scene.points @ Y_UP.T
        annotations["SMPLx/betas"] = np.zeros((FRAMES, 10))
    return scene


WRITERS = {
    "actorshq": write_actorshq,
    "easymocap": write_easymocap,
    "zju": write_zju,
    "avatarrex": write_avatarrex,
    "thuman4": write_thuman4,
    "dna": write_dna,
}


def encoded(pixels, image_format: str, **options) -> bytes:
    """Bytes of an image, from an array or a Pillow image."""
    image = pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)
    buffer = io.BytesIO()
    image.save(buffer, image_format, **options)
    return buffer.getvalue()
