"""A finished run opened for use: avatar, capture, renderer. What the commands that come after `fit` start from."""

from dataclasses import dataclass
from pathlib import Path

from mitsuba_avatar.body.rig import load_rig
from mitsuba_avatar.captures.checks import check_arrays
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion, FrameOcclusion
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.reporting.evaluation import Evaluator
from mitsuba_avatar.training.batches import FrameReader, check_driving
from mitsuba_avatar.training.readiness import open_as_set
from mitsuba_avatar.training.run_folder import RunFolder


@dataclass(frozen=True)
class LoadedRun:
    """An avatar with the capture that drives it."""

    run: RunFolder
    avatar: Avatar
    capture: Capture

    @staticmethod
    def open(path: Path | str, capture_path: str = "", checkpoint: str = "last") -> "LoadedRun":
        """Open a run.

        Args:
            path: run folder.
            capture_path: capture that drives and judges it, a folder or FORMAT:DIR; empty for the one it was trained on.
            checkpoint: "best" or "last".

        Raises:
            FileNotFoundError: run, checkpoint or capture are not there.
            ValueError: the capture has another rig or face signal, or a file is damaged.
        """
        if checkpoint not in ("best", "last"):
            raise ValueError(f"LoadedRun.open(): expected checkpoint 'best' or 'last'; got {checkpoint!r}.")
        run = RunFolder.open(path)
        capture = open_as_set(capture_path, run.settings.capture) if capture_path else run.open_capture()
        rig = load_rig(capture.rig_path)
        run.check_capture(capture, rig)
        check_driving(capture)
        check_arrays(capture, rig)
        return LoadedRun(run, run.load_avatar(checkpoint), capture)

    def trained_capture(self) -> Capture:
        """The capture that the avatar learnt from, which is not always the one that drives it.

        Raises:
            FileNotFoundError, ValueError: it is gone, or cannot be used.
        """
        if self.capture.path.resolve() == self.run.capture_path.resolve():
            return self.capture
        return self.run.open_capture()

    def occlusion(self) -> AmbientOcclusion:
        """Baker of occlusion maps at the size that the avatar reads."""
        return avatar_occlusion(self.run)

    def evaluator(self) -> Evaluator:
        """Draws and measures the capture's views."""
        frame_occlusion = FrameOcclusion(self.occlusion(), self.run.rig, self.avatar.template_vertices, self.capture.theta)
        reader = FrameReader(self.capture, frame_occlusion)
        return Evaluator(self.avatar, reader, self.renderer(reader.width, reader.height))

    def renderer(self, width: int, height: int) -> SurfaceRenderer:
        """Renderer of a film size, with the run's number of samples for final pictures."""
        return SurfaceRenderer(self.run.rig.topology, width, height, samples_per_pixel=self.run.settings.evaluation.samples_per_pixel)


def avatar_occlusion(run: RunFolder) -> AmbientOcclusion:
    """Baker of occlusion maps for a run's avatar."""
    settings = run.settings
    return AmbientOcclusion(
        run.rig.topology,
        settings.model.shadow_size,
        settings.rendering.ambient_occlusion_rays,
        settings.rendering.ambient_occlusion_distance,
    )
