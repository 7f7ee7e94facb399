"""The table: means and deviations over seeds, the best in bold, runs in JSON."""

import json
from pathlib import Path

import pytest

from mitsuba_avatar.ablation.plan import PlannedRun
from mitsuba_avatar.ablation.rows import choose_rows
from mitsuba_avatar.ablation.table import driven_errors, latex, markdown, summarize, takes_markdown, write_tables
from mitsuba_avatar.presets import resolve

ERRORS = {("ours", 0): (12.0, 15.0), ("ours", 1): (12.5, 16.0), ("pose_face", 0): (7.0, 17.0), ("pose_face", 1): (9.0, 18.0)}


@pytest.fixture
def runs(tmp_path: Path) -> list[PlannedRun]:
    planned = []
    for (name, seed), (train, test) in ERRORS.items():
        run = PlannedRun(choose_rows(name)[0], resolve(f"ablation/{name}", [f"training.seed={seed}"]), tmp_path / name / str(seed))
        run.path.mkdir(parents=True)
        latent = (
            {"kl_nats": 5.0 + seed, "active_entries": 40 + seed, "frame_information_nats": 1.5, "mutual_information_nats": 0.25}
            if name == "ours"
            else {}
        )
        images = {"train": {"mse": train}, "test": {"mse": test}}
        costs = {"training_seconds": 90.0 + 60 * seed, "parameters": 1234567}
        run.save_measures({"name": name, "seed": seed, **costs, "images": images, "disentanglement": latent})
        planned.append(run)
    return planned


def test_markdown_has_means_deviations_and_the_best_in_bold(runs: list[PlannedRun]):
    heading, rule, ours, pose_face = markdown(summarize(runs)).splitlines()
    assert heading.endswith("| I(z; drive) | seeds | minutes | thousand parameters | paper train | paper test |")
    assert {line.count("|") for line in (heading, rule, ours, pose_face)} == {16}
    assert ours == (
        "| ours | 12.25 ± 0.35 | - | **15.50 ± 0.71** | - | 3.25 | 5.5 ± 0.7 | 40 ± 1 | 1.50 ± 0.00 | 0.25 ± 0.00 "
        "| 2 | 2.0 | 1235 | 11.578 | 15.546 |"
    )
    assert pose_face == (
        "| pose+face | **8.00 ± 1.41** | - | 17.50 ± 0.71 | 13 ± 1 % (2 of 2) | 9.50 | - | - | - | - | 2 | 2.0 | 1235 | 7.647 | 17.509 |"
    )


def test_one_seed_has_no_deviation(runs: list[PlannedRun]):
    assert "| ours | 12.00 | - | **15.00** | - | 3.00 |" in markdown(summarize([runs[0], runs[2]]))


def test_a_row_with_fewer_seeds_says_so_and_is_never_bold(runs: list[PlannedRun], tmp_path: Path):
    """Row without_shadow has the lowest train error of all, and as low a test error as ours, in one seed: the others' best are bold."""
    lucky = PlannedRun(choose_rows("without_shadow")[0], resolve("ablation/without_shadow"), tmp_path / "without_shadow" / "0")
    lucky.save_measures({"name": "without_shadow", "seed": 0, "images": {"train": {"mse": 1.0}, "test": {"mse": 15.5}}})
    entries = summarize([*runs, lucky])
    text = markdown(entries)
    assert "| ours, no shadow | 1.00 | - | 15.50 | 3 % (1 of 1) | 14.50 | - | - | - | - | 1 of 2 | - | - | 10.872 | 16.792 |" in text
    assert "**15.50 ± 0.71**" in text and "**8.00 ± 1.41**" in text and text.count("**") == 4
    assert r"ours, no shadow (1 of 2 seeds) & 1.00 &" in latex(entries) and latex(entries).count(r"\textbf") == 2
    assert "seeds" not in latex(entries[:2])


