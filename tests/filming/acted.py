"""All frames of a short performance at once, for tests that look at whole arrays; the package itself makes them one by one."""

from dataclasses import dataclass

import numpy as np

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.filming.appearance import Appearance
from mitsuba_avatar.filming.motion import Motion
from mitsuba_avatar.filming.performance import Performance
from mitsuba_avatar.filming.person import with_template


@dataclass(frozen=True)
class Acted:
    """A performance: rig with its dressed mean rest shape, paint, motion, and [N, V, 3] registered surfaces at rest and posed."""

    rig: Rig
    appearance: Appearance
    motion: Motion
    rest_vertices: np.ndarray
    vertices: np.ndarray

    @classmethod
    def of(cls, performance: Performance) -> "Acted":
        surfaces = [performance.surfaces(frame) for frame in range(len(performance))]
        rest = np.stack([surface.rest for surface in surfaces])
        train = [index for index, frame in enumerate(performance.motion.frames) if frame.split == "train"]
        rig = with_template(performance.person.rig, rest[train].mean(axis=0))
        vertices = np.stack([surface.registered for surface in surfaces])
        return cls(rig, performance.person.layers[0].appearance, performance.motion, rest, vertices)
