"""Steady operation: no new kernels, flat memory, other threads and processes, backward passes in any order."""

import gc
import subprocess
import sys
import threading
from pathlib import Path

import drjit as dr
import numpy as np
import pytest
import torch

from mitsuba_avatar.rendering.surface import SurfaceRenderer
from tests.rendering import meshes

FILM = (30, 22)


def step(renderer, vertices, seed: int, views: int = 4) -> torch.Tensor:
    """One iteration with everything changed that may change from call to call; returns the vertices' gradient."""
    generator = torch.Generator().manual_seed(seed)
    count = len(vertices)
    scale = 0.3 + torch.rand(count, 1, 1, generator=generator)  # changes the number of foreground pixels and of contour edges
    moved = (vertices * scale + 0.2 * torch.randn(count, 1, 3, generator=generator)).requires_grad_()
    textures = torch.rand(views, 3, 16, 20, generator=generator).requires_grad_()
    corner = 20 * torch.rand(views, 2, generator=generator) - 10
    cameras = meshes.orbit(views, *FILM, distance=1.5 + seed % 7).shifted(corner)
    radiance, mask = renderer.render(moved, textures, cameras, seed=seed)
    (radiance.square().sum() + mask.square().sum()).backward()
    return moved.grad


@pytest.mark.parametrize("count", [1, 2])
def test_no_kernel_is_compiled_after_warm_up(count):
    vertices, topology = meshes.arms_before_torso()
    vertices = torch.tensor(vertices, dtype=torch.float32).repeat(count, 1, 1)
    renderer = SurfaceRenderer(topology, *FILM, samples_per_pixel=2)
    for seed in range(4):
        step(renderer, vertices, seed)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for seed in range(10, 40):
            step(renderer, vertices, seed)
        history = [entry for entry in dr.kernel_history() if "cache_hit" in entry]
        dr.kernel_history_clear()
    assert history
    compiled = [entry for entry in history if not entry["cache_hit"]]
    assert not compiled, f"{len(compiled)} of {len(history)} launches compiled a kernel, of sizes {[entry['size'] for entry in compiled]}"


def test_calls_with_consecutive_seeds_complement_each_other():
    """The mean of eight calls in a row is quieter than that of eight independent ones, whose deviation is one's over the root of eight."""
    vertices, topology = meshes.sphere(2)
    vertices = torch.tensor(np.stack([vertices, 0.8 * vertices]), dtype=torch.float32)
    renderer, cameras = SurfaceRenderer(topology, *FILM, boundary_samples_per_edge=2), meshes.orbit(4, *FILM)
    weights = torch.linspace(-1, 1, FILM[0]) * torch.linspace(0, 1, FILM[1])[:, None]

    def gradient(seed: int) -> torch.Tensor:
        moved = vertices.clone().requires_grad_()
        _, mask = renderer.render(moved, torch.ones(4, 3, 5, 7), cameras, seed=seed)
        (mask * weights).sum().backward()
        return moved.grad.sum(dim=1)

    gradients = torch.stack([gradient(seed) for seed in range(96)])
    alone = gradients.std(dim=0).square().mean().sqrt()
    together = gradients.reshape(12, 8, 2, 3).mean(dim=1).std(dim=0).square().mean().sqrt()
    assert 0 < together < 0.6 * alone / 8**0.5


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096


def memory_growth(calls: int) -> float:
    """Bytes a call by which the process grows, after warm-up."""
    vertices, topology = meshes.sphere(2)
    vertices = torch.tensor(vertices, dtype=torch.float32).repeat(2, 1, 1)
    renderer = SurfaceRenderer(topology, *FILM)
    for seed in range(60):
        step(renderer, vertices, seed)
    gc.collect()
    before = resident_bytes()
    for seed in range(calls):
        step(renderer, vertices, seed)
    gc.collect()
    return (resident_bytes() - before) / calls


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the process's memory from /proc")
def test_memory_is_flat():
    assert memory_growth(200) < 20_000  # one leaked texture a call would be 100 kB


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the process's memory from /proc")
def test_memory_is_flat_over_a_long_run():
    assert memory_growth(2000) < 2_000


