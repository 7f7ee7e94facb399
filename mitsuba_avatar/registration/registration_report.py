"""How well a registration fits: per camera and frame, which frames are kept, and `registration.json`."""

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32

from mitsuba_avatar.body.anny_rig import AnnyPhenotype
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.registration.camera_refinement import RefinedCameras
from mitsuba_avatar.registration.colour_agreement import ColourAgreement
from mitsuba_avatar.registration.frames import FrameFolder
from mitsuba_avatar.registration.keypoint_fit import KeypointEnergy
from mitsuba_avatar.registration.masks import MaskFolder
from mitsuba_avatar.registration.settings import RefinementSettings, RegistrationSettings
from mitsuba_avatar.registration.silhouette_refinement import RegisteredBody, SilhouetteProblem, posed_vertices, sequence_of

REPORT_FILE = "registration.json"
FRAMES_AT_ONCE = 4


@dataclass(frozen=True, eq=False)
class RegistrationQuality:
    """Figures of a registration; N frames, C cameras.

    Attributes:
        cameras: C names.
        keypoint_errors: [N, C] median over landmarks, pixels at a height of 1920, after refinement; NaN where nothing was detected.
        keypoint_errors_before: the same of the fit to keypoints alone.
        overlap_before, overlap_after: [N, C] intersection over union of silhouette and mask.
        is_kept: [N] frames that the capture gets.
    """

    cameras: tuple[str, ...]
    keypoint_errors: Float32[np.ndarray, "N C"]
    keypoint_errors_before: Float32[np.ndarray, "N C"]
    overlap_before: Float32[np.ndarray, "N C"]
    overlap_after: Float32[np.ndarray, "N C"]
    is_kept: Bool[np.ndarray, "N"]

    @property
    def dropped(self) -> list[int]:
        """Frames that were left out."""
        return np.flatnonzero(~self.is_kept).tolist()


def measure(
    bodies: Mapping[str, RegisteredBody],
    frames: FrameFolder,
    masks: MaskFolder,
    energy: KeypointEnergy,
    settings: RefinementSettings,
    progress: Callable[[int, int], None],
) -> RegistrationQuality:
    """Measure the bodies "before" and "after" in all cameras, held-out ones too, and decide which frames to keep.

    Raises:
        ValueError: if fewer than three frames are good enough to be kept; says what is wrong with them.
    """
    names = list(frames.cameras)
    overlaps, errors = {}, {}
    for index, (name, body) in enumerate(bodies.items()):
        sequence = sequence_of(body.fitted)
        problem = SilhouetteProblem(body.rig().topology, frames.cameras, lambda frame: masks.read(names, frame))
        rows = []
        for start in range(0, frames.num_frames, FRAMES_AT_ONCE):
            chosen = list(range(start, min(start + FRAMES_AT_ONCE, frames.num_frames)))
            rows.append(problem.overlaps(posed_vertices(body, sequence, chosen), chosen))
            progress(index * frames.num_frames + chosen[-1] + 1, len(bodies) * frames.num_frames)
        overlaps[name] = np.concatenate(rows)
        with torch.no_grad():
            vertices, joints = sequence.rest()
            errors[name] = _medians(energy.known_errors(sequence.landmarks(vertices, joints, sequence.transforms(joints))))
    overlap = _mean(overlaps["after"])
    keypoints = _mean(errors["after"])
    # Frames without a single detection are carried by their neighbours; silhouettes alone judge them.
    is_kept = (overlap >= settings.least_overlap) & ~(keypoints > settings.largest_keypoint_error)
    if is_kept.sum() < 3:
        raise ValueError(
            f"measure(): expected frames that the body fits (silhouettes overlap by {settings.least_overlap}, keypoints within "
            f"{settings.largest_keypoint_error} pixels); got {int(is_kept.sum())} of {len(is_kept)}, overlap {np.nanmean(overlap):.2f}, "
            f"median keypoint error {np.nanmedian(keypoints):.0f} pixels. Look at the masks in .registration/, check the calibration, or "
            "loosen refinement.least_overlap."
        )
    return RegistrationQuality(tuple(names), errors["after"], errors["before"], overlaps["before"], overlaps["after"], is_kept)


def write_report(
    out: Path,
    quality: RegistrationQuality,
    refined: RefinedCameras,
    fitted_phenotype: AnnyPhenotype,
    phenotype: AnnyPhenotype,
    settings: RegistrationSettings,
    colour: ColourAgreement,
) -> None:
    """Write `registration.json`: medians and means over the kept frames, per camera too, dropped frames, corrections, settings."""
    document = summary(quality) | {
        "frames_dropped": quality.dropped,
        "colour": {
            "correction": colour.correction,
            "reference": colour.reference,
            "disagreement": {kind: _rounded(value) for kind, value in colour.candidates.items()},
        },
        "cameras": {
            name: {
                "is_held_out": name in settings.output.held_out_cameras,
                **_figures(quality, [index]),
                "turned_degrees": round(float(np.degrees(refined.turned[name])), 3),
                "shifted_metres": round(refined.shifted[name], 4),
                "colour_disagreement_before": _rounded(colour.before[name]),
                "colour_disagreement_after": _rounded(colour.after[name]),
                "colour_samples": colour.samples[name],
            }
            for index, name in enumerate(quality.cameras)
        },
        "phenotype_before": dataclasses.asdict(fitted_phenotype),
        "phenotype": dataclasses.asdict(phenotype),
        "settings": dataclasses.asdict(settings),
    }
    with atomic_path(out / REPORT_FILE) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def summary(quality: RegistrationQuality) -> dict[str, float | int]:
    """The figures over all cameras and kept frames."""
    figures = _figures(quality, list(range(len(quality.cameras))))
    return figures | {"frames_kept": int(quality.is_kept.sum()), "frames": len(quality.is_kept)}


def _rounded(levels: float) -> float | None:
    """For JSON, which has no NaN."""
    return round(levels, 2) if np.isfinite(levels) else None


def _figures(quality: RegistrationQuality, cameras: list[int]) -> dict[str, float | None]:
    kept = np.flatnonzero(quality.is_kept)

    def of(values: Float32[np.ndarray, "N C"], statistic: Callable) -> float | None:
        chosen = values[np.ix_(kept, cameras)]
        return round(float(statistic(chosen)), 4) if np.isfinite(chosen).any() else None

    return {
        "keypoint_px_median_before": of(quality.keypoint_errors_before, np.nanmedian),
        "keypoint_px_median": of(quality.keypoint_errors, np.nanmedian),
        "iou_before": of(quality.overlap_before, np.nanmean),
        "iou_after": of(quality.overlap_after, np.nanmean),
    }


def _medians(errors: Float32[np.ndarray, "N C K"]) -> Float32[np.ndarray, "N C"]:
    """Median over landmarks, NaN where there is none."""
    medians = np.full(errors.shape[:2], np.nan, np.float32)
    known = np.isfinite(errors).any(axis=2)
    medians[known] = np.nanmedian(errors[known], axis=1)
    return medians


def _mean(values: Float32[np.ndarray, "N C"]) -> Float32[np.ndarray, "N"]:
    """Mean over cameras, NaN where none has a value."""
    means = np.full(len(values), np.nan, np.float32)
    known = np.isfinite(values).any(axis=1)
    means[known] = np.nanmean(values[known], axis=1)
    return means
