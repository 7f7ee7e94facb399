"""EXR: layers come back as written, under the standard names, with the colour space recorded; bad layers are refused."""

import numpy as np
import OpenEXR
import pytest

from mitsuba_avatar.reporting.exr import read_exr, write_exr


@pytest.fixture
def layers():
    random = np.random.default_rng(2)
    shapes = {"colour": (5, 8, 4), "depth": (5, 8), "normal": (5, 8, 3), "position": (5, 8, 3), "uv": (5, 8, 2), "albedo": (5, 8, 3)}
    shapes |= {"ambient_occlusion": (5, 8), "mask": (5, 8)}
    return {name: random.normal(0, 3, shape).astype(np.float32) for name, shape in shapes.items()}


def test_layers_come_back_exactly(tmp_path, layers):
    write_exr(tmp_path / "out" / "a.exr", layers)
    read = read_exr(tmp_path / "out" / "a.exr")
    assert list(read) == list(layers)
    for name, values in layers.items():
        assert read[name].dtype == np.float32
        np.testing.assert_array_equal(read[name], values)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.exr"]


def test_half_rounds_colour_and_mask_and_leaves_geometry(tmp_path, layers):
    layers["colour"][0, 0] = 1e6
    write_exr(tmp_path / "a.exr", layers, half=True)
    read = read_exr(tmp_path / "a.exr")
    assert read["colour"][0, 0].tolist() == [65504.0] * 4
    np.testing.assert_array_equal(read["colour"][1:], layers["colour"][1:].astype(np.float16))
    np.testing.assert_array_equal(read["position"], layers["position"])


def test_channels_and_header_follow_the_standards(tmp_path, layers):
    layers["colour"] = layers["colour"][..., :3]
    write_exr(tmp_path / "a.exr", layers, comments="seed 3")
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        names, header = set(file.channels()), dict(file.header())
    assert names == {"R", "G", "B", "depth.Z", "ambient_occlusion", "mask", "uv.U", "uv.V", "albedo.R", "albedo.G", "albedo.B"} | {
        f"{layer}.{axis}" for layer in ("normal", "position") for axis in "XYZ"
    }
    assert header["comments"] == "seed 3"
    assert header["colorInteropID"] == "lin_rec709_scene"
    assert header["chromaticities"][:2] == pytest.approx((0.64, 0.33))
    assert header["dataWindow"][1].tolist() == [7, 4]  # width, height: not exchanged


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        ({}, "expected at least one layer"),
        (
            {"color": np.zeros((2, 3, 3), np.float32)},
            "expected a layer of colour, depth, normal, position, uv, albedo, ambient_occlusion, mask; got 'color'",
        ),
        ({"colour": np.zeros((2, 3, 2), np.float32)}, r"expected colour as \[H, W, 4\] .*; got \[2, 3, 2\]"),
        ({"depth": np.zeros((2, 3, 1), np.float32)}, r"expected depth .*; got \[2, 3, 1\]"),
        ({"colour": np.zeros((2, 3, 3), np.float32), "mask": np.zeros((3, 2), np.float32)}, "expected layers of one height and width"),
    ],
)
def test_bad_layers_are_refused(tmp_path, layers, message, without_shape_checks):
    with pytest.raises(ValueError, match=message):
        write_exr(tmp_path / "a.exr", layers)
    assert not list(tmp_path.iterdir())


def test_bad_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"expected an EXR file at .*absent\.exr"):
        read_exr(tmp_path / "absent.exr")
    (tmp_path / "text.exr").write_text("no picture")
    with pytest.raises(ValueError, match=r"expected an OpenEXR file; got .*text\.exr"):
        read_exr(tmp_path / "text.exr")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    plane = np.zeros((2, 3), np.float32)
    with OpenEXR.File({**header, "colorInteropID": "lin_ap1_scene"}, {"Y": plane}) as file:
        file.write(str(tmp_path / "other.exr"))
    with pytest.raises(ValueError, match="expected colour space lin_rec709_scene .* got lin_ap1_scene"):
        read_exr(tmp_path / "other.exr")
    with OpenEXR.File(header, {"uv.U": plane}) as file:
        file.write(str(tmp_path / "part.exr"))
    with pytest.raises(ValueError, match=r"expected channels \('uv.U', 'uv.V'\)"):
        read_exr(tmp_path / "part.exr")
