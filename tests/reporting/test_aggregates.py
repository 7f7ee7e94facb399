"""Means per camera and per frame, and runs side by side."""

import csv

from mitsuba_avatar.reporting.aggregates import PER_CAMERA, PER_FRAME, grouped_means, joined_metrics, write_rows

ROWS = [
    {"method": "avatar", "split": "test", "cameras": "seen", "camera": "a", "frame": 1, "psnr": 20.0, "flicker": 3.0},
    {"method": "avatar", "split": "test", "cameras": "seen", "camera": "b", "frame": 1, "psnr": 24.0},
    {"method": "avatar", "split": "test", "cameras": "seen", "camera": "a", "frame": 2, "psnr": 30.0},
]


def test_means_are_over_the_rows_that_agree():
    keys = {"method": "avatar", "split": "test", "cameras": "seen"}
    assert grouped_means(ROWS, PER_CAMERA) == [
        keys | {"camera": "a", "psnr": 25.0, "flicker": 3.0, "images": 2},
        keys | {"camera": "b", "psnr": 24.0, "images": 1},
    ]
    assert [row["psnr"] for row in grouped_means(ROWS, PER_FRAME)] == [22.0, 30.0]


def test_rows_become_csv_with_gaps(tmp_path):
    write_rows(tmp_path / "deep" / "rows.csv", grouped_means(ROWS, PER_CAMERA))
    with (tmp_path / "deep/rows.csv").open() as file:
        first, second = csv.DictReader(file)
    assert float(first["flicker"]) == 3 and second["flicker"] == "" and second["images"] == "1"


def test_runs_stand_side_by_side_with_the_first_ones_baselines():
    first = {"avatar": {"test": {"seen": {"psnr": 1.0}}}, "nearest_frame": {"test": {"seen": {"psnr": 2.0}}}}
    second = {"avatar": {"test": {"seen": {"psnr": 3.0}}}, "nearest_frame": {"test": {"seen": {"psnr": 4.0}}}}
    joined = joined_metrics({"a": first, "b": second})
    assert list(joined) == ["a", "b", "nearest_frame"]
    assert joined["b"]["test"]["seen"]["psnr"] == 3 and joined["nearest_frame"]["test"]["seen"]["psnr"] == 2
    assert joined_metrics({"a": first}) == first
