"""The optimisation loop: it learns, it repeats itself exactly where it should, and it says what went wrong."""

import dataclasses
import json

import pytest
import torch

from mitsuba_avatar.fitting import Fit
from mitsuba_avatar.model.encoder import Posterior
from mitsuba_avatar.training.batches import FrameReader
from mitsuba_avatar.training.checkpoints import Checkpoints
from mitsuba_avatar.training.distributed import Process
from mitsuba_avatar.training.loop import DivergedError, MetricsLog, StepTimer
from mitsuba_avatar.training.losses import evaluate_losses
from mitsuba_avatar.training.run_folder import RunFolder

pytestmark = pytest.mark.usefixtures("one_thread")

TERMS = ["loss", "image", "mask", "geometry", "laplacian", "kl"]


class MemoryReader(FrameReader):
    """A reader of batches that may be changed, and of captures with less in them."""

    def __init__(self, reader, **changes):
        super().__init__(reader.capture, reader.occlusion)
        self.changes = changes

    def read(self, frames, camera_names):
        return dataclasses.replace(super().read(frames, camera_names), **self.changes)


def run(trainer, stop=None):
    """Train to the end, or stop after an iteration; returns the terms of every step."""
    records = []

    def after_step(iteration, terms):
        records.append(terms)
        return iteration != stop

    trainer.run(after_step)
    return records


def parameters(trainer):
    return torch.cat([parameter.detach().flatten() for parameter in trainer.avatar.parameters()])


def test_steps_on_one_batch_reduce_its_loss(make_trainer):
    trainer = make_trainer("training.learning_rate=5e-3", "training.iterations=1000", "loss.geometry_iterations=1000", "loss.kl=0")
    batch = trainer.reader.read(*trainer.sampler.draw(0))
    records = [trainer.step(batch) for _ in range(14)]
    assert list(records[0]) == [name for name in TERMS if name != "kl"]
    assert records[-1]["loss"] < 0.6 * records[0]["loss"]
    assert records[-1]["image"] < 0.7 * records[0]["image"] and records[-1]["geometry"] < 0.7 * records[0]["geometry"]


def test_the_loss_is_the_weighted_sum_of_the_logged_terms(make_trainer):
    trainer = make_trainer()
    terms = trainer.step(trainer.reader.read(*trainer.sampler.draw(0)))
    weights = dataclasses.asdict(trainer.settings.loss)
    assert list(terms) == TERMS
    assert terms["loss"] == pytest.approx(sum(weights[name] * terms[name] for name in TERMS[1:]), rel=1e-5)


def test_every_parameter_learns(make_trainer):
    """After a few steps no parameter is where it began: nothing is cut off from the loss."""
    trainer = make_trainer("training.iterations=3")
    before = {name: parameter.detach().clone() for name, parameter in trainer.avatar.named_parameters()}
    run(trainer)
    still = [name for name, parameter in trainer.avatar.named_parameters() if torch.equal(parameter, before[name])]
    assert not still


@pytest.mark.parametrize(
    ("override", "vertices", "terms"),
    [
        ("model.use_latent=false", ..., ["loss", "image", "mask", "geometry", "laplacian"]),
        ("model.use_latent=false", None, ["loss", "image", "mask"]),
        ("model.use_shadow=false", ..., TERMS),
        ("loss.laplacian=0", ..., ["loss", "image", "mask", "geometry", "kl"]),
    ],
    ids=["without latent code", "without meshes", "without shadow", "without a term"],
)
def test_parts_may_be_left_out(make_trainer, reader, override, vertices, terms):
    changes = {} if vertices is ... else {"vertices": vertices}
    trainer = make_trainer(override, "training.iterations=2", reader=MemoryReader(reader, **changes))
    assert [list(record) for record in run(trainer)] == [terms, terms]


