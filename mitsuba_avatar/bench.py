"""Time the renderer: `python -m mitsuba_avatar.bench [--json FILE] [--noise] [--bias] [--figure FILE]`.

One table: milliseconds a view, forward and forward + backward, of this project's surface renderer on the Anny body, against Mitsuba's
own `direct_projective` integrator (sppc = 1, sppp = 1, sppi = 0) on the same mesh, and against its primary rays alone as the floor. The
contenders take turns, so that whatever else the machine does falls on all of them; figures are medians of the rounds.

A second table times ambient occlusion against trimesh with embreex and against libigl's Embree, where they are installed. With --noise
another table shows how noisy gradients are at different sample counts, and what they cost; with --bias, how far their means are from finite
differences.
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

from mitsuba_avatar.benchmarking.workload import Workload, make_workload
from mitsuba_avatar.body.rig import Rig
from mitsuba_avatar.command_line import interruptible
from mitsuba_avatar.files import atomic_path
from mitsuba_avatar.rendering import backend

SIZES = ((128, 128), (256, 256), (512, 512), (160, 256))  # width, height
BATCHES = ((1, 1), (8, 1), (8, 4))  # views, meshes
OCCLUSION_SIZE, OCCLUSION_RAYS = 256, 64
WARM_UP = 3  # calls before the first round: kernels compile, buffers are allocated
TURN_SECONDS = 0.25  # at least, of counted calls


@dataclass(frozen=True)
class BenchCommand:
    """Time the renderer against Mitsuba's own integrator, and ambient occlusion against other libraries."""

    json: Path | None = None  # write the rows of the first table here
    figure: Path | None = None  # draw the derivative of each pixel beside finite differences here, and time nothing
    noise: bool = False  # measure the noise of gradients at different sample counts instead
    bias: bool = False  # hold mean gradients against finite differences instead
    rounds: int = 7  # turns of each contender; with --noise and --bias, seeds grow with it
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


@interruptible("bench", kept="nothing is kept. Give the same command again to measure anew.")
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
        from mitsuba_avatar.benchmarking.derivative_figure import draw_derivative_figure

        draw_derivative_figure(rig, command.figure)
        return 0
    if command.noise:
        write_noise_table(rig, command.rounds)
        return 0
    if command.bias:
        write_bias_table(rig, command.rounds)
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


def time_renderers(workload: Workload, rounds: int) -> Row:
    """All contenders on one workload, in turns."""
    from mitsuba_avatar.benchmarking.contenders import DirectProjective, Ours, PrimaryRays

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


def write_noise_table(rig: Rig, rounds: int) -> None:
    """Measure and print what sample counts cost and what they give, row by row."""
    from mitsuba_avatar.benchmarking.noise import CALLS, contenders, measure_averages, measure_noise, noise_workload, surface_contender

    workload = noise_workload(rig)
    swept = contenders(workload)
    times = take_turns({contender.name: contender.render for contender in swept}, rounds)
    sys.stdout.write(
        "standard deviation of one evaluation, per cent of the largest derivative, and times square root of milliseconds\n"
        "samples a pixel, an edge       ms   radiance     mask   radiance x sqrt(ms)   mask x sqrt(ms)\n"
    )
    for contender in swept:
        row = measure_noise(contender, workload, 2 * rounds, times[contender.name])
        per_cent = [100 * value for value in (row.radiance, row.mask, row.at_equal_time(row.radiance), row.at_equal_time(row.mask))]
        sys.stdout.write(
            f"{row.name:>24} {row.milliseconds:8.1f} {per_cent[0]:10.2f} {per_cent[1]:8.2f} {per_cent[2]:21.1f} {per_cent[3]:17.1f}\n"
        )
        sys.stdout.flush()
    sys.stdout.write(
        "\nstandard deviation of the mean over consecutive calls, per cent; in brackets what independent calls would give\n"
        f"{'samples':>10}{'':>10}" + "".join(f"{calls:>8} calls " for calls in CALLS) + "\n"
    )
    for settings in ((1, 2), (4, 4)):
        rows = 100 * measure_averages(surface_contender(workload, *settings), workload, max(rounds, 2))
        for part, row in zip(("radiance", "mask"), rows, strict=True):
            cells = [f" {value:6.2f} ({row[0] / calls**0.5:5.2f})" for value, calls in zip(row, CALLS, strict=True)]
            sys.stdout.write(f"{settings[0]:>7}, {settings[1]}{part:>10}" + "".join(cells) + "\n")
            sys.stdout.flush()


def write_bias_table(rig: Rig, rounds: int) -> None:
    """Hold mean gradients against finite differences and print the table."""
    from mitsuba_avatar.benchmarking.bias import MOTIONS, finite_differences, mean_derivatives
    from mitsuba_avatar.benchmarking.noise import noise_workload, projective_contender, surface_contender
    from mitsuba_avatar.progress import progress_bar

    workload = noise_workload(rig)
    # The peer's bias is tens of per cent and its calls are slow: few of them tell.
    contenders = {
        "ours": (surface_contender(workload, 4, 4), 10 * rounds),
        "direct_projective": (projective_contender(workload), 2 * rounds),
    }
    done, total = 0, 2 * rounds + sum(repeats for _, repeats in contenders.values())
    with progress_bar("gradients", total) as bar:

        def count() -> None:
            nonlocal done
            done += 1
            bar.update(done)

        reference = finite_differences(workload, 2 * rounds, count)
        estimates = {name: mean_derivatives(contender, workload, repeats, count) for name, (contender, repeats) in contenders.items()}
    sys.stdout.write("mean derivative minus finite difference, per cent of the largest of the four, +- standard error\n")
    sys.stdout.write(f"{'':>28}" + "".join(f"{motion:>18}" for motion in MOTIONS) + "\n")
    for name, estimate in estimates.items():
        bias = estimate.bias(reference)
        for row, part in enumerate(("radiance", "mask")):
            cells = [f"{100 * bias.mean[row, k]:+10.2f} +- {100 * bias.error[row, k]:4.2f}" for k in range(len(MOTIONS))]
            if not np.isnan(bias.mean[row]).any():
                sys.stdout.write(f"{name + ', ' + part:>28}" + "".join(f"{cell:>18}" for cell in cells) + "\n")


def take_turns(calls: dict[str, Callable[[], None]], rounds: int) -> dict[str, float]:
    """Median milliseconds of a call; in each of the rounds every contender has one turn.

    In its turn a contender runs in a loop, as a training does, until `TURN_SECONDS` have passed. The first call of a turn is not
    counted, whoever's it is: it pays for what the others left in caches and in the allocator.
    """
    for call in calls.values():
        for _ in range(WARM_UP):
            call()
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            call()
            turn_started = started = time.perf_counter()
            while started - turn_started < TURN_SECONDS:
                call()
                ended = time.perf_counter()
                times[name].append(1e3 * (ended - started))
                started = ended
    return {name: float(np.median(values)) for name, values in times.items()}


def time_occlusion(rig: Rig, rounds: int) -> dict[str, float | None]:
    """Milliseconds of one map of the rest pose by each library; None where it is not installed."""
    from mitsuba_avatar.benchmarking.contenders import occlusion_contenders

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
