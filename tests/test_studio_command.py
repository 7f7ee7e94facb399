from pathlib import Path

import pytest

from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.filming.settings import StudioSettings
from mitsuba_avatar.presets import resolve
from mitsuba_avatar.studio import main

SMALL = ["--preset", "tiny", "motion.train_frames", "2", "motion.test_frames=1", "cameras.train=2", "clothing.texture_size=64"]
SMALL += ["clothing.is_simulated=false"]


def test_it_films_a_capture_and_says_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main([*SMALL, "--out", str(tmp_path / "capture")]) == 0
    output = capsys.readouterr()
    assert output.out.strip() == str(tmp_path / "capture")
    assert "3 frames from 3 cameras" in output.err
    assert len(Capture.open(tmp_path / "capture").frames) == 3
    assert (tmp_path / "capture" / "video.mp4").stat().st_size > 1000


def test_a_plan_films_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["--preset", "paper", "--plan", "--out", str(tmp_path / "capture")]) == 0
    assert "7,000,000 images" in capsys.readouterr().out and not (tmp_path / "capture").exists()


def test_what_takes_days_wants_a_shard(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["--preset", "paper", "--out", str(tmp_path / "capture")]) == 2
    error = capsys.readouterr().err
    assert "Give --shard" in error and not (tmp_path / "capture").exists()


def test_gates_say_what_pose_explains_and_film_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Filming then goes on in the same folder, with the garments that are there; and what is filmed can be asked again."""
    words = [*SMALL[:-1], "motion.test_frames=2", "--out", str(tmp_path / "capture")]
    status = main([*words, "--gates"])
    output = capsys.readouterr().out
    assert status in (0, 1) and "mean garment" in output and "chaos floor" in output and "test_recombined" in output
    assert ("FAIL" in output) == (status == 1) and not list(tmp_path.rglob("*.png"))
    assert main(words) == 0
    assert "simulating cloth" not in capsys.readouterr().err
    assert main([*words, "--gates"]) == status and capsys.readouterr().out == output


def test_without_a_folder_it_films_into_the_cache(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    from mitsuba_avatar.files import cache_folder

    # The built rig is reused; only captures go to the new place.
    for path in cache_folder().glob("anny_*.npz"):
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(tmp_path))
    assert main(SMALL) == 0
    assert Path(capsys.readouterr().out.strip()).parent == tmp_path / "captures"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["smaples_per_pixel", "4"], "samples_per_pixel"),
        (["motion.train_frames", "0"], "expected train_frames to be positive; got 0"),
        (["light.scene", "doom"], "got 'doom'. Known names: dome"),
        (["--preset", "huge"], "got 'studio/huge'"),
    ],
)
def test_bad_input_is_refused_in_one_line(words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    preset = [] if "--preset" in words else ["--preset", "tiny"]
    assert main([*preset, "--out", str(tmp_path / "capture"), *words]) == 2
    error = capsys.readouterr().err
    assert message in error and "Traceback" not in error
    assert not (tmp_path / "capture").exists()


def test_a_folder_that_cannot_be_made_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").write_text("")
    assert main([*SMALL, "--out", str(tmp_path / "file" / "capture")]) == 2
    assert "studio:" in capsys.readouterr().err


def test_the_shipped_default_preset_is_the_default():
    assert resolve("studio/default", kind=StudioSettings) == StudioSettings()
