"""Data sets read where they lie: the pixels are those of a conversion, nothing is unpacked, and a data set that changed is named."""

import importlib.util
import json
import shutil

import numpy as np
import pytest

from mitsuba_avatar.body.source_captures import capture_folder, images_in_place
from mitsuba_avatar.captures.checks import check_images
from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.captures.formats import in_place
from mitsuba_avatar.captures.formats.conversion import ConversionOptions, convert
from mitsuba_avatar.captures.formats.opening import SourceName, open_source
from mitsuba_avatar.captures.formats.source import SourceOptions
from mitsuba_avatar.captures.formats.source_state import source_state
from tests.captures.formats.data_sets import WRITERS

HAS_H5PY = importlib.util.find_spec("h5py") is not None
FORMATS = tuple(name for name in WRITERS if name != "dna" or HAS_H5PY)


def opened_in_place(name, path, destination, **options):
    """A capture that reads `path` in place."""
    source = open_source(name, path)
    images_from = images_in_place(name, path, source, SourceOptions())
    return convert(source, destination, ConversionOptions(own_sizes=True, images_from=images_from, **options))


def assert_equal_images(first, second):
    """Every image, mask and plate of two captures."""
    for name in first.cameras:
        for index in range(len(first.frames)):
            np.testing.assert_array_equal(first.encoded_image(name, index), second.encoded_image(name, index))
            np.testing.assert_array_equal(first.mask(name, index), second.mask(name, index))
            np.testing.assert_allclose(first.display_image(name, index), second.display_image(name, index), atol=0.501 / 255)
            linear = encode(np.clip(first.image(name, index), 0, 1), first.description.colour_curve)
            np.testing.assert_allclose(linear, second.encoded_image(name, index) / 255, atol=0.501 / 255, err_msg="not rounded twice")
        plates = [capture.background(name) for capture in (first, second)]
        assert (plates[0] is None) == (plates[1] is None)
        if plates[0] is not None:
            np.testing.assert_array_equal(*plates)


@pytest.mark.parametrize("name", FORMATS)
def test_pixels_are_those_that_a_conversion_writes_and_no_file_is_written(name, tmp_path):
    """Bent lenses, cameras of two sizes, labels as masks, linear values, plates: whatever a format has."""
    (tmp_path / "data").mkdir()
    WRITERS[name](tmp_path / "data")
    before = sorted(tmp_path.joinpath("data").rglob("*"))
    direct = opened_in_place(name, tmp_path / "data", tmp_path / "direct", scale=0.75)
    converted = convert(open_source(name, tmp_path / "data"), tmp_path / "png", ConversionOptions(0.75, (), "png", own_sizes=True))
    assert_equal_images(direct, converted)
    assert sorted(tmp_path.joinpath("data").rglob("*")) == before
    assert {entry.name for entry in direct.path.iterdir()} <= {
        "capture.yaml", "cameras.json", "frames.csv", "conversion.json", "keypoints.npy"
    }  # fmt: skip
    assert {camera.width for camera in direct.cameras.values()} == {camera.width for camera in converted.cameras.values()}
    check_images(direct, [0])


@pytest.fixture
def captured(tmp_path):
    """An EasyMocap folder, and a capture that reads it in place."""
    (tmp_path / "data").mkdir()
    WRITERS["easymocap"](tmp_path / "data")
    return tmp_path / "data", opened_in_place("easymocap", tmp_path / "data", tmp_path / "capture")


def test_maps_of_few_cameras_are_kept_and_made_again_when_needed(captured, monkeypatch):
    _, capture = captured
    monkeypatch.setattr(in_place, "MAP_BYTES", 1)
    frugal = Capture.open(capture.path)
    for _ in range(2):
        assert_equal_images(frugal, capture)
    assert frugal.images._plan.cache_info().currsize == 1


def test_a_data_set_that_moved_or_changed_is_named(captured, tmp_path):
    data, capture = captured
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(data, elsewhere)
    assert source_state(elsewhere) == source_state(data), "a copy is the same data set"
    expected = capture.encoded_image("3", 1)
    data.rename(tmp_path / "gone")
    moved = Capture.open(capture.path)  # poses are still there to drive with
    with pytest.raises(FileNotFoundError, match=r"reads its images from at .*/data; got none. Bring it back, or correct images_from.path"):
        moved.image("01", 0)
    text = (capture.path / "capture.yaml").read_text()
    (capture.path / "capture.yaml").write_text(text.replace(str(data), str(elsewhere)))
    np.testing.assert_array_equal(Capture.open(capture.path).encoded_image("3", 1), expected)
    (elsewhere / "extri.yml").write_text((elsewhere / "extri.yml").read_text().replace("0.1", "0.2"))
    with pytest.raises(ValueError, match=r"expected files in .*/elsewhere as when .*capture.yaml was made.*capture convert --in-place"):
        check_images(Capture.open(capture.path), [0])


