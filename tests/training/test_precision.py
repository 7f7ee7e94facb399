"""Training in bfloat16: where it is allowed, and that what must be exact stays exact."""

import dataclasses

import pytest
import torch

from mitsuba_avatar.settings import TrainingSettings
from mitsuba_avatar.training import precision
from mitsuba_avatar.training.precision import is_mixed

CPU = torch.device("cpu")


@pytest.mark.parametrize("has_instructions", [False, True])
def test_mixed_precision_needs_a_device_that_has_it(has_instructions: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(precision, "multiplies_bfloat16", lambda device: has_instructions)
    assert not is_mixed(TrainingSettings(), CPU)
    assert is_mixed(TrainingSettings(precision="auto"), CPU) == has_instructions
    if has_instructions:
        assert is_mixed(TrainingSettings(precision="mixed"), CPU)
    else:
        with pytest.raises(ValueError, match=r'multiplies bfloat16 in hardware for "mixed"; cpu does not.*Use "auto" or "float32"'):
            is_mixed(TrainingSettings(precision="mixed"), CPU)


def test_an_unknown_precision_is_refused():
    with pytest.raises(ValueError, match="expected precision to be one of float32, mixed, auto; got 'half'"):
        dataclasses.replace(TrainingSettings(), precision="half")


@pytest.mark.parametrize(
    ("capabilities", "expected"), [({"amx_bf16": True}, True), ({"amx_bf16": False, "avx512_bf16": True}, False), ({}, False)]
)
def test_a_cpu_needs_amx(capabilities: dict[str, bool], expected: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    assert precision.multiplies_bfloat16(CPU) == expected
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert not precision.multiplies_bfloat16(CPU), "a torch that cannot tell stays in float32"
