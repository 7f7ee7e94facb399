"""Driving an avatar over a capture and measuring it against the images, beside two baselines that nobody should lose to.

All are *driven* (paper, section 4): theta, face and root of the frame are given, the latent code is zero. The baselines are the posed
template with the mean texture, which knows skinning and nothing else, and the captured image of the training frame nearest in pose,
seen by the same camera, which knows appearance and nothing else. Pictures are composited on the capture's background and measured as
display-encoded values inside the captured mask.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.captures.colour import encode
from mitsuba_avatar.captures.folder import Capture
from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.reporting.lpips import Lpips
from mitsuba_avatar.reporting.metrics import MetricsAccumulator, silhouette_iou, temporal_flicker, vertex_error_mm
from mitsuba_avatar.reporting.protocols import PROTOCOLS, Protocol, protocol_metrics
from mitsuba_avatar.reporting.seams import SeamSampler
from mitsuba_avatar.training.batches import FrameBatch, FrameReader
from mitsuba_avatar.training.statistics import evenly_spaced

METHODS = ("avatar", "template_mean_texture", "nearest_frame")


@dataclass(frozen=True)
class Drawn:
    """What one method makes of one frame, seen by B cameras.

    Attributes:
        images: [B, 3, H, W] display-encoded, composited.
        masks: [B, 1, H, W].
        vertices: [V, 3] metres; None where the method has no mesh.
        texture: [3, T, T] linear radiance towards the first camera; None where the method has no texture.
    """

    images: Float[Tensor, "B 3 H W"]
    masks: Float[Tensor, "B 1 H W"]
    vertices: Float[Tensor, "V 3"] | None
    texture: Float[Tensor, "3 T T"] | None = None


@dataclass(frozen=True)
class Measures:
    """What is measured of a picture beside silhouette and mesh.

    Attributes:
        protocols: regions that image errors are averaged over.
        has_flip: FLIP too; it takes longer than all the others together.
        has_seams: the difference across the texture's seams too.
        lpips: LPIPS with these weights too.
    """

    protocols: tuple[Protocol, ...] = ("mask",)
    has_flip: bool = False
    has_seams: bool = False
    lpips: Lpips | None = None


EVERY_MEASURE = Measures(PROTOCOLS, has_flip=True, has_seams=True)


class Evaluator:
    """Draws and measures frames of a capture with a given avatar.

    Args:
        avatar: to be driven.
        reader: of the capture.
        renderer: of the capture's film size; its samples per pixel set the antialiasing of the pictures.
    """

    def __init__(self, avatar: Avatar, reader: FrameReader, renderer: SurfaceRenderer):
        self.avatar, self.reader, self.renderer = avatar, reader, renderer
        self.capture: Capture = reader.capture
        self.train_frames = self.capture.frame_indices("train")
        self._seams: SeamSampler | None = None

    @torch.no_grad()
    def draw(self, method: str, batch: FrameBatch, z: Float[Tensor, "1 Z"] | None = None) -> Drawn:
        """Draw a batch of one pose with a method of METHODS; what comes back lies in the host's memory.

        Args:
            method: of METHODS.
            batch: of one pose.
            z: the latent code of the method "avatar"; None for z = 0. Other methods have none.

        Raises:
            ValueError: a code is given to an avatar that has none.
        """
        if method == "nearest_frame":
            return self._draw_nearest(batch)
        avatar = self.avatar
        batch = batch.to(avatar.mean_texture.device)
        if method == "avatar":
            z = None if z is None else z.to(avatar.mean_texture.device)
            output = avatar.decode(batch.theta, batch.root, batch.face, z, batch.camera_centers, batch.ambient_occlusion)
            vertices, textures = output.vertices, output.textures[0]
        else:
            vertices = avatar.pose_template(batch.theta, batch.root)
            textures = avatar.mean_texture.expand(len(batch.cameras), -1, -1, -1)
        radiance, masks = self.renderer.render(vertices, textures, batch.cameras, seed=batch.frames[0], background=batch.backgrounds)
        images, masks = batch.within_views(encode(radiance, "srgb").clamp(0, 1)), batch.within_views(masks)
        return Drawn(images.cpu(), masks.cpu(), vertices[0].cpu(), textures[0].cpu())

    def measure(
        self,
        frames: dict[str, list[int]],
        methods: Sequence[str] = METHODS,
        camera_names: Sequence[str] | None = None,
        progress: Callable[[int, int], None] = lambda done, total: None,
        measures: Measures = Measures(),  # noqa: B008 - frozen
    ) -> MetricsAccumulator:
        """Errors of every method over chosen frames of each split, all cameras or chosen ones.

        Args:
            frames: split -> frame indices.
            methods: of METHODS.
            camera_names: None for all.
            progress: called as progress(done, total), in frames.
            measures: which errors.
        """
        result = MetricsAccumulator()
        names = list(camera_names or self.capture.camera_names())
        held_out = set(self.capture.camera_names(held_out=True))
        total, done = sum(map(len, frames.values())), 0
        for split, indices in frames.items():
            for index in indices:
                batch = self.reader.read([index], [names])
                references, masks = batch.pictures(batch.images), batch.coverage(batch.masks)
                number = self.capture.frames[index].number
                for method in methods:
                    drawn = self.draw(method, batch)
                    images, silhouettes = batch.pictures(drawn.images), batch.coverage(drawn.masks)
                    of_frame = self._frame_metrics(drawn, batch, measures)
                    for view, name in enumerate(names):
                        if not masks[view].any():
                            continue  # the person is outside this camera's image
                        values = protocol_metrics(
                            images[view], references[view], masks[view], measures.protocols, measures.has_flip, measures.lpips
                        )
                        values["iou"] = silhouette_iou(silhouettes[view], masks[view])
                        result.add(method, split, "held_out" if name in held_out else "seen", values | of_frame, (name, number))
                done += 1
                progress(done, total)
        return result

    def measure_flicker(
        self,
        frames: dict[str, list[int]],
        methods: Sequence[str] = METHODS,
        camera_names: Sequence[str] | None = None,
        progress: Callable[[int, int], None] = lambda done, total: None,
    ) -> MetricsAccumulator:
        """Temporal flicker (`temporal_flicker`) between chosen frames and their neighbours in time; arguments are those of `measure`.

        A frame's neighbour is the one after it, before it at a segment's end; frames of segments of one frame have none and are left out.
        """
        result = MetricsAccumulator()
        names = list(camera_names or self.capture.camera_names())
        held_out = set(self.capture.camera_names(held_out=True))
        total, done = sum(map(len, frames.values())), 0
        for split, indices in frames.items():
            for index in indices:
                pair = self._neighbours(index)
                batches = [self.reader.read([frame], [names]) for frame in pair]
                references = _moments([batch.pictures(batch.images) for batch in batches])
                masks = _moments([batch.coverage(batch.masks) for batch in batches])
                number = self.capture.frames[index].number
                for method in methods if len(pair) == 2 else ():
                    images = _moments([batch.pictures(self.draw(method, batch).images) for batch in batches])
                    for view, name in enumerate(names):
                        if masks[view].any():
                            values = {"flicker": temporal_flicker(images[view], references[view], masks[view])}
                            result.add(method, split, "held_out" if name in held_out else "seen", values, (name, number))
                done += 1
                progress(done, total)
        return result

    def split_frames(self, per_split: int) -> dict[str, list[int]]:
        """At most `per_split` evenly spaced frames of each split that the capture has."""
        splits = {frame.purpose for frame in self.capture.frames}
        return {split: evenly_spaced(self.capture.frame_indices(split), per_split) for split in ("train", "test") if split in splits}

    def _frame_metrics(self, drawn: Drawn, batch: FrameBatch, measures: Measures) -> dict[str, float]:
        """Errors that all cameras of a frame share."""
        values = {}
        if drawn.vertices is not None and batch.vertices is not None:
            values["vertex_mm"] = vertex_error_mm(drawn.vertices.numpy(), batch.vertices[0].numpy())
        if measures.has_seams and drawn.texture is not None:
            self._seams = self._seams or SeamSampler(self.renderer.topology)
            values["seam"] = self._seams.difference(drawn.texture)
        return values

    def _neighbours(self, index: int) -> list[int]:
        """A frame and the next of its segment and split, in order of time; the one before it at the end; alone where there is neither."""
        frames = self.capture.frames
        place = (frames[index].split, frames[index].segment)
        for pair in ([index, index + 1], [index - 1, index]):
            if all(0 <= i < len(frames) and (frames[i].split, frames[i].segment) == place for i in pair):
                return pair
        return [index]

    def _draw_nearest(self, batch: FrameBatch) -> Drawn:
        """The captured images of the training frame nearest in pose angles; for a training frame, the nearest other one."""
        candidates = [i for i in self.train_frames if i != batch.frames[0]]
        distance = np.linalg.norm(self.capture.theta[candidates] - batch.theta.numpy(), axis=1)
        nearest = self.reader.read([candidates[int(distance.argmin())]], batch.camera_names)
        vertices = None if nearest.vertices is None else nearest.vertices[0]
        return Drawn(nearest.images, nearest.masks, vertices)


def _moments(pictures: Sequence[Sequence[Float[np.ndarray, "..."]]]) -> list[Float[np.ndarray, "2 ..."]]:
    """For every view the pictures of all moments in one array; `pictures` lists the views of each moment."""
    return [np.stack(of_view) for of_view in zip(*pictures, strict=True)]


def as_images(images: Float[Tensor, "B C H W"]) -> Float[np.ndarray, "B H W C"]:
    """Torch's channel order to numpy's, from any device."""
    return images.permute(0, 2, 3, 1).contiguous().cpu().numpy()
