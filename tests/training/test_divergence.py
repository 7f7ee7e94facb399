"""The guard: what it calls an explosion, how many bad steps it forgives, what it remembers."""

import pytest

from mitsuba_avatar.settings import TrainingSettings
from mitsuba_avatar.training.divergence import WINDOW, DivergedError, DivergenceGuard, SkippedStep


def bad_step(iteration: int) -> SkippedStep:
    return SkippedStep(iteration, [7, 9], [["a"], ["b"]], f"step(): loss term image is not finite at iteration {iteration}.")


def make_guard(**changes: float) -> DivergenceGuard:
    return DivergenceGuard(TrainingSettings(**changes))


def test_an_explosion_is_measured_by_the_steps_before_it():
    guard = make_guard(explosion_factor=4.0)
    assert not guard.is_explosion(1e9), "nothing is known yet"
    for _ in range(20):
        guard.accept(0.5)
    assert guard.mean_loss == pytest.approx(0.5)
    assert guard.is_explosion(2.01) and not guard.is_explosion(1.99)
    for _ in range(200):
        guard.accept(0.05)
    assert guard.is_explosion(0.21), "the mean follows the loss down"


def test_single_bad_steps_are_forgiven_for_ever():
    guard = make_guard(skipped_steps=2)
    for number in range(12):
        guard.skip(bad_step(number * (WINDOW // 2)))
    assert guard.num_skipped == 12


def test_one_bad_step_too_many_stops_the_run_and_names_the_last():
    guard = make_guard(skipped_steps=2)
    guard.skip(bad_step(3))
    guard.skip(bad_step(30))
    guard.skip(bad_step(31))
    message = r"at most 2 bad steps within 20 iterations \(training\.skipped_steps\); got 3, 4 in all\. The last one: .* at iteration 40"
    with pytest.raises(DivergedError, match=message):
        guard.skip(bad_step(40))


def test_skipped_steps_are_told_once():
    guard = make_guard()
    guard.skip(bad_step(3))
    assert guard.tell() == [bad_step(3)] and guard.tell() == []


def test_a_restored_guard_forgives_as_much_as_the_old_one():
    guard = make_guard(skipped_steps=1)
    guard.accept(0.5)
    guard.skip(bad_step(3))
    restored = make_guard(skipped_steps=1)
    restored.load_state_dict(guard.state_dict())
    assert restored.state_dict() == guard.state_dict()
    with pytest.raises(DivergedError):
        restored.skip(bad_step(4))