def test_nothing_is_best_without_a_rival(runs: list[PlannedRun]):
    assert "**" not in markdown(summarize(runs[:2])) and "**" not in markdown(summarize(runs[:3]))


def test_rows_are_compared_with_ours_of_the_same_seed_alone(runs: list[PlannedRun]):
    """Seed 1 of ours is not there: what is worse in seed 0 is not judged by another seed's luck."""
    text = markdown(summarize([runs[0], runs[2], runs[3]]))
    assert "| 17.50 ± 0.71 | 13 % (1 of 1) |" in text
    assert "%" not in markdown(summarize(runs[2:]))


def test_takes_count_alike_whatever_their_error(runs: list[PlannedRun], tmp_path: Path):
    """A take of ten times the error, where the row is better than ours, outweighs the other take in the mean and not in the takes' mean."""
    assert takes_markdown(summarize(runs)) == ""
    takes = {("ours", 0): (10.0, 100.0), ("ours", 1): (20.0, 100.0), ("pose_face", 0): (12.0, 95.0), ("pose_face", 1): (22.0, 98.0)}
    for run in runs:
        measures = run.measures()
        calm, hard = takes[measures["name"], measures["seed"]]
        measures["images"]["test"] = {"mse": (calm + hard) / 2, "takes": {"calm": calm, "hard": hard}}
        run.save_measures(measures)
    heading, rule, ours, pose_face = takes_markdown(summarize(runs)).splitlines()
    assert heading == "| model | calm | hard | over ours, mean over takes |" and rule.count("---") == 4
    assert ours == "| ours | 15.0 ± 7.1 | 100.0 ± 0.0 | - |"
    assert pose_face == "| pose+face | 17.0 ± 7.1 | 96.5 ± 2.1 | 6 ± 2 % (2 of 2) |"  # (20 - 5) / 2 and (10 - 2) / 2
    assert "| -1 ± 2 % (0 of 2) |" in markdown(summarize(runs))
    write_tables(tmp_path, runs)
    assert (tmp_path / "table.md").read_text().count("| ours |") == 2


def test_latex_is_a_booktabs_tabular_of_as_many_columns(runs: list[PlannedRun]):
    text = latex(summarize(runs))
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert text.startswith(r"\begin{tabular}{lrrrrrrrrrrr}") and {row.count("&") for row in rows} == {11}
    assert r"& 13 $\pm$ 1 \% (2 of 2) &" in text
    assert r"\textbf{15.50 $\pm$ 0.71}" in text and text.count(r"\textbf") == 2
    assert [rule for rule in (r"\toprule", r"\midrule", r"\bottomrule") if rule in text] == [r"\toprule", r"\midrule", r"\bottomrule"]


def test_files_list_every_run_and_runs_to_come_are_left_out(runs: list[PlannedRun], tmp_path: Path):
    to_come = PlannedRun(choose_rows("without_shadow")[0], resolve("ablation/without_shadow"), tmp_path / "without_shadow" / "0")
    write_tables(tmp_path, [*runs, to_come])
    rows = json.loads((tmp_path / "table.json").read_text())
    assert [(row["name"], row["seed"], row["train"], row["test"]) for row in rows] == [(*key, *error) for key, error in ERRORS.items()]
    assert [(row["seeds"], row["minutes"], row["thousand_parameters"]) for row in rows] == [(2, 1.5, 1234.567), (2, 2.5, 1234.567)] * 2
    assert "shadow" not in (tmp_path / "table.md").read_text() and (tmp_path / "table.tex").is_file()


def test_a_rehearsal_is_judged_by_distance_from_the_truth():
    geometry = {"train": {"driven_mm": 3.0, "driven_garment_mm": 9.0}, "test": {"driven_mm": 4.0}}
    assert driven_errors({"geometry": geometry}) == {"train": 9.0, "test": 4.0}
    assert driven_errors({"geometry": geometry, "images": {"train": {"mse": 12.0}}}) == {"train": 12.0}
