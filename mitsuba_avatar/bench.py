"""Time the renderer: `python -m mitsuba_avatar.bench [--json FILE] [--figure FILE]`.

One table: milliseconds a view, forward and forward + backward, of this project's surface renderer on the Anny body, against Mitsuba's
own `direct_projective` integrator (sppc = 1, sppp = 1, sppi = 0) on the same mesh, and against its primary rays alone as the floor. The
contenders take turns, so that whatever else the machine does falls on all of them; figures are medians of the rounds.

A second table times ambient occlusion against trimesh with embreex and against libigl's Embree, where they are installed.
"""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from torch import Tensor

from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.rendering import backend
from mitsuba_avatar.rendering.cameras import CameraBatch

SIZES = ((128, 128), (256, 256), (512, 512), (160, 256))  # width, height
BATCHES = ((1, 1), (8, 1), (8, 4))  # views, meshes
TEXTURE_SIZE = 256
OCCLUSION_SIZE, OCCLUSION_RAYS = 256, 64
WARM_UP = 3  # calls before the first round: kernels compile, buffers are allocated


@dataclass(frozen=True)
class BenchCommand:
    """Time the renderer against Mitsuba's own integrator, and ambient occlusion against other libraries."""

    json: Path | None = None  # write the rows of the first table here
    figure: Path | None = None  # draw the derivative of each pixel beside finite differences here, and time nothing
    rounds: int = 7  # turns of each contender
    variant: str = "auto"  # Mitsuba variant


@dataclass(frozen=True)
class Row:
    """One line of the table; times are milliseconds a view."""

    height: int
    width: int
    views: int
    meshes: int
    ours_forward_ms: float
    ours_ms: float
    direct_projective_forward_ms: float
    direct_projective_ms: float
    primary_ms: float


@dataclass(frozen=True)
class Workload:
    """What every contender draws.

    Attributes:
        vertices: [P, V, 3] the body, and copies of it bent by a little.
        textures: [B, 3, h, w], weights: [B, 4, H, W] of the loss, the mask's last.
    """

    rig: Rig
    vertices: Tensor
    textures: Tensor
    weights: Tensor
    cameras: CameraBatch
    width: int
    height: int


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    command = tyro.cli(BenchCommand, args=arguments)
    try:
        variant = backend.select_variant(command.variant)
    except (ValueError, backend.BackendError) as error:
        sys.stderr.write(f"bench: {error}\n")
        return 2
    from mitsuba_avatar.body.anny_rig import build_anny_rig

    rig = build_anny_rig()
    if command.figure is not None:
        from mitsuba_avatar.derivative_figure import draw_derivative_figure

        draw_derivative_figure(rig, command.figure)
        return 0
    sys.stdout.write(f"{variant}, {torch.get_num_threads()} torch threads, median of {command.rounds} rounds, milliseconds a view\n")
    sys.stdout.write(
        "   height x width  views  meshes   ours: forward  +backward   direct_projective: forward  +backward   factor  primary rays\n"
    )
    rows = []
    for width, height in SIZES:
        for views, meshes in BATCHES:
            row = time_renderers(make_workload(rig, width, height, views, meshes), command.rounds)
            rows.append(row)
            sys.stdout.write(_line(row))
            sys.stdout.flush()
    if command.json is not None:
        with atomic_path(command.json) as temporary:
            temporary.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    sys.stdout.write(f"\nambient occlusion, {OCCLUSION_SIZE}^2 texels, {OCCLUSION_RAYS} rays a texel, milliseconds\n")
    for name, milliseconds in time_occlusion(rig, command.rounds).items():
        sys.stdout.write(f"{name:>24}  {milliseconds:8.1f}\n" if milliseconds is not None else f"{name:>24}  not installed\n")
    return 0