@pytest.mark.parametrize("change", ["missing image", "another camera", "another archive"])
def test_the_state_tells_what_a_data_set_has(captured, change):
    data, _ = captured
    before = source_state(data)
    if change == "missing image":
        next((data / "images/01").iterdir()).unlink()
    elif change == "another camera":
        (data / "images/new").mkdir()
    else:
        (data / "keypoints3d/000000.json").write_text(json.dumps([]))
    assert source_state(data) != before


def test_an_image_that_ends_early_is_found_where_it_lies(captured):
    data, capture = captured
    path = sorted((data / "images/01").iterdir())[1]
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"expected a whole image in .*/data/images/01/.*; got a truncated one"):
        check_images(Capture.open(capture.path), [1])


def test_a_name_with_a_format_is_a_capture_in_the_cache_made_once_and_again_after_a_change(captured, tmp_path, monkeypatch):
    data, capture = captured
    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(tmp_path / "cache"))
    folder = capture_folder(f"easymocap:{data}")
    assert_equal_images(Capture.open(folder), capture)
    assert Capture.open(folder).keypoints is not None
    made = (folder / "capture.yaml").stat().st_mtime_ns
    assert capture_folder(f"easymocap:{data}") == folder and (folder / "capture.yaml").stat().st_mtime_ns == made
    for camera in ("01", "3", "cam-b"):
        sorted((data / "images" / camera).iterdir())[-1].unlink()
    again = capture_folder(f"easymocap:{data}")
    assert again != folder and len(Capture.open(again).frames) == len(capture.frames) - 1
    assert again.name == "data", "reports and contact sheets are named after the data set"
    assert [entry.name for entry in again.parents[1].iterdir()] == [again.parent.name], "nothing of the old state, nothing half made"


def test_a_data_set_that_cannot_be_read_leaves_nothing_in_the_cache(captured, tmp_path, monkeypatch):
    data, _ = captured
    monkeypatch.setenv("MITSUBA_AVATAR_CACHE", str(tmp_path / "cache"))
    (data / "keypoints3d/000002.json").write_text("{")
    with pytest.raises(ValueError, match=r"expected JSON in .*000002.json"):
        capture_folder(f"easymocap:{data}")
    assert not [path for path in (tmp_path / "cache").rglob("*") if path.is_file()]


def test_options_that_write_images_are_refused(captured):
    with pytest.raises(ValueError, match="expected neither links nor another image format where images are read in place"):
        ConversionOptions(links=True, images_from=captured[1].description.images_from)


def test_names_of_captures(tmp_path, monkeypatch):
    assert SourceName.parse("a/folder") is None and SourceName.parse("C:\\captures") is None
    assert str(SourceName.parse("zju:data")).startswith("zju:/")
    with pytest.raises(ValueError, match=r"FORMAT one of goliath, actorshq, easymocap, .*; got 'golliath:data'"):
        SourceName.parse("golliath:data")
    with pytest.raises(FileNotFoundError, match=r"expected a folder at .*nowhere; got none"):
        capture_folder(f"goliath:{tmp_path / 'nowhere'}")
    (tmp_path / "odd:name").mkdir()
    assert capture_folder(tmp_path / "odd:name") == tmp_path / "odd:name", "a folder that is there is a folder"


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("images_from: elsewhere", r"Expected images_from with format and path; got 'elsewhere'"),
        ("images_from: {format: zju, path: a, stat: 1}", r"got 'stat'. Did you mean 'state'"),
        ("images_from: {format: zju, path: a, has_masks: 3}", r"Expected has_masks to be true or false; got 3"),
        ("images_from: {format: zju, path: a, up: w}", r"Expected up to be one of auto, cameras, x"),
    ],
)
def test_a_description_that_cannot_be_read_is_named(captured, written, message):
    _, capture = captured
    text = (capture.path / "capture.yaml").read_text()
    start, stop = text.index("images_from:"), text.index("licence:")
    (capture.path / "capture.yaml").write_text(text[:start] + written + "\n" + text[stop:])
    with pytest.raises(ValueError, match=message):
        Capture.open(capture.path)
