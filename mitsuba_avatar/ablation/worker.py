"""One run of an ablation in a process of its own: `python -m mitsuba_avatar.ablation.worker ROW FOLDER THREADS`.

Started by `ablation.schedule`, with the settings in FOLDER/planned.yaml. Trains (or goes on training), measures, and leaves measures.json.
"""

import dataclasses
import sys
from pathlib import Path

from mitsuba_avatar.ablation.plan import PLANNED, PlannedRun
from mitsuba_avatar.ablation.rows import choose_rows
from mitsuba_avatar.presets import load_settings
from mitsuba_avatar.rendering import backend


def main(arguments: list[str]) -> int:
    """Run the worker; returns the exit status, 130 where it was interrupted and has saved."""
    name, folder, threads = arguments
    settings = load_settings(Path(folder) / PLANNED)
    variant = backend.select_variant(settings.rendering.variant)
    settings = dataclasses.replace(settings, rendering=dataclasses.replace(settings.rendering, variant=variant))
    _limit_threads(int(threads))
    return _work(PlannedRun(choose_rows(name)[0], settings, Path(folder)))


def _limit_threads(threads: int) -> None:
    """Keep to a share of the cores, so that workers beside each other do not fight for them."""
    # Load torch and Dr.Jit: only after the variant is set.
    import drjit
    import torch

    torch.set_num_threads(threads)
    drjit.set_thread_count(threads)


def _work(run: PlannedRun) -> int:
    from mitsuba_avatar.analysis.measures import Splits, Study, disentanglement, geometry_errors, image_errors
    from mitsuba_avatar.analysis.shading import shading_errors
    from mitsuba_avatar.fitting import Fit
    from mitsuba_avatar.progress import progress_bar
    from mitsuba_avatar.rendering.surface import SurfaceRenderer
    from mitsuba_avatar.reporting.evaluation import Evaluator
    from mitsuba_avatar.training.distributed import Process

    fit = Fit.prepare(run.settings, run.path, Process(), is_resumed=run.is_begun)
    if not fit.train():
        return 130
    avatar = fit.run.load_avatar("last")
    most = run.settings.evaluation.frames_per_split
    measures = {
        "name": run.row.name,
        "seed": run.settings.training.seed,
        "iterations": run.settings.training.iterations,
        "mixed_precision": fit.avatar.mixed_precision,
        "training_seconds": fit.trainer.seconds,
        "num_skipped": fit.trainer.guard.num_skipped,
        "parameters": sum(parameter.numel() for parameter in avatar.parameters()),
    }
    digest = run.noted_digest()
    if digest is not None:
        measures["capture_digest"] = digest
    study = None if fit.capture.vertices is None else Study.of(avatar, fit.run.rig, fit.capture)
    if run.settings.loss.looks_at_images:
        samples = run.settings.evaluation.samples_per_pixel
        renderer = SurfaceRenderer(fit.run.rig.topology, fit.reader.width, fit.reader.height, samples)
        evaluator, splits = Evaluator(avatar, fit.reader, renderer), Splits.of(fit.capture, most)
        with progress_bar("measuring pictures", sum(map(len, splits.frames.values()))) as bar:
            measures["images"] = image_errors(evaluator, splits, bar.update)
        mean_code = None if study is None else study.mean_code()
        if mean_code is not None:
            with progress_bar("measuring pictures with the mean code", sum(map(len, splits.frames.values()))) as bar:
                measures["images_mean_code"] = image_errors(evaluator, splits, bar.update, mean_code)
        measures["shading"] = shading_errors(evaluator, {name: splits.frames[name] for name in ("train", "test") if name in splits.frames})
    if study is not None:
        measures["geometry"] = geometry_errors(study, most)
        measures["disentanglement"] = disentanglement(study, run.settings.training.seed)
    run.save_measures(measures)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
