"""Vector figures: they are vectors, they hold every line, they do not change with the date."""

import re

import pytest

from mitsuba_avatar.reporting.curves import camera_bars, frame_curves, training_curves

LOG = [{"iteration": 10 * i, "image": 0.1 / (i + 1), "validation_psnr": 20.0 + i if i % 2 else None} for i in range(6)]
ROWS = [
    {"method": method, "split": "test", "cameras": group, "camera": camera, "frame": frame, "psnr": 20.0 + frame + bonus}
    for method, bonus in (("avatar", 3.0), ("nearest_frame", 0.0))
    for group, camera in (("seen", "front"), ("held_out", "above"))
    for frame in (3, 4, 7)
]


def lines_of(svg: str) -> int:
    """Polylines of data in an SVG of matplotlib's."""
    return len(re.findall(r'<g id="line2d_\d+">\s*<path d="M [^"]*L[^"]*" clip-path', svg))


def test_training_curves_have_a_line_a_run_in_every_panel(tmp_path):
    panels = {"image": "image loss", "validation_psnr": "PSNR (dB)", "kl": "nobody logged it"}
    pdf, svg = training_curves(tmp_path / "training", {"a": LOG, "b": LOG[:4]}, panels)
    assert pdf.read_bytes()[:5] == b"%PDF-" and b"/Subtype /Image" not in pdf.read_bytes(), "vectors only"
    text = svg.read_text()
    grid = lines_of(training_curves(tmp_path / "one", {"a": LOG}, panels)[1].read_text())
    assert lines_of(text) > grid and "<image" not in text
    with pytest.raises(ValueError, match=r"expected records with any of \['kl'\]"):
        training_curves(tmp_path / "none", {"a": LOG}, {"kl": "KL"})


def test_equal_numbers_give_equal_files(tmp_path):
    first = training_curves(tmp_path / "first", {"a": LOG}, {"image": "image loss"})
    second = training_curves(tmp_path / "second", {"a": LOG}, {"image": "image loss"})
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_frames_and_cameras_have_their_figures(tmp_path):
    paths = frame_curves(tmp_path / "frames", ROWS, "psnr", "PSNR (dB)", "test")
    paths += camera_bars(tmp_path / "cameras", ROWS, "psnr", "PSNR (dB)", "test")
    assert [path.name for path in paths] == ["frames.pdf", "frames.svg", "cameras.pdf", "cameras.svg"]
    assert all(path.stat().st_size > 2000 for path in paths)
    bars = re.findall(r'<g id="patch_\d+">', paths[3].read_text())
    assert len(bars) >= 4 + 2, "two methods, two cameras, and the frame"
    with pytest.raises(ValueError, match="expected rows of split 'train' with psnr; found none"):
        frame_curves(tmp_path / "none", ROWS, "psnr", "PSNR", "train")
