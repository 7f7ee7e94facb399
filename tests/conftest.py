"""Set-up of every test session: the Mitsuba variant, chosen before any test module imports mitsuba or torch.

The built rig and the embedded capture are cached (`mitsuba_avatar.files.cache_folder`); tests read that cache, so that the first
session builds the rig and later ones reuse it. Set MITSUBA_AVATAR_CACHE to an empty folder to test from nothing.
"""

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


@pytest.fixture
def without_shape_checks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Call the package as its users do, without jaxtyping's checks: for tests of the package's own messages about wrong shapes."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
