"""Filming: from settings to a capture on disk. Interrupted filming goes on where it stopped; the same settings give the same capture.

    settings -> person -> motion -> simulated garment -> surfaces of a frame -> cameras -> images

Images may be made in any order and by several processes, each with its shard; the process that finds all of them made finishes the
capture. What made them is kept in `truth/`, which no reader of captures opens. The capture's rig has the dressed person's mean rest shape
over the training frames as its template, so that skinning the template alone already fits the clothes on average.
"""

import dataclasses
import hashlib
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from numpy.lib.format import open_memmap

from mitsuba_avatar.body.driving import face_keypoints
from mitsuba_avatar.body.rig import Rig, save_rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.captures.arrays import save_frame_array
from mitsuba_avatar.captures.colour import decode_bytes, encode_bytes
from mitsuba_avatar.captures.description import CaptureDescription
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.writer import CaptureWriter
from mitsuba_avatar.files import atomic_path, cache_folder
from mitsuba_avatar.filming.cameras import DomeCameras, place_cameras
from mitsuba_avatar.filming.capture_info import log_filming, measure_gates, write_info
from mitsuba_avatar.filming.colour_chart import film_charts
from mitsuba_avatar.filming.contact_sheet import save_contact_sheet
from mitsuba_avatar.filming.hidden_state import HiddenState
from mitsuba_avatar.filming.performance import Performance
from mitsuba_avatar.filming.person import with_template
from mitsuba_avatar.filming.plan import Shard
from mitsuba_avatar.filming.sensor import Sensor
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.filming.stage import Stage
from mitsuba_avatar.filming.tracking_noise import tracking_noise
from mitsuba_avatar.filming.truth import TRUTH_FOLDER, OcclusionTruth, write_truth
from mitsuba_avatar.resources import find_resource

FILMING_VERSION = 6  # raised when what filming makes of the same settings changes, so that older cached captures are not taken
CONTACT_SHEET = "contact_sheet.png"
OUTLINE_FRAMES = 200  # that decide where cameras look
Progress = Callable[[str, int, int], None]  # what is done, steps done, steps in all


def default_capture_path(settings: StudioSettings) -> Path:
    """Where the capture of these settings is kept: in the cache folder, under name and a hash of every setting."""
    text = f"{FILMING_VERSION} {sorted(dataclasses.asdict(settings).items())}"
    return cache_folder() / "captures" / f"{settings.name}-{hashlib.sha256(text.encode()).hexdigest()[:10]}"


def film_capture(
    settings: StudioSettings, folder: Path | str, progress: Progress | None = None, shard: Shard | None = None
) -> Capture | None:
    """Film a capture into a folder, or go on with one that was begun there.

    Args:
        settings: what to film.
        folder: new, or holding an unfinished capture of the same settings. A finished one of the same settings is returned as it is.
        progress: called after every step of a long stage.
        shard: which images to make; None makes all.

    Returns:
        the finished capture; None while images of other shards are missing.

    Raises:
        FileExistsError: if the folder holds something else.
        ValueError: if a garment explodes, in the frames that the shard needs; none of the shard's images is made.
        OSError: no write permission, disk full.
    """
    folder = Path(folder)
    if _is_filmed(folder, settings):
        return Capture.open(folder)
    find_resource("scenes", settings.light.scene, ".xml")  # a wrong name is told before the work, not after
    return _Filming(settings, folder, progress or _silent, shard or Shard()).run()


def rehearse(settings: StudioSettings, folder: Path | str, progress: Progress) -> tuple[HiddenState, dict[str, float]]:
    """Simulate all garments of a capture, which `film_capture` finds in the folder, and measure what it could show; see `measure_gates`.

    Of a finished capture of the same settings, whose garments are kept, it measures what it does show.

    Raises:
        as `film_capture`, and ValueError if there are no test frames to score on.
    """
    folder = Path(folder)
    if _is_filmed(folder, settings):
        return measure_gates(Performance(settings, folder / TRUTH_FOLDER), progress)
    return measure_gates(_Filming(settings, folder, progress, Shard()).performance, progress)


def _silent(stage: str, done: int, total: int) -> None:
    """Progress that nobody watches."""