def test_pixels_beyond_a_smaller_image_count_nowhere(make_trainer, two_sizes_reader):
    """What is drawn there is not looked at: the loss is that of the pixels within."""
    frames, names = [3, 6], [["left", "front"], ["right", "left"]]
    trainer = make_trainer("loss.geometry=0", "loss.laplacian=0", "loss.kl=0", reader=two_sizes_reader)
    batch = two_sizes_reader.read(frames, names)
    with torch.no_grad():
        inputs = trainer._rendered(batch, trainer.latent_noise(2))
        terms = evaluate_losses(inputs, {"image": 1.0, "mask": 1.0})
    within = batch.within_views(torch.ones_like(batch.images)) > 0
    assert not inputs.image[~within].any() and not inputs.mask[~within[:, :1]].any()
    expected = (inputs.image - batch.images).abs()[within].sum() / (3 * batch.masks.sum())
    assert float(terms["image"]) == pytest.approx(float(expected), rel=1e-5)
    assert float(trainer.step(batch)["loss"]) > 0


def test_an_image_that_is_not_a_number_is_named(make_trainer, reader):
    trainer = make_trainer()
    batch = trainer.reader.read([5, 2], [["left", "front"], ["back", "right"]])
    batch.images[2, 1, 3, 4] = float("nan")
    before = parameters(trainer)
    with pytest.raises(
        DivergedError,
        match=r"loss term image is not finite at iteration 0, frames \[25, 22\], cameras \[\['left', 'front'\], \['back', 'right'\]\]",
    ):
        trainer.step(batch)
    assert torch.equal(parameters(trainer), before)


def test_an_absurd_learning_rate_is_named(make_trainer):
    """The surface flies away before the loss is asked for; the renderer must not be the one to complain."""
    trainer = make_trainer("training.learning_rate=1e30", "training.iterations=20")
    with pytest.raises(DivergedError, match=r"is not finite at iteration \d+, frames .* Lower training\.learning_rate"):
        run(trainer)
    assert trainer.iteration < 5


class DamagedReader(FrameReader):
    """A reader some of whose calls return an image that is not a number, or one that is absurdly bright."""

    def __init__(self, reader, damages):
        super().__init__(reader.capture, reader.occlusion)
        self.damages, self.calls = damages, 0

    def read(self, frames, camera_names):
        batch = super().read(frames, camera_names)
        value = self.damages.get(self.calls)
        self.calls += 1
        if value is not None:
            batch.images[1, 0, 2, 3] = value
        return batch


def test_a_bad_step_is_skipped_counted_and_told(make_trainer, reader):
    """The run goes on as if the step had not been: same parameters before and after it, and it names frames and cameras."""
    trainer = make_trainer("training.iterations=5", reader=DamagedReader(reader, {1: float("nan")}))
    states, records = [], []

    def after_step(iteration, terms):
        states.append(parameters(trainer))
        records.append(terms)
        return True

    assert trainer.run(after_step) and trainer.iteration == 5
    assert torch.equal(states[0], states[1]) and not torch.equal(states[1], states[2])
    assert records[1] == {} and records[0] and records[2], "a skipped step has no terms"
    (skipped,) = trainer.guard.tell()
    frames, cameras = trainer.sampler.draw(1)
    assert (skipped.iteration, skipped.cameras) == (1, cameras) and skipped.frames == [frame + 20 for frame in frames]
    assert "loss term image is not finite at iteration 1, frames [" in skipped.reason


def test_an_exploding_step_is_skipped_and_names_the_term(make_trainer, reader):
    trainer = make_trainer("training.iterations=24", "training.explosion_factor=3", reader=DamagedReader(reader, {22: 1e5}))
    run(trainer)
    (skipped,) = trainer.guard.tell()
    assert skipped.iteration == 22 and "times its running mean" in skipped.reason and "most of it from image" in skipped.reason


def make_fit(trainer, rig, folder):
    """A fit around a trainer, with an empty run folder."""
    capture = trainer.reader.capture
    run_folder = RunFolder.create(folder, trainer.settings, rig, capture.path, capture.face.shape[1])
    return Fit(trainer.settings, run_folder, trainer, trainer.reader.occlusion, Process())


