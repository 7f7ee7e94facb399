"""Pictures of an avatar that no camera took: which ones a path asks for, and drawing any one of them alone.

A picture depends on its own number in the path, its frame and its camera, never on the pictures before it: any subset, in any order, on
any machine of the same kind, gives the same bytes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float64
from torch import Tensor

from mitsuba_avatar.captures.cameras import Camera
from mitsuba_avatar.command_line import parse_shard
from mitsuba_avatar.rendering.cameras import CameraBatch
from mitsuba_avatar.rendering.path_tracing import PathTracer, SampleBudget
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from mitsuba_avatar.reporting.playback import Playback, PosedAvatar


@dataclass(frozen=True, eq=False)
class NovelView:
    """One picture of a path.

    Attributes:
        number: place in the path, and seed.
        name: of its files, without ending; equal names are equal pictures.
        frame: index into the driving capture.
        camera: that sees it.
        turn: [4, 4] rigid, moves the posed person.
    """

    number: int
    name: str
    frame: int
    camera: Camera
    turn: Float64[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class DrawnView:
    """A picture and the geometry in it.

    Attributes:
        vertices: [V, 3] posed, metres, world axes.
        radiance: [H, W, 3] linear, premultiplied; coverage: [H, W].
        layers: further layers by the names of `reporting.exr`; of the avatar alone, also where objects of a scene hide it.
        comments: what it took.
    """

    vertices: Float[np.ndarray, "V 3"]
    radiance: Float[np.ndarray, "H W 3"]
    coverage: Float[np.ndarray, "H W"]
    layers: Mapping[str, Float[np.ndarray, "H W *C"]]
    comments: str

    def exr_layers(self) -> dict[str, Float[np.ndarray, "H W *C"]]:
        """Everything that a multi-channel EXR holds."""
        return {"colour": np.concatenate([self.radiance, self.coverage[..., None]], axis=2), **self.layers}


@dataclass(frozen=True, eq=False)
class ViewPainter:
    """Draws novel views.

    Attributes:
        playback: the avatar and its frames.
        renderer: of a film that holds the largest picture of the path; draws radiance as captured, and the layers.
        albedo: [3, T, T]; None leaves the layer out.
        tracer: of a lit scene; None draws radiance as captured.
        budget: of samples, for the tracer.
    """

    playback: Playback
    renderer: SurfaceRenderer
    albedo: Float[Tensor, "3 T T"] | None = None
    tracer: PathTracer | None = None
    budget: SampleBudget = SampleBudget()

    def draw(self, view: NovelView, has_layers: bool = True) -> DrawnView:
        """Draw one view; `has_layers` false saves their time.

        Raises:
            ValueError: relighting without an albedo.
        """
        posed = self.playback.pose(view.frame, view.camera.center_world[None], view.turn)
        seen = (slice(view.camera.height), slice(view.camera.width))
        radiance, mask, layers = self._surface(view, posed, has_layers)
        radiance, mask = np.ascontiguousarray(radiance[seen]), np.ascontiguousarray(mask[seen])
        layers = {name: np.ascontiguousarray(layer[seen]) for name, layer in layers.items()}
        comments = f"samples {self.renderer.samples_per_pixel}"
        if self.tracer is not None:
            self._place(posed)
            traced = self.tracer.draw(view.camera, posed.vertices.numpy(), self.budget, view.number)
            radiance, mask = traced.radiance, traced.coverage
            comments = f"samples {traced.samples}, relative noise {traced.noise:.4f}"
        comments = f"picture {view.number} (its seed), frame index {view.frame}, {comments}"
        return DrawnView(posed.vertices.numpy(), radiance, mask, layers, comments)

    def samples_within(self, seconds: float, view: NovelView) -> int:
        """Samples a pixel that path-trace this view in a time."""
        if self.tracer is None:
            raise ValueError("samples_within(): expected a scene to trace; got none. A time budget is for path tracing: name a scene.")
        posed = self.playback.pose(view.frame, view.camera.center_world[None], view.turn)
        self._place(posed)
        return self.tracer.samples_within(seconds, view.camera, posed.vertices.numpy())

    def _place(self, posed: PosedAvatar) -> None:
        if self.tracer is None:
            return
        if self.tracer.lit.light == "baked":
            self.tracer.lit.place(posed.vertices, posed.textures[0])
        elif self.albedo is None:
            raise ValueError("ViewPainter(): expected an albedo to relight; got None. Estimate it with reporting.relighting.")
        else:
            self.tracer.lit.place(posed.vertices, self.albedo)

    def _surface(self, view: NovelView, posed: PosedAvatar, has_layers: bool) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Radiance as captured, mask and layers; nothing where the tracer draws and no layers are wanted."""
        if self.tracer is not None and not has_layers:
            return np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.float32), {}
        batch, seed = CameraBatch.from_cameras([view.camera]), view.number
        with torch.no_grad():
            if not has_layers:
                radiance, mask = self.renderer.render(posed.vertices[None], posed.textures, batch, seed=seed)
                return _image(radiance), _image(mask)[..., 0], {}
            drawn = self.renderer.render_layers(posed.vertices[None], posed.textures, batch, seed=seed)
            layers = {name: _image(getattr(drawn, name)) for name in ("normal", "position", "uv")}
            layers |= {"depth": _image(drawn.depth)[..., 0], "mask": _image(drawn.mask)[..., 0]}
            share = posed.ambient_occlusion.expand(1, 3, -1, -1).contiguous()
            layers["ambient_occlusion"] = _image(self.renderer.render(posed.vertices[None], share, batch, seed=seed)[0])[..., 0]
            if self.albedo is not None:
                layers["albedo"] = _image(self.renderer.render(posed.vertices[None], self.albedo[None], batch, seed=seed)[0])
        return _image(drawn.radiance), layers["mask"], layers


def pictures_of(text: str, count: int) -> list[int]:
    """Which pictures of a path a list like `0,5,10:20,30:` means: single ones, and ranges that leave out their end.

    Raises:
        ValueError: something else, or a number that the path does not have.
    """
    chosen: list[int] = []
    for part in filter(None, (word.strip() for word in text.split(","))):
        first, colon, last = part.partition(":")
        try:
            start, stop = int(first or 0), int(last) if last else count if colon else int(first) + 1
        except ValueError as error:
            raise ValueError(f"pictures_of(): expected numbers and ranges like 0,5,10:20; got {text!r}. Use commas.") from error
        if not 0 <= start < stop <= count:
            raise ValueError(f"pictures_of(): expected pictures 0..{count - 1} of this path; got {part!r}. Correct --only.")
        chosen += range(start, stop)
    return sorted(set(chosen)) if chosen else list(range(count))


def shard_of(text: str, items: Sequence[int]) -> list[int]:
    """The part of the items that shard `i/n` draws: every n-th, so that slow stretches are shared. Empty text is all.

    Raises:
        ValueError: not of the form i/n with 0 <= i < n.
    """
    index, count = parse_shard(text)
    return list(items)[index::count]


def _image(batch: Float[Tensor, "1 C H W"]) -> Float[np.ndarray, "H W C"]:
    return np.ascontiguousarray(batch[0].permute(1, 2, 0).cpu().numpy())
