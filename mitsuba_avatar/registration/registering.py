"""One registration from videos to capture: the stages in their order, each kept on disk, so that an interrupted one goes on.

Beside the capture's own files the folder gets `diagnostics.mp4` (the registered mesh over all views) and `registration.json`; what the
stages need for resuming is in `.registration/`.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32

from mitsuba_avatar.body.anny_rig import AnnyPhenotype, build_anny_rig
from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.captures.colour_calibration import CHART_FILE, calibrate_cameras
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.registration.body_shape import PARAMETERS
from mitsuba_avatar.registration.camera_refinement import RefinedCameras, refine_cameras, unrefined
from mitsuba_avatar.registration.capture_output import split_of, write_capture
from mitsuba_avatar.registration.colour_agreement import ColourAgreement, agree, read_agreement, stored_agreement
from mitsuba_avatar.registration.colour_samples import ColourSampler, shared_colours
from mitsuba_avatar.registration.frames import FrameFolder, capture_cameras, full_cameras, undistort_videos
from mitsuba_avatar.registration.keypoint_fit import FittedBody, KeypointEnergy, fit_keypoints
from mitsuba_avatar.registration.keypoints_3d import PersonKeypoints, find_person, triangulate_person
from mitsuba_avatar.registration.masks import MaskFolder, copy_given_masks, write_masks
from mitsuba_avatar.registration.recording import Recording
from mitsuba_avatar.registration.registration_report import RegistrationQuality, measure, write_report
from mitsuba_avatar.registration.settings import RegistrationSettings
from mitsuba_avatar.registration.silhouette_refinement import (
    POSE_SCALE,
    RegisteredBody,
    SilhouetteProblem,
    posed_vertices,
    refine_offsets,
    refine_pose,
    sequence_of,
)
from mitsuba_avatar.registration.stage_folder import StageFolder, stage_key

WORK_FOLDER = ".registration"
CHART_FOLDER = "chart"
COLOUR_FRAMES = 50  # at most, evenly spaced, that tell of the cameras' colours
# Called with the name of the stage, how much is done, and out of how much.
Progress = Callable[[str, int, int], None]


class Registration:
    """A registration of one recording into one folder.

    Args:
        recording: checked parts.
        settings: of all stages.
        out: the capture's folder.
        progress: called as progress(stage, done, total).

    Raises:
        ValueError: if a held-out camera is not in the recording, or no camera is left to fit to.
    """

    def __init__(self, recording: Recording, settings: RegistrationSettings, out: Path, progress: Progress):
        self.recording, self.settings, self.out, self.progress = recording, settings, out, progress
        unknown = sorted(set(settings.output.held_out_cameras) - set(recording.views))
        if unknown or len(recording.views) <= len(settings.output.held_out_cameras):
            raise ValueError(
                f"Registration(): expected output.held_out_cameras among {sorted(recording.views)}, and some left to learn from; got "
                f"{list(settings.output.held_out_cameras)}. Correct the names."
            )
        reference = settings.output.colour_reference
        if reference and (reference not in recording.views or reference in settings.output.held_out_cameras):
            raise ValueError(
                f"Registration(): expected output.colour_reference among the cameras that train, of {sorted(recording.views)}; got "
                f"{reference!r}. Name one that is not held out, or leave it empty."
            )
        self.stages = StageFolder(out / WORK_FOLDER)
        self.source_key = stage_key([_stamp(path) for view in recording.views.values() for path in (view.video, *view.masks)])
        cameras = capture_cameras(recording, settings.output.width, settings.output.height)
        self._calibrated, self._calibrated_full = cameras, full_cameras(recording, cameras)

    def run(self) -> tuple[Capture, RegistrationQuality]:
        """All stages; returns the capture and how well it fits."""
        person, refined, key = self._keypoints()
        cameras, full = refined.apply(self._calibrated), refined.apply(self._calibrated_full)
        fitted, key = self._fit(person, list(full.values()), key)
        frames = self._frames(cameras)
        energy = KeypointEnergy(list(full.values()), person.observations, self.recording.fps, self.settings.pose, self.settings.body)
        body, masks, key = self._refine(fitted, frames, energy, key)
        before = RegisteredBody(fitted, np.zeros_like(body.shared_offset), np.zeros_like(body.frame_offsets))
        bodies = {"before": before, "after": body}
        quality = measure(bodies, frames, masks, energy, self.settings.refinement, lambda *done: self.progress("measure", *done))

        colour = self._colour(body, frames, masks, np.flatnonzero(quality.is_kept).tolist(), key)

        def report() -> None:
            write_report(self.out, quality, refined, fitted.phenotype, body.fitted.phenotype, self.settings, colour)

        parts = (frames, masks, person, quality, colour)
        write = self.settings.output
        capture = write_capture(self.out, self.recording, write, body, parts, lambda *done: self.progress("write", *done), report)
        return capture, quality

    def _keypoints(self) -> tuple[PersonKeypoints, RefinedCameras, str]:
        settings = self.settings.keypoints
        stamps = [_stamp(path) for view in self.recording.views.values() for path in view.keypoints]
        cameras = [(name, dataclasses.astuple(camera)) for name, camera in self._calibrated_full.items()]
        key = stage_key(settings, stamps, cameras)
        names = list(self._calibrated)

        def make() -> dict[str, np.ndarray]:
            person = find_person(self.recording, self._calibrated_full, settings, lambda *done: self.progress("keypoints", *done))
            refined = unrefined(self._calibrated_full)
            if settings.refines_cameras:
                refined = refine_cameras(self._calibrated_full, person, settings.camera_turn, settings.camera_shift)
                full = list(refined.apply(self._calibrated_full).values())
                person = triangulate_person(full, person.observations, person.order, settings)
            return {
                "order": np.array(person.order),
                "observations": person.observations,
                "positions": person.positions,
                "poses": np.stack([refined.camera_from_world[name] for name in names]),
                "turned": np.array([refined.turned[name] for name in names]),
                "shifted": np.array([refined.shifted[name] for name in names]),
            }

        stored = self.stages.arrays("keypoints", key, make)
        person = PersonKeypoints(str(stored["order"]), stored["observations"], stored["positions"])
        poses, turned, shifted = (
            dict(zip(names, values, strict=True)) for values in (stored["poses"], stored["turned"].tolist(), stored["shifted"].tolist())
        )
        return person, RefinedCameras(poses, turned, shifted), key

    def _fit(self, person: PersonKeypoints, full: list[Camera], key: str) -> tuple[FittedBody, str]:
        pose, body = self.settings.pose, self.settings.body
        key = stage_key(key, pose, body)

        def make() -> dict[str, np.ndarray]:
            fitted = fit_keypoints(full, person, self.recording.fps, pose, body, lambda *done: self.progress("pose and shape", *done))
            return _stored_fit(fitted)

        return _read_fit(self.stages.arrays("fit", key, make)), key

    def _frames(self, cameras: dict[str, Camera]) -> FrameFolder:
        output = self.settings.output
        # Corrections move cameras, which changes no pixel; another lens does.
        lenses = [
            dataclasses.astuple(dataclasses.replace(view.camera, camera_from_world=np.eye(4))) for view in self.recording.views.values()
        ]
        key = stage_key(self.source_key, lenses, output.width, output.height)
        frames = FrameFolder(self.stages.path / f"frames_{key}", cameras, self.recording.num_frames)
        if not self.stages.is_done("frames", key):
            undistort_videos(self.recording, frames, lambda *done: self.progress("undistort", *done))
            self.stages.mark_done("frames", key)
        return frames

    def _refine(self, fitted: FittedBody, frames: FrameFolder, energy: KeypointEnergy, key: str) -> tuple[RegisteredBody, MaskFolder, str]:
        """Rounds of cutting out and refining; the last one adds offsets."""
        settings, output = self.settings, self.settings.output
        num_vertices = build_anny_rig(fitted.phenotype).topology.num_vertices
        body = RegisteredBody(fitted, _zeros(num_vertices), _zeros(len(fitted.theta), num_vertices))
        everywhere = list(frames.cameras)
        uses_all = settings.refinement.uses_held_out_cameras
        seen = [name for name in everywhere if uses_all or name not in output.held_out_cameras]
        rounds = 1 if self.recording.has_masks else settings.masks.rounds
        for index in range(rounds):
            key = stage_key(key, settings.masks, self.source_key, output.width, output.height)
            masks = self._masks(body, frames, key, index)
            key = stage_key(key, settings.refinement, seen)
            problems = {scale: _problem(fitted, frames, masks, seen, scale) for scale in (POSE_SCALE, 1.0)}
            is_last = index == rounds - 1

            def make(body=body, problems=problems, index=index, is_last=is_last) -> dict[str, np.ndarray]:
                name = f"silhouettes {index + 1}"
                posed = refine_pose(
                    body.fitted, problems[POSE_SCALE], energy, settings.refinement, settings.body, lambda *d: self.progress(name, *d)
                )
                result = RegisteredBody(posed, body.shared_offset, body.frame_offsets)
                if is_last and settings.refinement.offset_passes:
                    result = refine_offsets(result, problems[1.0], energy, settings.refinement, lambda *d: self.progress("offsets", *d))
                return _stored_fit(result.fitted) | {"shared_offset": result.shared_offset, "frame_offsets": result.frame_offsets}

            stored = self.stages.arrays(f"refined_{index + 1}", key, make)
            body = RegisteredBody(_read_fit(stored), stored["shared_offset"], stored["frame_offsets"])
        return body, masks, key

    def _colour(self, body: RegisteredBody, frames: FrameFolder, masks: MaskFolder, kept: list[int], key: str) -> ColourAgreement:
        """Corrections of the cameras' colours, from frames that train; those for testing have no say."""
        output, chart = self.settings.output, _chart_corrections(self.recording)
        training = [number for index, number in enumerate(kept) if split_of(index, len(kept), output.test_share) == "train"] or kept
        chosen = training[:: -(-len(training) // COLOUR_FRAMES)]
        names = list(frames.cameras)
        charted = None if chart is None else [(name, chart[name].tolist()) for name in names]
        key = stage_key(key, chosen, output.held_out_cameras, output.colour_correction, output.colour_reference, charted)

        def make() -> dict[str, np.ndarray]:
            sampler, sequence = ColourSampler(body.rig(), frames.cameras), sequence_of(body.fitted)

            def look(frame: int) -> tuple[np.ndarray, np.ndarray]:
                images = np.stack([frames.image(name, frame) for name in names])
                return sampler.look(posed_vertices(body, sequence, [frame])[0], images, masks.read(names, frame))

            shared = shared_colours(names, chosen, look, lambda *done: self.progress("colour", *done))
            use_chart = chart if output.colour_correction == "auto" else None
            return stored_agreement(agree(shared, output.held_out_cameras, output.colour_correction, output.colour_reference, use_chart))

        return read_agreement(self.stages.arrays("colour", key, make))

    def _masks(self, body: RegisteredBody, frames: FrameFolder, key: str, index: int) -> MaskFolder:
        masks = MaskFolder(self.stages.path / f"masks_{key}")
        name = f"masks_{index + 1}"
        if self.stages.is_done(name, key):
            return masks
        if self.recording.has_masks:
            copy_given_masks(masks, frames, lambda *done: self.progress("masks", *done))
        else:
            sequence = sequence_of(body.fitted)
            problem = _problem(body.fitted, frames, masks, list(frames.cameras), 1.0)

            def pose(chosen: list[int]) -> torch.Tensor:
                return posed_vertices(body, sequence, chosen)

            write_masks(masks, frames, problem, pose, self.settings.masks, lambda *d: self.progress(f"masks {index + 1}", *d))
        self.stages.mark_done(name, key)
        return masks


def _chart_corrections(recording: Recording) -> dict[str, np.ndarray] | None:
    """Corrections from pictures of a colour chart, if there are any.

    Raises:
        ValueError: if a camera has no picture of it.
    """
    folder = recording.path / CHART_FOLDER
    if not (folder / CHART_FILE).is_file():
        return None
    corrections = calibrate_cameras(folder, "srgb")
    missing = sorted(set(recording.views) - set(corrections))
    if missing:
        raise ValueError(
            f"Registration(): expected every camera in {folder / CHART_FILE}; got none of {missing}. Photograph the chart with them too, "
            f"or take {CHART_FOLDER}/ away."
        )
    return corrections


def _problem(fitted: FittedBody, frames: FrameFolder, masks: MaskFolder, names: list[str], scale: float) -> SilhouetteProblem:
    cameras = {name: frames.cameras[name] for name in names}
    return SilhouetteProblem(build_anny_rig(fitted.phenotype).topology, cameras, lambda frame: masks.read(names, frame), scale)


def _stored_fit(fitted: FittedBody) -> dict[str, np.ndarray]:
    phenotype = np.array([getattr(fitted.phenotype, name) for name in PARAMETERS])
    return {"phenotype": phenotype, "theta": fitted.theta, "root": fitted.root, "landmark_offsets": fitted.landmark_offsets}


def _read_fit(stored: dict[str, np.ndarray]) -> FittedBody:
    phenotype = AnnyPhenotype(**dict(zip(PARAMETERS, stored["phenotype"].tolist(), strict=True)))
    return FittedBody(phenotype, stored["theta"], stored["root"], stored["landmark_offsets"])


def _zeros(*shape: int) -> Float32[np.ndarray, "*shape 3"]:
    return np.zeros((*shape, 3), np.float32)


def _stamp(path: Path) -> tuple[str, int, int]:
    """What tells that a file is the one that was read."""
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns
