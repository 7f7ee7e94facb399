"""What happens in front of the cameras, frame by frame: made when it is asked for, so that memory does not grow with the frames.

Simulated garments are the exception: they depend on all that went before in their segment. Each segment is simulated as far as a frame
needs it, and kept on disk (`truth/garment_vertices/` of the capture), where other processes and later runs find it and go on.

Symbols: N frames, V body vertices, G garment vertices. Metres, world axes unless a name says rest.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from scipy.sparse import csr_array

from mitsuba_avatar.body.skeleton import Skeleton
from mitsuba_avatar.body.skinning import pose_vertices, unpose_vertices
from mitsuba_avatar.captures.frames import Frame
from mitsuba_avatar.filming.anatomy import FOOT, LEG
from mitsuba_avatar.filming.cloth_simulation import BodyMotion, ClothSimulator, ClothState
from mitsuba_avatar.filming.garment_layers import register_garment
from mitsuba_avatar.filming.garment_record import GarmentRecord
from mitsuba_avatar.filming.motion import Motion, parts_of, perform
from mitsuba_avatar.filming.person import Person, dress_person
from mitsuba_avatar.filming.settings import ClothingSettings, StudioSettings

Progress = Callable[[int, int], None]  # frames done, frames in all
STRESS_SUBSTEPS = 800  # a second, at least, of wild motion: at 200 some shirts tear within two seconds
ON_THE_FLOOR = (*FOOT, *LEG)  # parts of the body that may be the lowest


@dataclass(frozen=True, eq=False)  # arrays have no truth value to compare by
class Surfaces:
    """One frame.

    Attributes:
        layers: vertices of each of the person's layers, posed.
        registered: [V, 3] the exact registered mesh, posed; rest: [V, 3] the same with the skeleton's movement taken out.
    """

    layers: list[Float32[np.ndarray, "_ 3"]]
    registered: Float32[np.ndarray, "V 3"]
    rest: Float32[np.ndarray, "V 3"]


class Performance:
    """A person and what it does.

    Attributes:
        person: who.
        motion: what, standing on the floor.
        folder: where simulated garments are kept.
    """

    def __init__(self, settings: StudioSettings, folder: Path | str):
        """Dress the person and plan its motion; nothing is simulated yet."""
        self.settings = settings
        self.folder = Path(folder)
        self.person: Person = dress_person(settings)
        rig = self.person.rig
        self._skeleton, self._weights = Skeleton(rig), torch.from_numpy(rig.skinning_weights)
        motion = perform(rig, settings, self.person.action_names)
        self._states = self.person.cloth.states(motion.theta, settings.motion.fps, motion.segments())
        self.motion: Motion = self._on_floor(motion)
        self._segments = self.motion.segments()
        self._records: dict[int, GarmentRecord] = {}

    def __len__(self) -> int:
        """Frames."""
        return len(self.motion.frames)

    def surfaces(self, frame: int) -> Surfaces:
        """All surfaces of a frame. Simulates the frame's segment if nobody has.

        Raises:
            ValueError: if the garment explodes; names frame, segment and the setting to change.
        """
        person, transforms = self.person, self._transforms(self.motion, frame)
        moved = person.cloth.displacements(self._states[frame : frame + 1])[0]
        moved = moved + np.einsum("a,avc->vc", self.motion.actions[frame], person.action_displacements)
        filmed_rest = person.filmed.vertices + moved
        if person.outfit is None:
            rest = filmed_rest.astype(np.float32)
            registered = self._posed(transforms, rest)
            body, garment = registered, []
        else:
            cloth = self.garment(frame)
            body = self._posed(transforms, (filmed_rest + person.under.inset).astype(np.float32))
            bare = self._posed(transforms, (person.registered.vertices + moved).astype(np.float32))
            registered = register_garment(bare[None], person.outfit.mesh, cloth[None])[0]
            rest = self._unposed(transforms, registered)
            garment = [cloth]
        return Surfaces([body, *garment, *(part.surface(body) for part in person.parts)], registered, rest)

    def garment(self, frame: int) -> Float32[np.ndarray, "G 3"]:
        """The simulated garment in a frame."""
        order = self._segment_of(frame)
        if order not in self._records:
            self._records = {order: self.garment_record(order)}  # one open file at a time
        index = frame - self._segments[order].start
        self._records[order].extend(index, lambda after: self._states_of(order, self.settings.clothing, after), lambda _: None)
        return self._records[order].frame(index)

    def simulate_missing(self, frames: Sequence[int], progress: Progress) -> None:
        """Simulate each segment as far as these frames need it; `progress` counts the frames of all of them that were missing.

        A garment depends on all that went before in its segment: frames between those asked for are simulated too.

        Raises:
            ValueError: as `surfaces`; what was simulated before the explosion is kept.
        """
        if self.person.outfit is None:
            return
        needed: dict[int, int] = {}  # segment, by order -> last frame in it
        for frame in frames:
            order = self._segment_of(frame)
            needed[order] = max(needed.get(order, 0), frame - self._segments[order].start)
        records = {order: self.garment_record(order) for order in sorted(needed)}
        missing = {order: max(0, needed[order] + 1 - record.simulated) for order, record in records.items()}
        before, total = 0, sum(missing.values())
        for order, record in records.items():
            record.extend(
                needed[order],
                lambda after, order=order: self._states_of(order, self.settings.clothing, after),
                lambda done, before=before: progress(before + done, total),
            )
            before += missing[order]

    def resimulated(self, order: int, clothing: ClothingSettings) -> Iterator[Float32[np.ndarray, "G 3"]]:
        """The garment of a segment, frame by frame, under other settings of the simulation; nothing is kept."""
        return (state.vertices for state in self._states_of(order, clothing, None))

    def garment_record(self, order: int) -> GarmentRecord:
        """A segment's garment on disk."""
        segment = self._segments[order]
        name = f"{order:03d}_{self.motion.frames[segment.start].segment}.npy"
        return GarmentRecord(self.folder / "garment_vertices" / name, segment.stop - segment.start)

    def _states_of(self, order: int, clothing: ClothingSettings, after: ClothState | None) -> Iterator[ClothState]:
        """Simulate a segment."""
        person, segment = self.person, self._segments[order]
        obstacle = person.outfit.obstacle + person.cloth.displacements(self._states[segment])
        motion = BodyMotion(self.motion.theta[segment], self.motion.root[segment], self.settings.motion.fps, obstacle.astype(np.float32))
        name = self.motion.frames[segment.start].segment
        steady = steady_enough(clothing, self.motion.frames[segment.start])
        return ClothSimulator(person.rig, person.outfit, steady).states(motion, name, self.settings.seed + order, after)

    def body_outline(self, frames: list[int]) -> Float32[np.ndarray, "n v 3"]:
        """Some vertices of the body in some frames, cheaply: where cameras must look."""
        rest = self.person.registered.vertices
        return np.stack([self._posed(self._transforms(self.motion, frame), rest)[::7] for frame in frames])

    def _on_floor(self, motion: Motion) -> Motion:
        """The motion, shifted so that the lowest point of every frame is as high above the floor as it should be, whatever ankles do.

        Skinning is linear in the transforms, and few joints move a vertex: heights of all frames are a product with a sparse matrix.
        """
        feet = np.flatnonzero(self.person.anatomy.weight(ON_THE_FLOOR) > 0.5)
        weights = self.person.rig.skinning_weights[feet].astype(np.float64)
        rest = np.concatenate([self.person.filmed.vertices[feet], np.ones((len(feet), 1))], axis=1)
        height_from_rows = csr_array((weights[:, :, None] * rest[:, None, :]).reshape(len(feet), -1))  # [vertices, J * 4]
        root = motion.root.copy()
        for part in parts_of(len(root)):
            with torch.no_grad():
                transforms = self._skeleton(torch.from_numpy(motion.theta[part]), torch.from_numpy(motion.root[part]))
            rows = transforms[:, :, 2].flatten(1).numpy().astype(np.float64)  # [n, J * 4], what makes z
            root[part, 2, 3] += motion.clearance[part] - (height_from_rows @ rows.T).min(axis=0)
        return replace(motion, root=root)

    def _segment_of(self, frame: int) -> int:
        return next(order for order, segment in enumerate(self._segments) if segment.start <= frame < segment.stop)

    def _transforms(self, motion: Motion, frame: int) -> torch.Tensor:
        with torch.no_grad():
            return self._skeleton(torch.from_numpy(motion.theta[frame : frame + 1]), torch.from_numpy(motion.root[frame : frame + 1]))

    def _posed(self, transforms: torch.Tensor, rest: Float32[np.ndarray, "V 3"]) -> Float32[np.ndarray, "V 3"]:
        with torch.no_grad():
            return pose_vertices(torch.from_numpy(rest)[None], transforms, self._weights)[0].numpy()

    def _unposed(self, transforms: torch.Tensor, posed: Float32[np.ndarray, "V 3"]) -> Float32[np.ndarray, "V 3"]:
        with torch.no_grad():
            return unpose_vertices(torch.from_numpy(posed)[None], transforms, self._weights)[0].numpy()


def steady_enough(clothing: ClothingSettings, frame: Frame) -> ClothingSettings:
    """How the segment of a frame is simulated: as asked for, but wild motion in smaller steps, which are part of what a capture is."""
    if frame.purpose != "stress":
        return clothing
    return replace(clothing, substeps_per_second=max(STRESS_SUBSTEPS, clothing.substeps_per_second))