def test_repeated_bad_steps_stop_the_run_and_its_log_names_every_batch(make_trainer, reader, rig, tmp_path):
    """Those before the last line of the log, those after it, and the one that was too many."""
    damages = dict.fromkeys((2, 11, 13, 14), float("nan"))
    trainer = make_trainer("training.iterations=19", "training.skipped_steps=3", reader=DamagedReader(reader, damages))
    with pytest.raises(
        DivergedError, match=r"got 4, 4 in all\. The last one: step\(\): loss term image is not finite at iteration 14, frames"
    ):
        make_fit(trainer, rig, tmp_path).train()
    first, last = read_log(tmp_path / "metrics.jsonl")
    assert (first["iteration"], first["skipped_in_all"], len(first["skipped"])) == (10, 1, 1)
    assert (last["iteration"], last["skipped_in_all"], len(last["skipped"])) == (15, 4, 3)
    assert "loss" in first and "loss" not in last
    for step, iteration in zip([*first["skipped"], *last["skipped"]], damages, strict=True):
        frames, cameras = trainer.sampler.draw(iteration)
        assert (step["iteration"], step["cameras"]) == (iteration, cameras) and step["frames"] == [frame + 20 for frame in frames]
        assert f"loss term image is not finite at iteration {iteration}, frames [" in step["reason"]


def test_a_line_of_the_log_never_repeats_older_terms(make_trainer, rig, tmp_path, monkeypatch):
    """Steps 9 and 10 of twelve are skipped: line 10 has no terms, and the end tells what no line has told."""
    trainer = make_trainer("loss.image=0", "loss.mask=0", "training.iterations=12")
    step = trainer.step

    def step_or_fail(batch):
        if trainer.iteration in (9, 10):
            raise DivergedError("no luck")
        return step(batch)

    monkeypatch.setattr(trainer, "step", step_or_fail)
    assert make_fit(trainer, rig, tmp_path).train()
    tenth, end = read_log(tmp_path / "metrics.jsonl")
    assert tenth["iteration"] == 10 and "learning_rate" in tenth and "loss" not in tenth and "geometry" not in tenth
    assert [skipped["iteration"] for skipped in tenth["skipped"]] == [9]
    assert end["iteration"] == 12 and [skipped["iteration"] for skipped in end["skipped"]] == [10] and end["skipped_in_all"] == 2


@pytest.mark.parametrize("overrides", [("loss.mutual_information=0.1",), ("loss.perturbation=0.5",)], ids=["information", "perturbation"])
def test_disentangling_terms_join_the_loss(make_trainer, overrides):
    """They are logged, weighted and learnt from; without a latent code they are left out."""
    name = overrides[0].split("=")[0].removeprefix("loss.")
    (record,) = run(make_trainer(*overrides, "training.iterations=1"))
    assert list(record) == [*TERMS, name]
    (record,) = run(make_trainer(*overrides, "training.iterations=1", "model.use_latent=false"))
    assert name not in record


def test_the_perturbation_term_keeps_random_codes_from_moving_the_keypoints(make_trainer):
    """Trained by it alone, the spread of the keypoints over prior samples shrinks to a fraction."""
    only = [f"loss.{name}=0" for name in TERMS[1:]]
    trainer = make_trainer(*only, "loss.perturbation=1", "training.iterations=60", "training.learning_rate=5e-3")
    with torch.no_grad():
        trainer.avatar.decoder.geometry.last[0].weight.normal_(std=0.3, generator=torch.Generator().manual_seed(0))
    records = run(trainer)
    first, last = (sum(record["perturbation"] for record in part) for part in (records[:5], records[-5:]))
    assert last < 0.2 * first


def test_information_is_observed_and_penalised(make_trainer):
    trainer = make_trainer("loss.mutual_information=0.1", "training.iterations=2")
    batch = trainer.reader.read(*trainer.sampler.draw(0))
    mu, logvar = torch.randn((2, 100, 16), generator=torch.Generator().manual_seed(0))
    trainer.information.observe(Posterior(mu, logvar), torch.randn((100, 8), generator=torch.Generator().manual_seed(1)))
    assert trainer.step(batch)["mutual_information"] >= 0
    assert trainer.information.seen == 102
    torch.testing.assert_close(trainer.information.driving[100:102], trainer.avatar.standardized_driving(batch.theta, batch.face))


