"""Set-up of every test session: the Mitsuba variant, chosen before any test module imports mitsuba or torch.

The built rig and the embedded capture are cached (`mitsuba_avatar.files.cache_folder`); tests read that cache, so that the first
session builds the rig and later ones reuse it. Set MITSUBA_AVATAR_CACHE to an empty folder to test from nothing.
"""

import signal
from contextlib import contextmanager
from pathlib import Path

import jaxtyping
import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--variant", default="llvm_ad_rgb", help="Mitsuba variant that the tests run on: llvm_ad_rgb (default), cuda_ad_rgb or auto"
    )


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    # Last, because jaxtyping's plugin must hook the import of the package before anyone imports it.
    from mitsuba_avatar.rendering.backend import select_variant

    select_variant(config.getoption("variant"))


# A fit of a few seconds: the command's words after --config tiny, --capture and --run.
SHORT_FIT = (
    *("training.iterations=40", "training.learning_rate=5e-3", "training.checkpoint_every=20", "training.validate_every=20"),
    *("training.preview_every=40", "evaluation.frames_per_split=2", "evaluation.orbit_frames=3", "evaluation.samples_per_pixel=4"),
)


@pytest.fixture(autouse=True, scope="session")
def heeded_ctrl_c():
    """SIGINT raises KeyboardInterrupt, as in a terminal, here and in child processes: a shell starts background jobs with it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@contextmanager
def torch_on_one_thread():
    """Layers of the tiny preset gain nothing from threads, and lose much where other processes keep the cores busy."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@pytest.fixture
def one_thread():
    """Run a test with one thread of torch's."""
    with torch_on_one_thread():
        yield


@pytest.fixture(scope="session")
def session_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache folder for this session alone."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def private_cache(session_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The session's own cache folder, in use during one test: fits leave nothing in the user's."""
    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(session_cache))
    return session_cache


@pytest.fixture(scope="session")
def drawn_capture(tmp_path_factory: pytest.TempPathFactory):
    """The capture of tests/drawn_capture.py; not to be written to."""
    from tests.drawn_capture import write_drawn_capture

    return write_drawn_capture(tmp_path_factory.mktemp("drawn") / "drawn")


@pytest.fixture(scope="session")
def fitted_run(tmp_path_factory: pytest.TempPathFactory, session_cache: Path, drawn_capture) -> Path:
    """The folder of a finished fit to the drawn capture; not to be written to."""
    from mitsuba_avatar.fit import main

    folder = tmp_path_factory.mktemp("runs") / "fitted"
    with pytest.MonkeyPatch.context() as patch, torch_on_one_thread():
        patch.setenv("MITSUBA_AVATAR_CACHE", str(session_cache))
        assert main(["--config", "tiny", "--capture", str(drawn_capture.path), "--run", str(folder), *SHORT_FIT]) == 0
    return folder


@pytest.fixture
def without_shape_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Call the package as its users do, without jaxtyping's checks: for tests of the package's own messages about wrong shapes."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
