"""The one shape of every command's line: a few flags of its own, then overrides of the project's settings.

    python -m mitsuba_avatar.fit --config tiny training.iterations 50 model.decoder_channels=32,16

Flags are the fields of a small dataclass, read by tyro; every other word is an override (`presets.resolve` says how it is written).
A command that is ended from outside says in one line what is kept (`interruptible`).
"""

import dataclasses
import functools
import re
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import tyro

from mitsuba_avatar.presets import nearest_key, setting_types

CommandType = TypeVar("CommandType")
Main = Callable[[Sequence[str] | None], int]  # a command's `main`: words after its name -> exit status

INTERRUPTED = 130  # exit status: 128 + SIGINT, as shells have it


def interruptible(name: str, kept: str) -> Callable[[Main], Main]:
    """Decorator of a command's `main`: Ctrl-C and SIGTERM unwind it, so that half-written files go, and end in one line and status 130.

    Args:
        name: of the command.
        kept: what is there afterwards, and how to go on; a sentence after "interrupted; ".
    """

    def decorate(main: Main) -> Main:
        @functools.wraps(main)
        def run(arguments: Sequence[str] | None = None) -> int:
            is_main_thread = threading.current_thread() is threading.main_thread()  # no other may set handlers
            previous = signal.signal(signal.SIGTERM, signal.default_int_handler) if is_main_thread else None
            try:
                return main(arguments)
            except KeyboardInterrupt:
                sys.stderr.write(f"{name}: interrupted; {kept}\n")
                return INTERRUPTED
            finally:
                if is_main_thread:
                    signal.signal(signal.SIGTERM, previous)

        return run

    return decorate


def parse_command(command: type[CommandType], settings: type, arguments: Sequence[str] | None = None) -> tuple[CommandType, list[str]]:
    """Read a command line.

    Args:
        command: dataclass of the command's own flags; its docstring is the help text.
        settings: the settings dataclass that overrides speak of (`Settings`, `StudioSettings`).
        arguments: words after the command's name; None reads `sys.argv`.

    Returns:
        The flags, and the overrides as `presets.resolve` takes them: `command, overrides = parse_command(FitCommand, Settings)`.

    Raises:
        ValueError: a word that is neither flag nor setting; the message names the nearest of both.
        SystemExit: after `--help`, or a flag of the wrong type (tyro prints which).
    """
    description = f"{(command.__doc__ or '').strip()}\n\nSettings, written KEY VALUE or KEY=VALUE (default):\n{_describe(settings)}"
    flags, words = tyro.cli(command, args=arguments, description=description, return_unknown_args=True)
    known = list(setting_types(settings))
    own = [f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(command)]
    is_value = False
    for word in words:
        if not is_value and word.removeprefix("--").partition("=")[0].replace("-", "_") not in known:
            raise ValueError(
                f"parse_command(): expected a flag or a setting; got {word!r}. Did you mean {nearest_key(word, known + own)!r}?"
            )
        is_value = not is_value and "=" not in word
    return flags, words


def parse_shard(text: str) -> tuple[int, int]:
    """Index and count of a shard "i/n"; empty text is the whole, shard 0 of 1.

    Raises:
        ValueError: not of the form i/n with 0 <= i < n.
    """
    match = re.fullmatch(r"(\d+)/(\d+)", text or "0/1")
    if match is None or int(match[1]) >= int(match[2]):
        raise ValueError(f"parse_shard(): expected --shard i/n with 0 <= i < n, like 0/4; got {text!r}. Count shards from 0.")
    return int(match[1]), int(match[2])


def _describe(settings: type) -> str:
    """One line a setting: dotted key and default."""
    return "\n".join(f"  {key} ({_default(settings, key)})" for key in setting_types(settings))


def _default(settings: type, key: str) -> Any:
    value: Any = settings()
    for name in key.split("."):
        value = getattr(value, name)
    return value