class _Filming:
    """One process's part in filming a capture."""

    def __init__(self, settings: StudioSettings, folder: Path, progress: Progress, shard: Shard):
        self.settings, self.folder, self.progress = settings, folder, progress
        self.performance = Performance(settings, folder / TRUTH_FOLDER)
        count = len(self.performance)
        framed = [index for index, frame in enumerate(self.performance.motion.frames) if frame.purpose != "stress"]
        outline = np.unique(np.linspace(0, len(framed) - 1, min(len(framed), OUTLINE_FRAMES)).round().astype(int))
        self.dome = place_cameras(self.performance.body_outline([framed[place] for place in outline]), settings)
        rig = self.performance.person.rig
        description = _describe(rig, self.performance.person.action_names, self.dome, settings)
        self.writer = CaptureWriter(folder, description, self.dome.cameras, self.performance.motion.frames)
        self.images = shard.images(count, len(self.dome.cameras))

    def run(self) -> Capture | None:
        """Simulate, film, and finish if nothing is missing then."""
        started = time.perf_counter()
        made = 0
        try:
            person = self.performance.person
            garment = None if person.outfit is None else person.outfit.mesh.body_vertices
            write_truth(self.folder, person.layers, garment, list(self.dome.cameras), self.settings)
            self.performance.simulate_missing(list(self.images), lambda done, total: self.progress("simulating cloth", done, total))
            for _ in self._film():
                made += 1
            if self.settings.cameras.chart_samples_per_pixel and not (self.folder / "chart" / "chart.json").is_file():
                film_charts(self.folder / "chart", self.dome.cameras, self.settings)
        finally:
            log_filming(self.folder / TRUTH_FOLDER, time.perf_counter() - started, made)
        return self._finish() if self.writer.has_all() else None

    def _film(self) -> Iterator[int]:
        """Make the images that are missing; yields after each frame."""
        names, person = list(self.dome.cameras), self.performance.person
        missing = {frame: [index for index in cameras if not self._has(names[index], frame)] for frame, cameras in self.images.items()}
        if not any(missing.values()):
            return
        stage = Stage(person.layers, list(self.dome.cameras.values()), self.settings)
        sensor, backdrop = Sensor.of(self.settings), np.float32(_backdrop(self.settings))
        size = self.settings.light.occlusion_size
        occlusion = OcclusionTruth(self.folder, person.rig.topology, size) if size else None
        # Encoding an image takes a core for a while, in which the next ones can be traced.
        with ThreadPoolExecutor(max_workers=1) as encoder:
            writing: Future[None] | None = None
            for done, (frame, cameras) in enumerate(missing.items()):
                if cameras:
                    surfaces = self.performance.surfaces(frame)
                    if occlusion is not None:
                        occlusion.write(frame, surfaces.registered)
                    shots = stage.images(surfaces.layers, self.settings.seed * 1_000_003 + frame, cameras)
                    for index, (radiance, coverage) in zip(cameras, shots, strict=True):
                        if writing is not None:
                            writing.result()  # raises what went wrong there; and images that wait do not pile up
                        writing = encoder.submit(self._keep, names[index], frame, sensor, radiance, coverage, backdrop)
                self.progress("filming", done + 1, len(missing))
                yield frame
            if writing is not None:
                writing.result()

    def _keep(
        self,
        camera: str,
        frame: int,
        sensor: Sensor,
        radiance: Float32[np.ndarray, "H W 3"],
        coverage: Float32[np.ndarray, "H W"],
        backdrop: np.float32,
    ) -> None:
        """Record one image by its camera's sensor and write it, the mask first."""
        index = list(self.dome.cameras).index(camera)
        recorded = sensor.record((radiance + (1 - coverage[..., None]) * backdrop)[None], frame, [index])[0]
        self.writer.write_mask(camera, frame, coverage)
        self.writer.write_image(camera, frame, encode_bytes(recorded, "srgb"))

    def _has(self, camera: str, frame: int) -> bool:
        return self.writer.has_image(camera, frame) and self.writer.has_mask(camera, frame)

    def _finish(self) -> Capture:
        """Arrays, rig, figures; then the capture is declared whole."""
        performance, writer = self.performance, self.writer
        rig, count = performance.person.rig, len(performance)
        train = [index for index, frame in enumerate(performance.motion.frames) if frame.split == "train"]
        with tempfile.TemporaryDirectory(dir=self.folder / TRUTH_FOLDER) as scratch:
            shape = (count, rig.topology.num_vertices, 3)
            registered, rest = (open_memmap(f"{scratch}/{name}.npy", "w+", np.float32, shape) for name in ("registered", "rest"))
            for frame in range(count):
                surfaces = performance.surfaces(frame)
                registered[frame], rest[frame] = surfaces.registered, surfaces.rest
                self.progress("collecting surfaces", frame + 1, count)
            dressed = with_template(rig, sum(rest[index].astype(np.float64) / len(train) for index in train).astype(np.float32))
            self._write_arrays(dressed, registered, rest)
            save_rig(writer.path / writer.description.rig, dressed)
            write_info(self.folder, performance, rest)
        capture = writer.finish()
        save_contact_sheet(capture, self.folder / CONTACT_SHEET)
        return capture

    def _write_arrays(self, rig: Rig, registered: np.ndarray, rest: np.ndarray) -> None:
        """Pose, face signal, keypoints and registered surface; where that has tracking noise, the exact one goes to the truth."""
        settings, motion = self.settings, self.performance.motion
        with torch.no_grad():
            face = face_keypoints(rig, torch.from_numpy(rest)).numpy()
            skeleton = Skeleton(rig)
            joints = skeleton.posed_joints(skeleton(torch.from_numpy(motion.theta), torch.from_numpy(motion.root))).numpy()
        joints = joints[:, rig.keypoint_joints]
        keypoints = np.concatenate([joints, np.ones_like(joints[..., :1])], axis=-1)
        if settings.motion.face_signal == "action_codes":
            face = motion.actions
        if settings.clothing.tracking_noise:
            save_frame_array(self.folder / TRUTH_FOLDER, "vertices", registered, len(registered))
            for order, segment in enumerate(motion.segments()):
                exact = np.array(registered[segment])
                registered[segment] = exact + tracking_noise(
                    self.performance.person.anatomy,
                    exact,
                    [slice(0, len(exact))],
                    settings.motion.fps,
                    settings.clothing.tracking_noise,
                    settings.seed + order,
                )
        with atomic_path(self.folder / TRUTH_FOLDER / "actions.npy") as temporary:
            np.save(temporary, motion.actions)
        self.writer.write_arrays(theta=motion.theta, root=motion.root, face=face, keypoints=keypoints, vertices=registered)


