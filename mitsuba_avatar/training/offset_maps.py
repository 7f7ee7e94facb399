"""What the encoder reads of every training frame, made when the frame is first met and kept.

Unposing a mesh takes a tenth of a training step, and always gives the same.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from mitsuba_avatar.model.avatar import Avatar
from mitsuba_avatar.training.batches import FrameBatch

MOST_BYTES = 1 << 28  # of kept maps: 5000 frames at 64 texels, 1300 at 128; frames beyond are unposed in every step


class OffsetMaps:
    """`Avatar.offset_maps` of the frames of one capture.

    Args:
        avatar: with a latent code, on its device.
        most_bytes: that kept maps may take.
    """

    def __init__(self, avatar: Avatar, most_bytes: int = MOST_BYTES):
        self.avatar = avatar
        self.most = most_bytes // (3 * 4 * avatar.settings.encoder_size**2)
        self.kept: dict[int, Tensor] = {}

    @torch.no_grad()
    def of(self, batch: FrameBatch) -> Float[Tensor, "P 3 E E"] | None:
        """Maps of a batch's frames, in its order; None where it has no registered meshes."""
        if batch.vertices is None:
            return None
        maps = {row: self.kept[frame] for row, frame in enumerate(batch.frames) if frame in self.kept}
        missing = [row for row in range(len(batch.frames)) if row not in maps]
        if missing:
            unposed = self.avatar.unpose(batch.vertices[missing], batch.theta[missing], batch.root[missing])
            for row, made in zip(missing, self.avatar.offset_maps(unposed), strict=True):
                maps[row] = made
                if len(self.kept) < self.most and bool(made.isfinite().all()):  # what is broken is not kept: a guard skips the step
                    self.kept[batch.frames[row]] = made.clone()
        return torch.stack([maps[row] for row in range(len(batch.frames))])
