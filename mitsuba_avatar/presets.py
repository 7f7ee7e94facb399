"""Settings in and out: YAML presets, overrides on the command line, the copy that is saved with a run.

A preset is a YAML file with any subset of the keys of a settings dataclass; what it leaves out keeps the default. `resolve` merges
preset and overrides and refuses unknown keys (naming the nearest known one) and wrong types. The resolved copy is written into the
run folder, and `load_settings` reads it back unchanged. Everything here works for any frozen dataclass of settings, nested or flat.

A preset may say `base: ablation/ours` and list only what it changes. One level deep: a base has no base of its own, so that two files
tell all there is to know.
"""

import dataclasses
import difflib
import math
import re
import typing
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml

from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.resources import find_resource
from mitsuba_avatar.settings import Settings

SettingsType = TypeVar("SettingsType")

BASE = "base"  # key of a preset that names the one it changes


def setting_types(kind: type) -> dict[str, Any]:
    """Dotted key -> type of every setting of a settings dataclass, in order of declaration: `{"training.iterations": int, ...}`."""
    types = {}
    for name, hint in typing.get_type_hints(kind).items():
        if dataclasses.is_dataclass(hint):
            types.update({f"{name}.{key}": inner for key, inner in setting_types(hint).items()})
        else:
            types[name] = hint
    return types


def nearest_key(key: str, known: Iterable[str]) -> str:
    """The known key most like `key`: one of the same last name in another section, otherwise the nearest spelling."""
    known = list(known)
    same_name = [other for other in known if other.rpartition(".")[2] == key.rpartition(".")[2]]
    return (same_name or difflib.get_close_matches(key, known, n=1, cutoff=0.0))[0]


def load_settings(path: Path | str, kind: type[SettingsType] = Settings) -> SettingsType:
    """Read settings from a YAML file; keys that it leaves out keep their defaults.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: not YAML, an unknown key (the message names the nearest known one), a wrong type, a value out of range.
    """
    return _build(kind, _read_preset(Path(path), kind))


def resolve(preset: Path | str | None, overrides: Iterable[str] = (), kind: type[SettingsType] = Settings) -> SettingsType:
    """Merge defaults, preset and overrides, in rising priority.

    Args:
        preset: path of a YAML file, the name of one in configs/ (`tiny`, `ablation/no_latent`), or None for the defaults.
        overrides: command-line words: `section.key value`, `section.key=value`, either with or without leading dashes.
            Lists are written `64,48,32` or `[64, 48, 32]`.
        kind: the settings dataclass, nested (`Settings`) or flat (`StudioSettings`).

    Raises:
        FileNotFoundError: if there is no such preset; the message lists those that exist.
        ValueError: as `load_settings`.
    """
    values = {} if preset is None else _read_preset(find_resource("configs", str(preset), ".yaml"), kind)
    return _build(kind, values | _read_overrides(overrides, kind))


def save_settings(path: Path | str, settings: Any) -> None:
    """Write every setting, defaults too, as YAML that `load_settings` reads back equal. Whole or not at all."""
    with atomic_path(path) as temporary:
        text = yaml.dump(dataclasses.asdict(settings), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=140)
        temporary.write_text(text, encoding="utf-8")


class _Loader(yaml.SafeLoader):
    """Safe YAML that reads `1e-3` as a number; YAML 1.1 alone wants `1.0e-3` and takes the former for text."""


class _Dumper(yaml.SafeDumper):
    """The writer for `_Loader`: quotes text that looks like such a number; tuples become lists on one line."""


for _yaml_class in (_Loader, _Dumper):
    _yaml_class.add_implicit_resolver("tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+$"), list("-+0123456789"))
_Dumper.add_representer(tuple, lambda dumper, value: dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=True))


def _read_preset(path: Path, kind: type) -> dict[str, Any]:
    """Dotted key -> checked value of each key in a YAML file, and of its base's where the file does not say otherwise."""
    values = _read_yaml(path)
    base = values.pop(BASE, None)
    if base is None:
        return _checked_preset(values, kind, str(path))
    if not isinstance(base, str):
        raise ValueError(f"load_settings(): {path}: expected {BASE} to be the name of a preset; got {base!r}. Write {BASE}: NAME.")
    base_path = find_resource("configs", base, ".yaml")
    base_values = _read_yaml(base_path)
    if BASE in base_values:
        raise ValueError(
            f"load_settings(): {path}: expected a base without a base of its own; {base} has {base_values[BASE]!r}. "
            "Name that one, and list what both change."
        )
    return _checked_preset(base_values, kind, str(base_path)) | _checked_preset(values, kind, str(path))


