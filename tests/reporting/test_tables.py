"""Tables: every value lands in its cell, columns are aligned, gaps are dashes."""

from mitsuba_avatar.reporting.tables import markdown_table, metric_rows, terminal_table

METRICS = {
    "avatar": {
        "train": {"seen": {"psnr": 31.256, "ssim": 0.9, "silhouette_iou": 0.98765, "vertex_error_mm": 3.0, "images": 12}},
        "test": {"held_out": {"psnr": 28.0, "ssim": 0.85, "silhouette_iou": 0.97, "vertex_error_mm": 8.125, "images": 6}},
    },
    "nearest_frame": {"test": {"held_out": {"psnr": 20.5, "ssim": 0.5, "images": 6, "lpips": 0.25}}},
}


def test_methods_of_one_split_stand_below_each_other():
    headings, rows = metric_rows(METRICS)
    assert headings == ["split", "cameras", "method", "PSNR (dB) ↑", "SSIM ↑", "IoU ↑", "vertices (mm) ↓", "images", "lpips"]
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
