"""Parts of a fit to the drawn capture, and a maker of trainers."""

from collections.abc import Callable

import pytest
import torch

from mitsuba_avatar.body.rig import Rig, load_rig
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.model.avatar import Avatar, DrivingStatistics
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.rendering.ambient_occlusion import AmbientOcclusion, FrameOcclusion
from mitsuba_avatar.training.batches import FrameReader
from mitsuba_avatar.training.distributed import Process
from mitsuba_avatar.training.loop import Trainer
from mitsuba_avatar.training.statistics import training_statistics
from tests.drawn_capture import with_small_camera


@pytest.fixture(scope="session")
def rig(drawn_capture: Capture) -> Rig:
    return load_rig(drawn_capture.rig_path)


@pytest.fixture(scope="session")
def statistics(drawn_capture: Capture, rig: Rig) -> DrivingStatistics:
    return training_statistics(drawn_capture, rig, resolve("tiny").model.texture_size)


@pytest.fixture(scope="session")
def reader(drawn_capture: Capture, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> FrameReader:
    """Reads the drawn capture; occlusion of the plain rest shape."""
    baker = AmbientOcclusion(rig.topology, resolve("tiny").model.shadow_size, rays=8)
    folder = tmp_path_factory.mktemp("occlusion")
    return FrameReader(drawn_capture, FrameOcclusion(baker, rig, torch.from_numpy(rig.rest_vertices), drawn_capture.theta, folder))


@pytest.fixture(scope="session")
def two_sizes_reader(drawn_capture: Capture, reader: FrameReader, tmp_path_factory: pytest.TempPathFactory) -> FrameReader:
    """Reads the drawn capture with the images of camera "left" cut to 25x39 pixels."""
    folder = tmp_path_factory.mktemp("two_sizes")
    return FrameReader(with_small_camera(drawn_capture, folder / "capture", "left", 25, 39), reader.occlusion)


@pytest.fixture
def make_trainer(rig: Rig, reader: FrameReader, statistics: DrivingStatistics) -> Callable[..., Trainer]:
    """make_trainer("loss.kl=0", ..., process=Process(1, 2)): a fresh avatar of the tiny preset, the same on every call."""

    def make(*overrides: str, reader: FrameReader = reader, process: Process | None = None) -> Trainer:
        settings = resolve("tiny", overrides)
        torch.manual_seed(settings.training.seed)
        return Trainer(Avatar(rig, settings.model, statistics), rig, reader, settings, process or Process())

    return make
