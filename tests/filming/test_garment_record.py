"""A segment's garment, simulated in parts by whoever needs them."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from mitsuba_avatar.filming import garment_record
from mitsuba_avatar.filming.cloth_simulation import ClothState
from mitsuba_avatar.filming.garment_record import GarmentRecord

COUNT = 11


class Counting:
    """A simulation whose garment is the frame's number; knows where it was asked to begin."""

    def __init__(self) -> None:
        self.begun_after: list[int] = []

    def __call__(self, after: ClothState | None) -> Iterator[ClothState]:
        start = -1 if after is None else after.frame
        self.begun_after.append(start)
        for frame in range(start + 1, COUNT):
            vertices = np.full((5, 3), frame, np.float32)
            nothing = np.zeros((5, 3), np.float32)
            faces, places = np.arange(5, dtype=np.int32), np.full((5, 2), 0.25, np.float32)
            yield ClothState(frame, vertices, nothing, 20 * frame, faces, places, places[:, 0], nothing, nothing[:0])


@pytest.fixture
def record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> GarmentRecord:
    monkeypatch.setattr(garment_record, "PIECE", 4)
    return GarmentRecord(tmp_path / "003_walk.npy", COUNT)


def test_a_segment_is_simulated_only_as_far_as_it_is_needed_and_goes_on_there(record: GarmentRecord):
    simulate, done = Counting(), []
    record.extend(5, simulate, done.append)
    assert record.simulated == 6 and done == [1, 2, 3, 4, 5, 6] and not record.path.exists()
    record.extend(2, simulate, done.append)  # is there
    again = GarmentRecord(record.path, COUNT)
    again.extend(8, simulate, done.append)
    assert simulate.begun_after == [-1, 5] and again.simulated == 9
    for index in (8, 0, 5, 3):
        np.testing.assert_array_equal(again.frame(index), np.full((5, 3), index))


def test_the_whole_segment_is_one_file_the_same_however_it_was_made(record: GarmentRecord, tmp_path: Path):
    for until in (0, 6, COUNT - 1):
        record.extend(until, Counting(), lambda _: None)
    at_once = GarmentRecord(tmp_path / "other.npy", COUNT)
    at_once.extend(COUNT - 1, Counting(), lambda _: None)
    assert record.path.read_bytes() == at_once.path.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["003_walk.npy", "other.npy"]
    np.testing.assert_array_equal(np.load(record.path)[:, 0, 0], np.arange(COUNT))
    np.testing.assert_array_equal(record.frame(7), np.full((5, 3), 7))


def test_what_was_simulated_before_an_interruption_is_kept(record: GarmentRecord):
    class Interrupted(Counting):
        def __call__(self, after: ClothState | None) -> Iterator[ClothState]:
            for state in super().__call__(after):
                if state.frame == 6:
                    raise KeyboardInterrupt
                yield state

    with pytest.raises(KeyboardInterrupt):
        record.extend(COUNT - 1, Interrupted(), lambda _: None)
    assert record.simulated == 4
    simulate = Counting()
    record.extend(COUNT - 1, simulate, lambda _: None)
    assert simulate.begun_after == [3] and record.path.is_file()


def test_pieces_of_two_processes_may_overlap(record: GarmentRecord):
    record.extend(2, Counting(), lambda _: None)
    other = GarmentRecord(record.path, COUNT)
    other._last_state = lambda: None  # it began before the first had kept anything
    other.extend(7, Counting(), lambda _: None)
    assert record.simulated == 8
    record.extend(COUNT - 1, Counting(), lambda _: None)
    np.testing.assert_array_equal(np.load(record.path)[:, 4, 2], np.arange(COUNT))