def _read_yaml(path: Path) -> dict[str, Any]:
    """Top-level mapping of a YAML file."""
    if not path.is_file():
        raise FileNotFoundError(f"load_settings(): expected a YAML file at {path}; there is none. Check the path.")
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # noqa: S506 (_Loader is a SafeLoader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"load_settings(): {path} is not valid YAML: {error}. Mend the file.") from error
    if not isinstance(content, Mapping | None):
        raise ValueError(f"load_settings(): {path}: expected the file to be a mapping of keys to values; got {content!r}. Indent its keys.")
    return dict(content or {})


def _checked_preset(content: Mapping[str, Any], kind: type, source: str) -> dict[str, Any]:
    """Dotted key -> checked value of a file's content."""
    known = setting_types(kind)
    values = _flatten(content, {key.rpartition(".")[0] for key in known}, source)
    return {key: _checked(value, key, known, source) for key, value in values.items()}


def _flatten(content: Any, sections: set[str], source: str, section: str = "") -> dict[str, Any]:
    """Nested mappings -> dotted keys; an empty section is allowed."""
    if not isinstance(content, Mapping):
        raise ValueError(
            f"load_settings(): {source}: expected {section} to be a mapping of keys to values; got {content!r}. Indent its keys."
        )
    values = {}
    for name, value in content.items():
        key = f"{section}.{name}" if section else str(name)
        if key in sections:
            values.update(_flatten({} if value is None else value, sections, source, key))
        else:
            values[key] = value
    return values


def _read_overrides(words: Iterable[str], kind: type) -> dict[str, Any]:
    """Dotted key -> checked value of each override."""
    known = setting_types(kind)
    values = {}
    remaining = iter(words)
    for word in remaining:
        key, equals, text = word.removeprefix("--").partition("=")
        key = key.replace("-", "_")
        if key not in known:
            raise ValueError(_unknown_key(key, known, "the command line"))
        if not equals:
            text = next(remaining, None)
            if text is None or text.startswith("--"):
                raise ValueError(f"resolve(): expected a value after {word}; got {text or 'nothing'}. Write {key}=VALUE.")
        values[key] = _checked(_from_text(text, known[key]), key, known, "the command line")
    return values


def _from_text(text: str, kind: Any) -> Any:
    """What YAML would read, except that text stays text (`capture.path 2024`) and lists may go without brackets."""
    if kind is str or typing.get_origin(kind) is Literal:
        return text
    if typing.get_origin(kind) is tuple:
        entries = text.strip().removeprefix("[").removesuffix("]").split(",")
        return [_from_text(entry.strip(), typing.get_args(kind)[0]) for entry in entries if entry.strip()]
    try:
        return yaml.load(text, _Loader)  # noqa: S506 (_Loader is a SafeLoader)
    except yaml.YAMLError:
        return text


def _checked(value: Any, key: str, known: Mapping[str, Any], source: str) -> Any:
    """The value in the setting's type, or an error that says what the type is."""
    if key not in known:
        raise ValueError(_unknown_key(key, known, source))
    try:
        return _typed(value, known[key])
    except TypeError as error:
        raise ValueError(f"resolve(): {source}: expected {key} to be {error}; got {value!r}. Change the value.") from error


def _typed(value: Any, kind: Any) -> Any:
    """Convert without guessing: an integer may stand for a float, a list for a tuple, and nothing else for anything.

    Raises:
        TypeError: its text is the expectation.
    """
    if typing.get_origin(kind) is Literal:
        if value not in typing.get_args(kind):
            raise TypeError("one of " + ", ".join(map(str, typing.get_args(kind))))
        return value
    if typing.get_origin(kind) is tuple:
        if not isinstance(value, Sequence) or isinstance(value, str):
            raise TypeError("a list")
        try:
            return tuple(_typed(entry, typing.get_args(kind)[0]) for entry in value)
        except TypeError as error:
            raise TypeError(f"a list, each entry {error}") from error
    expectation = {bool: "true or false", int: "an integer", float: "a finite number", str: "text"}[kind]
    is_right = isinstance(value, (int, float) if kind is float else kind) and (kind is bool or not isinstance(value, bool))
    if not is_right or (kind is float and not math.isfinite(value)):
        raise TypeError(expectation)
    return kind(value)


def _unknown_key(key: str, known: Iterable[str], source: str) -> str:
    return f"resolve(): {source}: expected a known setting; got {key!r}. Did you mean {nearest_key(key, known)!r}?"


def _build(kind: type[SettingsType], values: Mapping[str, Any], section: str = "") -> SettingsType:
    """Make the dataclass from dotted keys; what is absent keeps its default. Ranges are checked by the dataclasses themselves."""
    arguments = {}
    for name, hint in typing.get_type_hints(kind).items():
        key = f"{section}{name}"
        if dataclasses.is_dataclass(hint):
            arguments[name] = _build(hint, values, f"{key}.")
        elif key in values:
            arguments[name] = values[key]
    return kind(**arguments)
