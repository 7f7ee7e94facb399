"""One line of words becomes a command's flags and the overrides of settings; a word that is neither is refused."""

import ast
import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

import mitsuba_avatar
from mitsuba_avatar.command_line import interruptible, parse_command
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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_ended_says_in_one_line_what_is_kept(number, capsys):
    unwound, before = [], signal.getsignal(signal.SIGTERM)

    @interruptible("juggle", kept="two balls are kept. Pick up the third.")
    def main(arguments=None):
        try:
            os.kill(os.getpid(), number)
            time.sleep(30)
            pytest.fail("expected the signal to end the sleep; nothing did.")
        finally:
            unwound.append(arguments)

    assert main(["balls"]) == 130 and unwound == [["balls"]]
    assert capsys.readouterr().err == "juggle: interrupted; two balls are kept. Pick up the third.\n"
    assert signal.getsignal(signal.SIGTERM) == before


def test_every_command_that_works_for_long_is_interruptible():
    decorated = {}
    for path in sorted(Path(mitsuba_avatar.__file__).parent.glob("*.py")):
        mains = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef) and node.name == "main"]
        for main in mains:
            calls = [call for call in main.decorator_list if isinstance(call, ast.Call) and call.func.id == "interruptible"]
            decorated[path.stem] = [call.args[0].value for call in calls]
    assert len(decorated) >= 14
    assert {name: names for name, names in decorated.items() if names != [name]} == {"doctor": []}
