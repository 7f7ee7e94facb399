"""Tables: every value lands in its cell, columns are aligned, gaps are dashes."""

import csv
import io

from mitsuba_avatar.reporting.tables import csv_table, latex_table, markdown_table, metric_rows, terminal_table

METRICS = {
    "avatar": {
        "train": {"seen": {"psnr": 31.256, "ssim": 0.9, "silhouette_iou": 0.98765, "vertex_error_mm": 3.0, "images": 12}},
        "test": {"held_out": {"psnr": 28.0, "ssim": 0.85, "silhouette_iou": 0.97, "vertex_error_mm": 8.125, "images": 6}},
    },
    "nearest_frame": {"test": {"held_out": {"psnr": 20.5, "ssim": 0.5, "images": 6, "depth_error": 0.25}}},
}


def test_methods_of_one_split_stand_below_each_other():
    headings, rows = metric_rows(METRICS)
    assert headings == ["split", "cameras", "method", "PSNR (dB) ↑", "SSIM ↑", "IoU ↑", "vertices (mm) ↓", "images", "depth_error"]
    assert rows == [
        ["train", "seen", "avatar", "31.26", "0.9000", "0.9877", "3.00", "12", "-"],
        ["test", "held_out", "avatar", "28.00", "0.8500", "0.9700", "8.12", "6", "-"],
        ["test", "held_out", "nearest_frame", "20.50", "0.5000", "-", "-", "6", "0.2500"],
    ]


def test_terminal_columns_are_aligned():
    heading, rule, *rows = terminal_table(METRICS).splitlines()
    end = heading.index("PSNR (dB) ↑") + len("PSNR (dB) ↑")
    assert set(rule) == {"-"}
    assert [row[:end].rsplit(maxsplit=1)[1] for row in rows] == ["31.26", "28.00", "20.50"]


def test_markdown_has_one_row_for_each():
    lines = markdown_table(METRICS).splitlines()
    assert len(lines) == 5
    assert lines[1] == "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |"
    assert lines[3].startswith("| test | held_out | avatar | 28.00 |")


def test_an_empty_file_is_an_empty_table():
    assert terminal_table({}).splitlines()[0] == "split  cameras  method"


PROTOCOLS = {
    "ours_full": {"test": {"seen": {"psnr": 30.0, "box_psnr": 25.006, "box_l1": 3.0, "vertex_mm": 2.5, "images": 3}}},
    "nearest_frame": {"test": {"seen": {"psnr": 28.0, "box_psnr": 25.11, "box_l1": 4.0, "images": 3}}},
}


def test_a_protocol_shows_its_own_columns_and_those_of_none():
    headings, rows = metric_rows(PROTOCOLS, "box")
    assert headings[3:] == ["PSNR (dB) ↑", "L1 (0..255) ↓", "vertices (mm) ↓", "images"]
    assert rows[0][3:] == ["25.01", "3.00", "2.50", "3"]
    assert metric_rows(PROTOCOLS, "mask")[0][3:] == ["PSNR (dB) ↑", "vertices (mm) ↓", "images"]
    assert "box PSNR (dB) ↑" in metric_rows(PROTOCOLS)[0]


def test_latex_has_booktabs_rules_escaped_names_and_bold_winners():
    text = latex_table(PROTOCOLS, "box", caption="50 % of R&D", label="tab:box")
    assert text.index("toprule") < text.index("midrule") < text.index("bottomrule")
    ours, nearest = (next(line for line in text.splitlines() if name in line) for name in ("ours", "nearest"))
    assert ours.strip() == r"test & seen & ours\_full & 25.01 & \textbf{3.00} & 2.50 \\"
    assert nearest.strip() == r" &  & nearest\_frame & \textbf{25.11} & 4.00 & -- \\".strip()
    assert r"\caption{50 \% of R\&D}" in text and r"\label{tab:box}" in text
    assert all(line.count("&") == 5 for line in text.splitlines() if "&" in line and "caption" not in line)


def test_csv_keeps_full_precision_and_gaps():
    rows = list(csv.DictReader(io.StringIO(csv_table(PROTOCOLS))))
    assert float(rows[0]["box_psnr"]) == 25.006 and rows[1]["vertex_mm"] == "" and rows[1]["method"] == "nearest_frame"
