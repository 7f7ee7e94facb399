"""One line of words becomes a command's flags and the overrides of settings; a word that is neither is refused."""

from dataclasses import dataclass

import pytest

from mitsuba_avatar.command_line import parse_command
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.settings import Settings


@dataclass(frozen=True)
class FitFlags:
    """Fit an avatar."""

    config: str | None = None  # a preset
    resume: bool = False


def test_command_line_is_split_into_flags_and_overrides():
    flags, words = parse_command(
        FitFlags, Settings, ["--config", "tiny", "training.seed", "4", "--resume", "--loss.kl=1", "loss.mask", "2"]
    )
    assert flags == FitFlags("tiny", True)
    settings = resolve(None, words)
    assert (settings.training.seed, settings.loss.kl, settings.loss.mask) == (4, 1.0, 2.0)


@pytest.mark.parametrize(
    ("words", "nearest"),
    [(["--confg", "a"], "--config"), (["training.seeed", "1"], "training.seed"), (["training.seed", "1", "loose"], "loss.")],
)
def test_a_word_that_is_neither_flag_nor_setting_is_refused(words, nearest):
    with pytest.raises(ValueError) as caught:
        parse_command(FitFlags, Settings, words)
    assert f"Did you mean '{nearest}" in str(caught.value)


def test_help_lists_flags_and_settings(capsys):
    with pytest.raises(SystemExit):
        parse_command(FitFlags, Settings, ["--help"])
    shown = capsys.readouterr().out
    assert "Fit an avatar." in shown
    assert "--resume" in shown
    assert f"training.iterations ({Settings().training.iterations})" in shown
