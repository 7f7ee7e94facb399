"""Video: what is decoded is what was encoded, in size, number, rate and colour; failures leave the old file."""

from fractions import Fraction

import av
import numpy as np
import pytest

from mitsuba_avatar.reporting.video import write_video


def gradient(height: int, width: int, step: int) -> np.ndarray:
    """A smooth picture without symmetry, which survives compression."""
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack([40 + rows * 150 // height, 200 - columns * 120 // width, np.full_like(rows, 60 + 20 * step)], axis=-1).astype(np.uint8)


def test_decoded_frames_are_the_encoded_ones_in_even_size(tmp_path):
    frames = [gradient(33, 51, step) for step in range(5)]
    assert write_video(tmp_path / "out" / "a.mp4", iter(frames), fps=12.5) == 5
    with av.open(str(tmp_path / "out" / "a.mp4")) as container:
        stream = container.streams.video[0]
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", Fraction(25, 2))
        assert stream.codec_context.colorspace == 1  # Rec. 709
    assert len(decoded) == 5
    for frame, picture in zip(decoded, frames, strict=True):
        assert frame.shape == (34, 52, 3)
        assert np.abs(frame[:33, :51].astype(int) - picture).mean() < 3
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.mp4"]


def test_the_index_comes_first(tmp_path):
    write_video(tmp_path / "a.mp4", [gradient(16, 32, 0)], fps=10.0)
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


def test_failures_say_why_and_keep_the_old_file(tmp_path, without_shape_checks):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")
    with pytest.raises(ValueError, match="expected at least one frame"):
        write_video(path, [], fps=10.0)
    with pytest.raises(ValueError, match=r"expected every frame to be \(16, 32, 3\); got \(32, 16, 3\) for frame 1"):
        write_video(path, [gradient(16, 32, 0), gradient(32, 16, 0)], fps=10.0)
    with pytest.raises(ValueError, match="expected a positive frame rate; got 0"):
        write_video(path, [gradient(16, 32, 0)], fps=0.0)
    assert [(entry.name, entry.read_bytes()) for entry in tmp_path.iterdir()] == [("a.mp4", b"old")]


def test_a_missing_encoder_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("mitsuba_avatar.reporting.video._CODEC", "libx264_absent")
    with pytest.raises(OSError, match="expected an FFmpeg with the libx264_absent encoder"):
        write_video(tmp_path / "a.mp4", [gradient(16, 32, 0)], fps=10.0)
    assert not list(tmp_path.iterdir())
