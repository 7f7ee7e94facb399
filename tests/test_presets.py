"""Presets and overrides are merged and typed; what is saved is read back equal; errors name file, key and remedy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from mitsuba_avatar.filming.settings import MotionSettings, StudioSettings
from mitsuba_avatar.presets import load_settings, nearest_key, resolve, save_settings, setting_types
from mitsuba_avatar.settings import Settings


def write_preset(folder: Path, text: str) -> Path:
    path = folder / "preset.yaml"
    path.write_text(text)
    return path


def test_preset_overrides_default_and_command_line_overrides_preset(tmp_path):
    preset = write_preset(tmp_path, "training:\n  iterations: 7\n  seed: 3\nmodel:\n  latent_size: 16\nloss:\n")
    settings = resolve(preset, ["training.seed", "5", "--model.use_shadow=false", "--loss.kl", "2e-4"])
    assert (settings.training.iterations, settings.training.seed, settings.model.latent_size) == (7, 5, 16)
    assert settings.model.use_shadow is False
    assert settings.loss.kl == 2e-4
    assert settings.training.learning_rate == Settings().training.learning_rate


@pytest.mark.parametrize("words", [["decoder_channels", "8,4"], ["decoder_channels=[8, 4]"], ["--decoder-channels", "8,4"]])
def test_lists_and_every_spelling_of_an_override(words):
    prefix, key = ("--", words[0][2:]) if words[0].startswith("--") else ("", words[0])
    assert resolve(None, [f"{prefix}model.{key}", *words[1:]]).model.decoder_channels == (8, 4)


def test_text_stays_text_and_integers_become_floats():
    settings = resolve(None, ["capture.path", "2024", "capture.held_out_cameras", "01,02", "capture.image_scale", "1"])
    assert settings.capture.path == "2024"
    assert settings.capture.held_out_cameras == ("01", "02")
    assert isinstance(settings.capture.image_scale, float)


def test_an_empty_list_is_read_as_one():
    assert resolve(None, ["capture.held_out_cameras="]).capture.held_out_cameras == ()


def test_flat_settings_use_the_same_machinery():
    assert resolve(None, ["motion.train_frames=4", "--motion.fps", "12.5"], StudioSettings).motion.train_frames == 4


def test_saved_settings_are_read_back_equal(tmp_path):
    settings = resolve(
        None, ["capture.path", "1e5", "loss.kl", "1e-7", "model.decoder_channels", "8,4", "capture.held_out_cameras", "07,b c"]
    )
    path = tmp_path / "run" / "settings.yaml"
    save_settings(path, settings)
    assert load_settings(path) == settings
    assert "  decoder_channels: [8, 4]\n" in path.read_text()
    assert list(path.parent.iterdir()) == [path]


def test_saved_studio_settings_are_read_back_equal(tmp_path):
    settings = StudioSettings(name="study", motion=MotionSettings(fps=29.97))
    save_settings(tmp_path / "studio.yaml", settings)
    assert load_settings(tmp_path / "studio.yaml", StudioSettings) == settings


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "training:\n  iteratons: 7\n",
            "preset.yaml: expected a known setting; got 'training.iteratons'. Did you mean 'training.iterations'?",
        ),
        ("trainin:\n  iterations: 7\n", "got 'trainin'. Did you mean 'training."),
        ("model:\n  learning_rate: 1\n", "got 'model.learning_rate'. Did you mean 'training.learning_rate'?"),
        ("training:\n  iterations: many\n", "preset.yaml: expected training.iterations to be an integer; got 'many'."),
        ("training:\n  iterations: 7.5\n", "expected training.iterations to be an integer; got 7.5."),
        ("training:\n  iterations: true\n", "expected training.iterations to be an integer; got True."),
        ("model:\n  use_latent: 1\n", "expected model.use_latent to be true or false; got 1."),
        ("loss:\n  kl: .nan\n", "expected loss.kl to be a finite number; got nan."),
        ("capture:\n  path: 3\n", "expected capture.path to be text; got 3."),
        ("model:\n  decoder_channels: 64\n", "expected model.decoder_channels to be a list; got 64."),
        ("model:\n  decoder_channels: [64, a]\n", "expected model.decoder_channels to be a list, each entry an integer; got [64, 'a']."),
        ("model: 3\n", "preset.yaml: expected model to be a mapping of keys to values; got 3. Indent its keys."),
        ("- a\n", "expected the file to be a mapping of keys to values; got ['a']."),
        ("a: [\n", "preset.yaml is not valid YAML"),
    ],
)
def test_bad_presets_are_refused_by_name(tmp_path, text, message):
    with pytest.raises(ValueError) as caught:
        load_settings(write_preset(tmp_path, text))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["training.iteratons", "7"],
            "the command line: expected a known setting; got 'training.iteratons'. Did you mean 'training.iterations'?",
        ),
        (["training.iterations"], "expected a value after training.iterations; got nothing. Write training.iterations=VALUE."),
        (["--training.iterations", "--loss.kl", "1"], "expected a value after --training.iterations; got --loss.kl."),
        (["training.iterations=x: ["], "expected training.iterations to be an integer; got 'x: ['."),
        (["loss.kl", "-1"], "LossSettings(): expected kl to be zero or more; got -1.0."),
        (["model.decoder_channels", "8,0"], "ModelSettings(): expected decoder_channels to be positive; got (8, 0)."),
        (["model.decoder_channels="], "ModelSettings(): expected decoder_channels to be positive; got ()."),
        (["model.texture_size", "200"], "ModelSettings(): expected texture_size to be a power of two; got 200."),
        (["model.geometry_size", "16"], "expected geometry_size to be at least conditioning_size (32)"),
    ],
)
def test_bad_overrides_are_refused_by_name(words, message):
    with pytest.raises(ValueError) as caught:
        resolve(None, words)
    assert message in str(caught.value)


def test_choices_are_listed():
    with pytest.raises(ValueError, match="expected person to be one of anny; got 'smpl'"):
        resolve(None, ["person", "smpl"], StudioSettings)


def test_choices_of_literals_need_not_be_text():
    @dataclass(frozen=True)
    class Choice:
        mode: Literal["a", "b"] = "a"

    assert resolve(None, ["mode=b"], Choice).mode == "b"


def test_every_shipped_preset_resolves():
    folder = Path(__file__).parents[1] / "configs"
    for path in folder.rglob("*.yaml"):
        name = path.relative_to(folder).with_suffix("").as_posix()
        kind = StudioSettings if name.startswith("studio") else Settings
        assert resolve(name, kind=kind) == load_settings(path, kind)


def test_nearest_key_prefers_the_same_name_in_another_section():
    assert nearest_key("training.kl", ["training.iterations", "loss.kl"]) == "loss.kl"


def test_missing_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected a YAML file at .*absent\.yaml"):
        load_settings(tmp_path / "absent.yaml")
    with pytest.raises(FileNotFoundError, match=r"expected a file, or a name of configs/; got 'tinny'"):
        resolve("tinny")


def test_a_preset_changes_its_base_and_nothing_else(tmp_path):
    (tmp_path / "base.yaml").write_text("training:\n  iterations: 7\n  seed: 3\nmodel:\n  decoder_channels: [8, 4]\n")
    preset = write_preset(tmp_path, f"base: {tmp_path}/base.yaml\ntraining:\n  seed: 4\n")
    for settings in (resolve(preset), load_settings(preset)):
        assert (settings.training.iterations, settings.training.seed, settings.model.decoder_channels) == (7, 4, (8, 4))
    assert resolve(preset, ["training.iterations=9"]).training.iterations == 9
    assert resolve(write_preset(tmp_path, "base: tiny\n")) == resolve("tiny"), "a base may be named like any preset"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: [tiny]\n", "preset.yaml: expected base to be the name of a preset; got ['tiny']. Write base: NAME."),
        ("base: ablation/pose_face\n", "expected a base without a base of its own; ablation/pose_face has 'ablation/ours'."),
        ("base: tiny\ntraining:\n  iteratons: 7\n", "preset.yaml: expected a known setting; got 'training.iteratons'."),
        ("model:\n  base: tiny\n", "got 'model.base'."),
    ],
)
def test_bad_bases_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError) as caught:
        load_settings(write_preset(tmp_path, text))
    assert message in str(caught.value)


def test_a_fault_of_the_base_is_named_with_its_file(tmp_path):
    (tmp_path / "base.yaml").write_text("training:\n  iterations: many\n")
    with pytest.raises(ValueError, match=r"base\.yaml: expected training\.iterations to be an integer"):
        resolve(write_preset(tmp_path, f"base: {tmp_path}/base.yaml\n"))
    with pytest.raises(FileNotFoundError, match="got 'ablation/hours'"):
        resolve(write_preset(tmp_path, "base: ablation/hours\n"))


NO_DISENTANGLEMENT = {"loss.kl": 3e-5, "loss.mutual_information": 0.0, "loss.perturbation": 0.0}
PLAIN_DECODER = {"model.use_localization": False, "model.use_shadow": False}
ABLATIONS = {
    "pose_face": PLAIN_DECODER | {"model.use_latent": False},
    "pose_face_latent": PLAIN_DECODER | NO_DISENTANGLEMENT,
    "without_disentanglement": NO_DISENTANGLEMENT,
    "without_localization": {"model.use_localization": False},
    "without_shadow": {"model.use_shadow": False},
    "without_compression": {"model.use_compression": False},
}


@pytest.mark.parametrize("name", ABLATIONS)
def test_each_ablation_differs_from_ours_only_in_what_its_name_says(name):
    def values(preset):
        settings = resolve(f"ablation/{preset}")
        return {key: getattr(getattr(settings, key.partition(".")[0]), key.partition(".")[2]) for key in setting_types(Settings)}

    ours, other = values("ours"), values(name)
    assert {key: other[key] for key in ours if other[key] != ours[key]} == ABLATIONS[name]


def test_ours_has_every_part_and_every_strategy():
    ours = resolve("ablation/ours")
    assert ours.model.use_latent and ours.model.use_localization and ours.model.use_compression and ours.model.use_shadow
    assert ours.loss.kl > 0 and ours.loss.mutual_information > 0 and ours.loss.perturbation > 0
    folder = Path(__file__).parents[1] / "configs/ablation"
    assert {path.stem for path in folder.glob("*.yaml")} == {"ours", *ABLATIONS}
