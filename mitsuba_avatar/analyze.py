"""What an avatar has learnt: `python -m mitsuba_avatar.analyze RUN [--capture DIR] [--drives DIR ...] [--out DIR]`.

Prints, and writes to report.json: how much the latent code says and what it tells about the driving signal, what swaps of codes and of
driving signals move, chance correlations, distances from the true surface, and whether pictures darken where the pose hides light. Draws
where controls act, where the avatar is unsure, and what training gained on the registered mesh. Captures given with --drives move the
avatar, as its own test frames do, with every imputation of its latent code.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import atomic_path, check_writable
from mitsuba_avatar.progress import StageProgress
from mitsuba_avatar.rendering import backend

if TYPE_CHECKING:  # these modules load torch and Dr.Jit
    from mitsuba_avatar.analysis.measures import Study
    from mitsuba_avatar.loaded_run import LoadedRun


@dataclass(frozen=True)
class AnalyzeCommand:
    """Measure and draw what a run's avatar has learnt."""

    run: Annotated[Path, tyro.conf.Positional]  # run folder that fit or ablate wrote
    capture: str = ""  # another capture of the same rig; default: the one it was trained on
    drives: tuple[str, ...] = ()  # captures whose test frames drive the avatar, beside its own, with every imputation of the latent code
    out: str = ""  # where report and pictures go; default: RUN/analysis
    checkpoint: str = "last"  # best or last
    frames: int = 40  # of each split that geometry is measured on
    variant: str = "auto"  # Mitsuba variant


@interruptible("analyze", kept="finished files are whole and kept. Give the same command again to write all of them.")
def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(AnalyzeCommand, args=arguments)
    try:
        if command.frames < 1:
            raise ValueError(f"expected --frames of at least 1; got {command.frames}.")
        backend.select_variant(command.variant)
        return _analyze(command)
    except (ValueError, OSError, backend.BackendError) as error:
        sys.stderr.write(f"analyze: {error}\n")
        return 2


def _analyze(command: AnalyzeCommand) -> int:
    # Imported after the variant is set, because these modules load torch and Dr.Jit.
    from mitsuba_avatar.analysis.effects import control_effects, liveliest_controls
    from mitsuba_avatar.analysis.measures import Splits, Study, disentanglement, geometry_errors
    from mitsuba_avatar.analysis.pictures import FieldPainter, save_effects, save_geometry_gain, save_uncertainty
    from mitsuba_avatar.analysis.shading import shading_errors
    from mitsuba_avatar.loaded_run import LoadedRun
    from mitsuba_avatar.rendering.ambient_occlusion import FrameOcclusion

    loaded = LoadedRun.open(command.run, command.capture, command.checkpoint)
    if loaded.capture.vertices is None:
        raise FileNotFoundError(f"expected registered meshes in {loaded.capture.path / 'vertices.npy'}; got none. Give another --capture.")
    folder = Path(command.out) if command.out else Path(command.run) / "analysis"
    folder.mkdir(parents=True, exist_ok=True)
    check_writable(folder)
    with StageProgress() as progress:
        progress.update("encoding", 0, 1)
        study = Study.of(loaded.avatar, loaded.run.rig, loaded.capture)
        progress.update("effects of controls", 0, 1)
        occlusion = FrameOcclusion(loaded.occlusion(), loaded.run.rig, loaded.avatar.template_vertices, loaded.capture.theta)
        occlusion = occlusion if loaded.run.settings.model.use_shadow else None
        effects = control_effects(study, liveliest_controls(study), occlusion)
        progress.update("disentanglement", 0, 1)
        report = {"disentanglement": disentanglement(study), "geometry": geometry_errors(study, command.frames)}
        progress.update("shading", 0, 1)
        report["shading"] = shading_errors(loaded.evaluator(), Splits.of(loaded.capture, command.frames).frames)
        if command.drives:
            report["imputation"] = _imputations(command, loaded, study, progress)
        report["share_outside_region"] = {effect.name: effect.share_outside for effect in effects}
        report["share_recoloured_outside_region"] = {effect.name: effect.share_recoloured_outside for effect in effects}
        with atomic_path(folder / "report.json") as temporary:
            temporary.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        progress.update("pictures", 0, 3)
        painter = FieldPainter(study)
        save_effects(folder / "effects.png", folder / "effects_colour.png", study, painter, effects)
        progress.update("pictures", 1, 3)
        save_geometry_gain(folder / "geometry.png", study, painter)
        progress.update("pictures", 2, 3)
        if study.posterior is not None:
            pictures = folder / "uncertainty_shape.png", folder / "uncertainty_texture.png"
            save_uncertainty(*pictures, study, painter, occlusion)
        progress.update("pictures", 3, 3)
    sys.stdout.write(json.dumps(report, indent=2) + "\n")
    sys.stderr.write(f"Report and pictures are in {folder}\n")
    return 0


def _imputations(command: AnalyzeCommand, loaded: "LoadedRun", study: "Study", progress: StageProgress) -> dict:
    """Folder of each driving capture, the avatar's own first -> its setting, and the figures of every imputation."""
    from mitsuba_avatar.analysis.imputations import drive_of_capture, imputation_figures
    from mitsuba_avatar.driving.training_latents import training_latents

    run, avatar, result = loaded.run, loaded.avatar, {}
    training = training_latents(run, avatar, run.open_capture, command.checkpoint)
    if own := study.frames("test"):
        figures = imputation_figures(study, training, study.drive.chosen(own), exact=study.exact[own])
        result[str(study.capture.path)] = {"setting": "matched", "notes": [], **figures}
    for done, path in enumerate(command.drives):
        progress.update("imputations", done, len(command.drives))
        drive = drive_of_capture(run, avatar, path, training)
        result[path] = {"setting": drive.setting, "notes": list(drive.notes), **imputation_figures(study, training, drive.signals)}
    return result


if __name__ == "__main__":
    sys.exit(main())
