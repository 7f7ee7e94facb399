"""Which pictures of a path are meant, and which a shard draws."""

import pytest

from mitsuba_avatar.reporting.novel_views import pictures_of, shard_of


@pytest.mark.parametrize(
    ("text", "chosen"), [("", [0, 1, 2, 3, 4, 5, 6]), ("3", [3]), ("5:,0", [0, 5, 6]), (":2,1, 4", [0, 1, 4]), ("2:4", [2, 3])]
)
def test_lists_and_ranges(text, chosen):
    assert pictures_of(text, 7) == chosen


@pytest.mark.parametrize("text", ["7", "-1", "4:3", "2:9", "one"])
def test_what_the_path_does_not_have_is_refused(text):
    with pytest.raises(ValueError, match="pictures_of"):
        pictures_of(text, 7)


def test_shards_share_the_pictures_out():
    pictures = [0, 1, 4, 5, 6, 9, 11]
    shards = [shard_of(f"{i}/3", pictures) for i in range(3)]
    assert sorted(sum(shards, [])) == pictures and max(map(len, shards)) - min(map(len, shards)) <= 1
    assert shard_of("", pictures) == pictures


@pytest.mark.parametrize("text", ["3/3", "1", "a/2", "-1/2", "0/0"])
def test_impossible_shards_are_refused(text):
    with pytest.raises(ValueError, match="--shard i/n"):
        shard_of(text, [1, 2])
