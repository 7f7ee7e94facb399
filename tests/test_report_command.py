"""`python -m mitsuba_avatar.report`: the files of one run and of two, and what it says about bad input."""

import csv
import json
import shutil

import pytest

from mitsuba_avatar.captures.images import read_image
from mitsuba_avatar.report import main
from mitsuba_avatar.reporting.metrics import load_metrics

pytestmark = pytest.mark.usefixtures("one_thread", "private_cache")


@pytest.fixture(scope="module")
def reported(fitted_run, session_cache, tmp_path_factory):
    """A run with its report, and the report of it beside another one."""
    folder = tmp_path_factory.mktemp("reported")
    for name in ("first", "second"):
        shutil.copytree(fitted_run, folder / name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MITSUBA_AVATAR_CACHE", str(session_cache))
        from mitsuba_avatar.evaluate import main as evaluate

        assert evaluate([str(folder / "first"), "--frames", "1", "--flicker-frames", "1"]) == 0
        for ending in ("json", "csv"):
            shutil.copy(folder / f"first/metrics.{ending}", folder / f"second/metrics.{ending}")
        assert main([str(folder / "first"), "--views", "2"]) == 0
        assert main([str(folder / "first"), str(folder / "second"), "--views", "1", "--out", str(folder / "both")]) == 0
    return folder


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_one_run_has_every_file(reported):
    folder = reported / "first/report"
    names = {path.name for path in folder.iterdir()}
    vectors = {f"{stem}.{ending}" for stem in ("training", "frames_psnr", "frames_flip", "cameras_psnr") for ending in ("pdf", "svg")}
    assert vectors <= names
    assert {f"table_{protocol}.tex" for protocol in ("mask", "image", "box")} | {"table.csv", "table.md"} <= names
    assert {"comparison.png", "pictures.csv", "per_camera.csv", "per_frame.csv", "settings_first.yaml", "report.json"} <= names
    assert (folder / "settings_first.yaml").read_text() == (reported / "first/settings.yaml").read_text()


def test_numbers_are_those_of_the_evaluation(reported):
    folder, means = reported / "first/report", load_metrics(reported / "first/metrics.json")
    expected = means["avatar"]["test"]["held_out"]["box_flip"]

    def value(table: str, **keys: str) -> float:
        (row,) = [row for row in rows_of(folder / table) if all(row[key] == wanted for key, wanted in keys.items())]
        return float(row["box_flip"])

    assert value("table.csv", split="test", cameras="held_out", method="avatar") == expected
    assert value("per_camera.csv", split="test", camera="above", method="avatar") == pytest.approx(expected, rel=1e-4)
    cell = f"{expected:.4f}"
    assert cell in (folder / "table_box.tex").read_text() and cell not in (folder / "table_mask.tex").read_text()


def test_the_page_holds_video_pictures_tables_and_settings(reported):
    page = (reported / "first/report/first.html").read_text()
    assert page.count("<video") == 1 and page.count("<table") == 4 and "Run first" in page
    assert page.count("data:image/svg+xml") >= 4 and page.count("data:image/png") >= 2
    settings = page[page.index("<h2>Settings") :]
    marked = settings[: settings.index("iterations")].rsplit("<tr", 1)[1]
    assert "changed" in marked, "40 iterations are not the default"


def test_two_runs_stand_side_by_side(reported):
    folder = reported / "both"
    methods = {row["method"] for row in rows_of(folder / "pictures.csv")}
    assert methods == {"first", "second", "template_mean_texture", "nearest_frame"}
    assert (folder / "first.html").is_file() and (folder / "second.html").is_file()
    facts = json.loads((folder / "report.json").read_text())["runs"]
    assert [run["name"] for run in facts] == ["first", "second"] and facts[0]["iteration"] == 40
    one, two = (read_image(path / "comparison.png") for path in (reported / "first/report", folder))
    assert two.shape[1] > one.shape[1], "a column for each run"
    text = (folder / "table_mask.tex").read_text()
    assert text.count("first &") == text.count("second &") == 4


def test_what_was_not_evaluated_is_measured(fitted_run, tmp_path):
    run = shutil.copytree(fitted_run, tmp_path / "run")
    assert main([str(run), "--frames", "1", "--views", "1", "--out", str(tmp_path / "out")]) == 0
    columns = rows_of(tmp_path / "out/pictures.csv")[0]
    assert {"box_flip", "seam", "flicker"} <= set(columns)
    assert not (run / "metrics.csv").exists(), "the run itself is left alone"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--views", "0"], "expected --views and --frames of at least 1; got 0 and 4"),
        (["--out", "/dev/null/report"], "got /dev/null, which is a file"),
        (["--capture", "/nowhere"], "/nowhere; got none"),
    ],
)
def test_bad_input_is_one_line(fitted_run, capsys, words, message):
    assert main([str(fitted_run), *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("report: ") and message in line


def test_a_folder_without_a_run_is_one_line(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "expected a run with settings.yaml" in capsys.readouterr().err


def test_the_same_run_twice_is_refused(reported, capsys):
    assert main([str(reported / "first"), str(reported / "first"), "--out", str(reported / "twice")]) == 2
    assert "expected runs of different names" in capsys.readouterr().err