def test_without_image_and_mask_nothing_is_read_nor_rendered_and_the_surface_learns_alone(make_trainer, reader, monkeypatch):
    rates = ("training.learning_rate=5e-3", "training.learning_rate_final=5e-3")
    trainer = make_trainer("loss.image=0", "loss.mask=0", *rates, "training.iterations=40", reader=MemoryReader(reader))
    monkeypatch.setattr(trainer.renderer, "render", None)
    monkeypatch.setattr(trainer.reader, "read", None)
    terms = run(trainer)
    assert set(terms[0]) == {"loss", "geometry", "laplacian", "kl"}
    assert terms[-1]["geometry"] < 0.7 * terms[0]["geometry"]


def test_learning_rate_falls_along_a_cosine(make_trainer):
    trainer = make_trainer("training.iterations=10", "training.learning_rate=4e-3", "training.learning_rate_final=1e-3")
    rates = [trainer.learning_rate(i) for i in range(11)]
    assert rates[0] == 4e-3 and rates[10] == pytest.approx(1e-3) and rates[5] == pytest.approx(2.5e-3)
    assert all(later < earlier for earlier, later in zip(rates, rates[1:], strict=False))
    assert trainer.learning_rate(99) == pytest.approx(1e-3)
    run(trainer, stop=4)
    assert trainer.optimizer.param_groups[0]["lr"] == rates[3]


def test_noise_follows_from_seed_and_iteration(make_trainer):
    def noise(iteration, *overrides, process=None, poses=4):
        trainer = make_trainer("training.poses_per_batch=4", *overrides, process=process)
        trainer.iteration = iteration
        return trainer.latent_noise(poses)

    assert torch.equal(noise(3), noise(3)) and noise(3).shape == (4, 16)
    assert not torch.equal(noise(3), noise(4)) and not torch.equal(noise(3), noise(3, "training.seed=1"))
    assert abs(float(noise(3).mean())) < 0.5 and 0.7 < float(noise(3).std()) < 1.3


def test_ranks_share_the_noise_of_a_single_process(make_trainer, monkeypatch):
    monkeypatch.setattr("mitsuba_avatar.training.loop._data_parallel", lambda avatar: avatar)
    whole = make_trainer("training.poses_per_batch=4").latent_noise(4)
    shares = [make_trainer("training.poses_per_batch=4", process=Process(rank, 2)).latent_noise(2) for rank in range(2)]
    assert torch.equal(torch.cat(shares), whole)


@pytest.mark.parametrize(
    "overrides",
    [(), ("loss.mutual_information=0.1", "loss.perturbation=0.1", "disentanglement.memory=64")],
    ids=["plain", "disentangled"],
)
def test_a_resumed_run_continues_the_same_curve(make_trainer, tmp_path, monkeypatch, overrides):
    """Six steps, against three steps, a checkpoint, another process' worth of objects, and three more."""
    # From the second step on the network learns, and the penalty counts whatever the estimate.
    monkeypatch.setattr("mitsuba_avatar.training.mutual_information.FEWEST_PAIRS", 4)
    monkeypatch.setattr("mitsuba_avatar.training.mutual_information.ESTIMATE_RATE", 0.0)
    overrides = ("training.iterations=6", "loss.geometry_iterations=4", *overrides)
    whole, first, second = (make_trainer(*overrides) for _ in range(3))
    for trainer in (whole, first):
        if trainer.information is not None:
            trainer.information.running = 0.5
    expected = run(whole)
    records = run(first, stop=3)
    checkpoints = Checkpoints(tmp_path, "rig")
    first.save(checkpoints, None)
    with torch.no_grad():
        for parameter in second.avatar.parameters():
            parameter.fill_(0.5)
    second.resume(checkpoints)
    assert second.iteration == 3
    records += run(second)
    assert second.guard.state_dict()["accepted"] == 6
    if second.information is not None:
        assert second.information.seen == 12 and records[-1]["mutual_information"] == 0.5
        weights = [trainer.information.network.latent_embedding.weight for trainer in (second, whole)]
        torch.testing.assert_close(*weights, rtol=0, atol=1e-3)
    for iteration, (got, wanted) in enumerate(zip(records, expected, strict=True)):
        assert got == pytest.approx(wanted, rel=1e-3, abs=1e-6), f"iteration {iteration}"
    # Scattered float sums come in another order each time, and Adam's first steps amplify that where gradients are nearly zero.
    assert (parameters(second) - parameters(whole)).abs().mean() < 2e-5
    assert (parameters(first) - parameters(whole)).abs().mean() > 2e-4, "the last three steps do count"