def two_renders(renderer, vertices, order: tuple[int, int]) -> list[torch.Tensor]:
    """Gradients of two different batches, rendered one after the other, back-propagated in the given order."""
    inputs = [vertices.clone().requires_grad_(), (1.2 * vertices + 0.1).requires_grad_()]
    textures, cameras = meshes.waves(2, 16, 20), meshes.orbit(2, *FILM, distance=2.5)
    losses = [sum(image.square().sum() for image in renderer.render(x, textures, cameras, seed=5)) for x in inputs]
    for index in order:
        losses[index].backward()
    return [x.grad for x in inputs]


def test_a_late_backward_pass_sees_its_own_meshes():
    vertices, topology = meshes.arms_before_torso()
    vertices = torch.tensor(vertices, dtype=torch.float32)[None]
    renderer = SurfaceRenderer(topology, *FILM)
    alone = []
    for offset in range(2):
        x = (vertices if offset == 0 else 1.2 * vertices + 0.1).clone().requires_grad_()
        images = renderer.render(x, meshes.waves(2, 16, 20), meshes.orbit(2, *FILM, distance=2.5), seed=5)
        sum(image.square().sum() for image in images).backward()
        alone.append(x.grad)
    for order in ((0, 1), (1, 0)):
        for late, expected in zip(two_renders(renderer, vertices, order), alone, strict=True):
            np.testing.assert_allclose(late, expected, atol=1e-3 * float(expected.abs().max()))


def test_backward_from_another_thread():
    vertices, topology = meshes.sphere(1)
    vertices = torch.tensor(vertices, dtype=torch.float32)[None]
    renderer = SurfaceRenderer(topology, *FILM)
    expected = step(renderer, vertices, seed=3)

    moved = {}

    def work():
        moved["gradient"] = step(renderer, vertices, seed=3)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    np.testing.assert_allclose(moved["gradient"], expected, atol=1e-3 * float(expected.abs().max()))


def test_rendering_without_gradients_gives_the_same_image():
    vertices, topology = meshes.sphere(1)
    vertices = torch.tensor(vertices, dtype=torch.float32)[None]
    renderer = SurfaceRenderer(topology, *FILM)
    with torch.no_grad():
        plain, _ = renderer.render(vertices, meshes.waves(2, 16, 20), meshes.orbit(2, *FILM))
    tracked, _ = renderer.render(vertices.requires_grad_(), meshes.waves(2, 16, 20), meshes.orbit(2, *FILM))
    assert torch.equal(plain, tracked.detach())


@pytest.mark.parametrize("wanted", ["vertices", "textures"])
def test_one_gradient_alone_is_that_of_both_together(wanted):
    vertices, topology = meshes.sphere(1)
    renderer = SurfaceRenderer(topology, *FILM)

    def gradient(names):
        inputs = {"vertices": torch.tensor(vertices, dtype=torch.float32)[None], "textures": meshes.waves(2, 16, 20)}
        for name in names:
            inputs[name].requires_grad_()
        radiance, mask = renderer.render(inputs["vertices"], inputs["textures"], meshes.orbit(2, *FILM), seed=1)
        (radiance.square().sum() + mask.square().sum()).backward()
        return inputs[wanted].grad

    both = gradient(("vertices", "textures"))
    np.testing.assert_allclose(gradient((wanted,)), both, atol=1e-4 * float(both.abs().max()))


PROCESS = """
from mitsuba_avatar.rendering.backend import select_variant
select_variant("{variant}")
import torch
from mitsuba_avatar.rendering.surface import SurfaceRenderer
from tests.rendering import meshes
from tests.rendering.test_surface_steady import FILM, step
vertices, topology = meshes.sphere(1)
vertices = torch.tensor(vertices, dtype=torch.float32)[None]
renderer = SurfaceRenderer(topology, *FILM)
gradients = torch.stack([step(renderer, vertices, seed) for seed in range(20)])
assert torch.isfinite(gradients).all()
print(round(float(gradients.abs().sum()), 1))
"""


def test_two_processes_side_by_side(request):
    """Both share torch's and Dr.Jit's kernel caches and all cores, and come to the same gradients."""
    code = PROCESS.format(variant=request.config.getoption("variant"))
    root = Path(__file__).parents[2]
    processes = [subprocess.Popen([sys.executable, "-c", code], cwd=root, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    results = [process.communicate(timeout=120)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0]
    first, second = (float(result) for result in results)
    assert first == pytest.approx(second, rel=1e-4)