def _describe(rig: Rig, action_names: tuple[str, ...], dome: DomeCameras, settings: StudioSettings) -> CaptureDescription:
    """What capture.yaml says."""
    axes = tuple(f"{name}_{axis}" for name in rig.face_keypoint_names for axis in "xyz")
    return CaptureDescription(
        name=settings.name,
        fps=settings.motion.fps,
        colour_curve="srgb",
        lighting={"scene": settings.light.scene},
        background=(_backdrop(settings),) * 3,
        face_signal=settings.motion.face_signal,
        face_names=axes if settings.motion.face_signal == "keypoints" else action_names,
        keypoint_names=rig.keypoint_names,
        held_out_cameras=dome.held_out,
        licence="CC0-1.0",
        source=_signature(settings),
    )


def _backdrop(settings: StudioSettings) -> float:
    """The backdrop's linear radiance, as the nearest 8-bit value: images then hold exactly what the description says."""
    return float(decode_bytes(encode_bytes(np.array([settings.light.background]), "srgb"), "srgb")[0])


def _signature(settings: StudioSettings) -> str:
    """Says in the capture what made it, so that a finished capture is recognised."""
    return f"mitsuba_avatar.studio {default_capture_path(settings).name}"


def _is_filmed(folder: Path, settings: StudioSettings) -> bool:
    """Whether a folder holds a finished capture of these settings."""
    return (folder / "capture.yaml").is_file() and Capture.open(folder).description.source == _signature(settings)
