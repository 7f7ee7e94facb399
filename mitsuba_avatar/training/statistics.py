"""Statistics of the training frames that the avatar is built on: units of the driving signal, mean shape, mean texture."""

from collections.abc import Callable

import numpy as np
import torch

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices, unpose_vertices
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.model.avatar import DrivingStatistics
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.texture_projection import TextureProjection
from mitsuba_avatar.training.batches import composited, stacked_views

MESHES = 64  # frames whose mesh enters the mean shape
TEXTURES = 24  # frames whose images enter the mean texture
GREY = 0.5  # radiance of a surface that no image was read for


def training_statistics(
    capture: Capture,
    rig: Rig,
    texture_size: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
    with_texture: bool = True,
) -> DrivingStatistics:
    """Means and deviations over the training split, seen by the training cameras; held-out images are never read.

    Args:
        capture: with theta, root and face; without vertices, the rig's rest shape stands in for the mean shape.
        rig: of the capture.
        texture_size: texels of the mean texture.
        progress: called as progress(done, total).
        with_texture: whether the mean texture is gathered from the images; otherwise it is grey, and no image is read.
    """
    frames = capture.frame_indices("train")
    theta, face = np.asarray(capture.theta[frames], np.float64), np.asarray(capture.face[frames], np.float64)
    skeleton = Skeleton(rig)
    weights = torch.from_numpy(rig.skinning_weights)

    displacement = torch.zeros(rig.topology.num_vertices, 3, dtype=torch.float64)
    if capture.vertices is not None:
        chosen = evenly_spaced(frames, MESHES)
        for i in chosen:
            posed_from_rest = skeleton(_row(capture.theta, i), _row(capture.root, i))
            displacement += unpose_vertices(_row(capture.vertices, i), posed_from_rest, weights)[0] - torch.from_numpy(rig.rest_vertices)
        displacement /= len(chosen)

    texture = _mean_texture(capture, rig, texture_size, progress) if with_texture else torch.full((3, texture_size, texture_size), GREY)
    return DrivingStatistics(
        theta_mean=torch.from_numpy(theta.mean(0)).float(),
        theta_std=torch.from_numpy(theta.std(0)).float(),
        face_mean=torch.from_numpy(face.mean(0)).float(),
        face_std=torch.from_numpy(face.std(0)).float(),
        mean_texture=texture,
        mean_displacement=displacement.float(),
    )


def _mean_texture(capture: Capture, rig: Rig, texture_size: int, progress: Callable[[int, int], None]) -> torch.Tensor:
    """[3, T, T] radiance that training frames show on the surface, mean over frames and training cameras."""
    skeleton, frames = Skeleton(rig), evenly_spaced(capture.frame_indices("train"), TEXTURES)
    projection = TextureProjection(rig.topology, texture_size)
    names = capture.camera_names(held_out=False)
    cameras = CameraBatch.from_cameras([capture.cameras[name] for name in names])
    film = max(capture.cameras[name].width for name in names), max(capture.cameras[name].height for name in names)
    for done, i in enumerate(frames):
        masks = [capture.mask(name, i) for name in names]
        images = [composited(capture.image(name, i), mask, capture.background(name)) for name, mask in zip(names, masks, strict=True)]
        projection.add(
            registered_vertices(capture, rig, skeleton, i),
            stacked_views(images, *film),
            stacked_views([mask[..., None] for mask in masks], *film),
            cameras,
        )
        progress(done + 1, len(frames))
    return projection.mean()


def registered_vertices(capture: Capture, rig: Rig, skeleton: Skeleton, frame_index: int) -> torch.Tensor:
    """[V, 3] tracked mesh of a frame in the world, metres; the posed rest shape where the capture has none."""
    if capture.vertices is not None:
        return _row(capture.vertices, frame_index)[0]
    posed_from_rest = skeleton(_row(capture.theta, frame_index), _row(capture.root, frame_index))
    return pose_vertices(torch.from_numpy(rig.rest_vertices)[None], posed_from_rest, torch.from_numpy(rig.skinning_weights))[0]


def evenly_spaced(items: list[int], count: int) -> list[int]:
    """At most `count` items, spread evenly over the list, first included."""
    if len(items) <= count:
        return list(items)
    return [items[round(position)] for position in np.linspace(0, len(items) - 1, count)]


def _row(values: np.ndarray, index: int) -> torch.Tensor:
    """One frame's row as a batch of one."""
    return torch.from_numpy(np.array(values[index], np.float32))[None]
