"""Maps that the encoder reads are kept, each for its own frame, and no more than fit."""

import dataclasses

import torch

from mitsuba_avatar.training.offset_maps import OffsetMaps


def test_kept_maps_are_those_of_their_frames_in_any_order(make_trainer):
    trainer = make_trainer()
    maps, reader = OffsetMaps(trainer.avatar), trainer.reader
    frames = reader.capture.frame_indices("train")[:3]

    def batch(*chosen: int):
        return reader.read_surfaces(list(chosen), [[] for _ in chosen])

    def expected(*chosen: int):
        read = batch(*chosen)
        return trainer.avatar.offset_maps(trainer.avatar.unpose(read.vertices, read.theta, read.root))

    torch.testing.assert_close(maps.of(batch(*frames[:2])), expected(*frames[:2]))
    assert sorted(maps.kept) == sorted(frames[:2])
    moved = dataclasses.replace(batch(*frames[::-1]), vertices=batch(*frames[::-1]).vertices + 1.0)
    again = maps.of(moved)
    torch.testing.assert_close(again[1:], expected(frames[1], frames[0]))  # not made anew
    assert not torch.allclose(again[0], expected(frames[2])[0])
    assert not torch.allclose(again[1], again[2])


def test_memory_is_bounded_and_broken_meshes_are_not_kept(make_trainer):
    trainer = make_trainer()
    frames = trainer.reader.capture.frame_indices("train")[:2]
    read = trainer.reader.read_surfaces(list(frames), [[], []])
    none = OffsetMaps(trainer.avatar, most_bytes=100)
    assert none.of(read).shape[0] == 2 and not none.kept
    maps = OffsetMaps(trainer.avatar)
    assert (
        not maps.of(dataclasses.replace(read, vertices=read.vertices * torch.tensor([1.0, float("nan")])[:, None, None]))[1]
        .isfinite()
        .all()
    )
    assert list(maps.kept) == [frames[0]]
    assert maps.of(dataclasses.replace(read, vertices=None)) is None