def make_workload(rig: Rig, width: int, height: int, views: int, meshes: int) -> Workload:
    """The rest pose in the middle of the film, seen from all sides; textures, weights and poses are random but the same every time."""
    generator = torch.Generator().manual_seed(0)
    rest = torch.from_numpy(rig.rest_vertices)
    rest = rest - (rest.amin(dim=0) + rest.amax(dim=0)) / 2
    lean = 0.05 * torch.arange(meshes)[:, None] * rest[:, 2]
    vertices = rest.repeat(meshes, 1, 1)
    vertices[..., 0] += lean
    coarse = torch.rand(views, 3, TEXTURE_SIZE // 8, TEXTURE_SIZE // 8, generator=generator)
    textures = torch.nn.functional.interpolate(coarse, size=(TEXTURE_SIZE, TEXTURE_SIZE), mode="bilinear")
    cameras = orbit(views, width, height)
    return Workload(rig, vertices, textures, torch.rand(views, 4, height, width, generator=generator), cameras, width, height)


def orbit(views: int, width: int, height: int) -> CameraBatch:
    """Cameras on a circle of 3 metres around the origin that see the whole body."""
    angle = 2 * np.pi * np.arange(views) / views + 0.3
    centers = np.stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), np.full(views, 0.3)], axis=1)
    forward = -centers / np.linalg.norm(centers, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (views, 1, 1))
    poses[:, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    poses[:, :3, 3] = -np.einsum("bij,bj->bi", poses[:, :3, :3], centers)
    focal = 1.5 * height
    intrinsics = torch.tensor([[focal, focal, width / 2, height / 2]]).repeat(views, 1)
    return CameraBatch(intrinsics, torch.from_numpy(poses.astype(np.float32)))


def time_renderers(workload: Workload, rounds: int) -> Row:
    """All contenders on one workload, in turns."""
    from mitsuba_avatar.bench_contenders import DirectProjective, Ours, PrimaryRays

    views = len(workload.cameras)
    ours, peer, floor = Ours(workload), DirectProjective(workload), PrimaryRays(workload)
    calls = {
        "ours_forward_ms": ours.forward,
        "ours_ms": ours.forward_and_backward,
        "direct_projective_forward_ms": peer.forward,
        "direct_projective_ms": peer.forward_and_backward,
        "primary_ms": floor.trace,
    }
    times = take_turns(calls, rounds)
    return Row(
        height=workload.height,
        width=workload.width,
        views=views,
        meshes=len(workload.vertices),
        **{name: milliseconds / views for name, milliseconds in times.items()},
    )


def take_turns(calls: dict[str, Callable[[], None]], rounds: int) -> dict[str, float]:
    """Median milliseconds of every call over `rounds` rounds in which each has one turn."""
    for call in calls.values():
        for _ in range(WARM_UP):
            call()
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            started = time.perf_counter()
            call()
            times[name].append(1e3 * (time.perf_counter() - started))
    return {name: float(np.median(values)) for name, values in times.items()}


def time_occlusion(rig: Rig, rounds: int) -> dict[str, float | None]:
    """Milliseconds of one map of the rest pose by each library; None where it is not installed."""
    from mitsuba_avatar.bench_contenders import occlusion_contenders

    contenders = occlusion_contenders(rig, OCCLUSION_SIZE, OCCLUSION_RAYS)
    times = take_turns({name: call for name, call in contenders.items() if call is not None}, max(rounds // 2, 1))
    return {name: times.get(name) for name in contenders}


def _line(row: Row) -> str:
    return (
        f"{row.height:>9} x {row.width:<5}  {row.views:5}  {row.meshes:6}  {row.ours_forward_ms:14.2f} {row.ours_ms:10.2f}"
        f"  {row.direct_projective_forward_ms:26.2f} {row.direct_projective_ms:10.2f}  {row.direct_projective_ms / row.ours_ms:6.1f}x"
        f"  {row.primary_ms:12.2f}\n"
    )


if __name__ == "__main__":
    sys.exit(main())