def test_seconds_count_training_alone_and_go_on_after_a_checkpoint(make_trainer, tmp_path):
    """The clock stands before, between and after sessions."""
    first, second = make_trainer("training.iterations=4"), make_trainer("training.iterations=4")
    assert first.seconds == 0.0
    within = []
    checkpoints = Checkpoints(tmp_path, "rig")

    def after_step(iteration, terms):
        within.append(first.seconds)
        if iteration == 2:
            first.save(checkpoints, None)
            within.append(first.seconds)
        return iteration < 3

    first.run(after_step)
    stopped_at = first.seconds
    assert 0 < within[0] < within[1] < within[3] < stopped_at == first.seconds
    second.resume(checkpoints)
    assert within[1] < second.seconds < within[2], "what came after the checkpoint will be done again"
    resumed_with = second.seconds
    run(second)
    assert second.seconds > resumed_with


def test_training_stops_where_it_is_asked_to(make_trainer):
    trainer = make_trainer("training.iterations=4")
    assert trainer.run(lambda iteration, terms: iteration < 2) is False and trainer.iteration == 2
    assert trainer.run(lambda iteration, terms: True) is True and trainer.iteration == 4
    assert trainer.run(lambda iteration, terms: pytest.fail("there is nothing left to do")) is True


def test_no_kernel_is_compiled_after_the_first_steps(make_trainer):
    """Batches differ in how many edges and rays they have; the kernels must not."""
    import drjit

    trainer = make_trainer("training.iterations=12")
    with drjit.scoped_set_flag(drjit.JitFlag.KernelHistory, True):
        trainer.run(lambda iteration, terms: iteration < 4)
        drjit.kernel_history_clear()
        trainer.run(lambda iteration, terms: True)
        kernels = drjit.kernel_history([drjit.KernelType.JIT])
    assert len(kernels) > 8, "one kernel a step at the very least, or the history was not kept"
    compiled = [kernel for kernel in kernels if not kernel["cache_hit"]]
    assert not compiled, f"{len(compiled)} of {len(kernels)} kernels were new"


@pytest.mark.slow
def test_memory_does_not_grow(make_trainer):
    """Resident memory after 200 steps within 3 % of after 50."""
    trainer = make_trainer("training.iterations=200")
    resident = {}

    def after_step(iteration, terms):
        if iteration in (50, 200):
            with open("/proc/self/statm") as statm:
                resident[iteration] = int(statm.read().split()[1])
        return True

    trainer.run(after_step)
    assert resident[200] < 1.03 * resident[50], f"{resident[200] / resident[50] - 1:.1%} more"


def test_step_timer_averages_over_steps_and_starts_over(monkeypatch):
    clock = iter([0.0, 1.0, 5.0, 8.0, 10.0, 10.5])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    timer = StepTimer()
    for name in ("render", "render", "data"):
        with timer.part(name):
            pass
    timer.steps = 2
    assert timer.means() == {"render": 2000.0, "data": 250.0} and timer.means() == {}


def read_log(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_log_of_a_resumed_run_drops_what_will_be_repeated(tmp_path):
    path = tmp_path / "run/metrics.jsonl"
    with MetricsLog(path) as log:
        for iteration in (10, 20, 30):
            log.write({"iteration": iteration, "loss": 1 / iteration})
        assert len(read_log(path)) == 3, "lines are on disk as soon as they are written"
    with path.open("a") as file:
        file.write('{"iteration": 40, "lo')
    with MetricsLog(path, resume_at=20) as log:
        log.write({"iteration": 30, "loss": 7.0})
    assert [(record["iteration"], record["loss"]) for record in read_log(path)] == [(10, 0.1), (20, 0.05), (30, 7.0)]
    MetricsLog(path).close()
    assert not read_log(path), "a new run begins a new log"
