"""Recorded functions against plain ones: on a CPU with programs that are run again, on CUDA with graphs."""

from __future__ import annotations

import pytest
import torch
from recordings import CUDA, recorder, run_again
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, RecordedCalls, RecordedFunction


class Mixture:
    """Two values with gradients, one without, of inputs with and without, of two types, and of two parameters."""

    def __init__(self, device: str) -> None:
        generator = torch.Generator().manual_seed(0)
        self.device, self.generator = device, generator
        self.weights = torch.nn.Parameter(self.numbers(3))
        self.unused = torch.nn.Parameter(self.numbers(3))

    def numbers(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator).to(self.device)

    def inputs(self) -> list[Tensor]:
        picture = (255 * self.numbers(5, 3)).to(torch.uint8)
        return [(2 * self.numbers(5, 3)).requires_grad_(), self.numbers(3), picture]

    def __call__(self, x: Tensor, offset: Tensor, picture: Tensor, *parameters: Tensor) -> tuple[Tensor, ...]:
        shown = x * (parameters or [self.weights])[0].exp() + offset
        error = shown - picture / 255.0
        return error.square().mean(), (error > 0).sum(), shown.sum(dim=1)


def outcome(function, mixture: Mixture, inputs: list[Tensor], slope: float) -> list[Tensor | None]:
    mixture.weights.grad = inputs[0].grad = None
    value, count, sums = function(*inputs)
    (slope * value + sums[1] * sums[2]).backward()
    assert not count.requires_grad
    return [v if v is None else v.detach().clone() for v in (value, count, sums, inputs[0].grad, mixture.weights.grad)]


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_recorded_function_has_the_values_and_gradients_of_the_plain_one(device):
    mixture = Mixture(device)
    parameters = [mixture.weights, mixture.unused]
    recorded = RecordedFunction(mixture, mixture.inputs(), parameters, recorder(device)())
    for step in range(3):
        with torch.no_grad():
            mixture.weights.add_(0.1)  # as an optimizer does, in place
        inputs = mixture.inputs()
        for slope in (1.0, 2.0 + step):
            torch.testing.assert_close(
                outcome(lambda *given: recorded(*given, *parameters), mixture, inputs, slope),
                outcome(mixture, mixture, inputs, slope),
            )
    assert mixture.unused.grad is None


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_a_value_that_nothing_depends_on_has_no_slope(device):
    mixture = Mixture(device)
    inputs = mixture.inputs()
    recorded = RecordedFunction(mixture, inputs, [mixture.weights], recorder(device)())
    for _ in range(2):  # the second follows a call whose sums had a slope
        outcome(lambda *given: recorded(*given, mixture.weights), mixture, inputs, 1.0)
        mixture.weights.grad = None
        recorded(*inputs, mixture.weights)[0].backward()
        assert mixture.weights.grad is not None
        found, mixture.weights.grad = mixture.weights.grad.clone(), None
        mixture(*inputs)[0].backward()
        torch.testing.assert_close(found, mixture.weights.grad)


def test_a_gradient_after_another_call_is_refused():
    mixture = Mixture("cpu")
    inputs = mixture.inputs()
    recorded = RecordedFunction(mixture, inputs, [mixture.weights], run_again())
    first = recorded(*inputs, mixture.weights)[0]
    recorded(*inputs, mixture.weights)
    with pytest.raises(RuntimeError, match="called again"):
        first.backward()


class Counted:
    """Counts the recordings that are made."""

    def __init__(self, make) -> None:
        self.make, self.programs = make, 0

    def __call__(self):
        record = self.make()

        def counting(program):
            self.programs += 1
            return record(program)

        return counting


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_every_kind_is_recorded_at_its_second_call_and_anew_in_another_epoch(device):
    mixture, made = Mixture(device), Counted(recorder(device))
    calls = RecordedCalls(made, limit=2)
    inputs, parameters = mixture.inputs(), [mixture.weights]
    expected = outcome(mixture, mixture, inputs, 3.0)

    def call(kind: str, epoch: int) -> int:
        before = made.programs
        found = outcome(lambda *given: calls(mixture, given, parameters, kind, epoch), mixture, inputs, 3.0)
        torch.testing.assert_close(found, expected)
        return made.programs - before

    assert [call("a", 0) for _ in range(3)] == [0, 2, 0]  # values and gradients are a program each
    assert [call("b", 0) for _ in range(3)] == [0, 2, 0]
    assert [call("c", 0) for _ in range(3)] == [0, 0, 0]  # beyond the limit
    assert [call("a", 1) for _ in range(3)] == [0, 2, 0]
    mixture.weights.data = mixture.weights.data.clone()  # as a refinement does
    assert [call("a", 1) for _ in range(3)] == [0, 2, 0]


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_gradients_reach_a_parameter_that_took_anothers_place_in_memory(device):
    """As gsplat's relocation does: new parameters around the same numbers."""
    mixture = Mixture(device)
    calls = RecordedCalls(recorder(device))
    inputs = mixture.inputs()
    for _ in range(3):
        found = outcome(lambda *given: calls(mixture, given, [mixture.weights], "kind"), mixture, inputs, 1.0)
        former, mixture.weights = mixture.weights, torch.nn.Parameter(mixture.weights.data)
        assert former.data_ptr() == mixture.weights.data_ptr()
    assert found[-1] is not None
    torch.testing.assert_close(found, outcome(mixture, mixture, inputs, 1.0))


def test_gradients_accumulate_as_without_recordings():
    mixture = Mixture("cpu")
    calls = RecordedCalls(run_again)
    inputs = mixture.inputs()
    for _ in range(3):  # the third is a recording
        mixture.weights.grad = None
        calls(mixture, inputs, [mixture.weights], "kind")[0].backward()
    assert mixture.weights.grad is not None
    once = mixture.weights.grad.clone()
    calls(mixture, inputs, [mixture.weights], "kind")[0].backward()
    torch.testing.assert_close(mixture.weights.grad, 2 * once)


def test_where_nothing_can_be_recorded_calls_are_plain_and_say_so_once(caplog):
    def refuse():
        raise RuntimeError("operation not permitted\nand many lines more")

    mixture, calls = Mixture("cpu"), RecordedCalls(refuse)
    inputs = mixture.inputs()
    for _ in range(4):
        found = outcome(lambda *given: calls(mixture, given, [mixture.weights], "kind"), mixture, inputs, 1.0)
        torch.testing.assert_close(found, outcome(mixture, mixture, inputs, 1.0))
    assert caplog.text.count("CUDA graphs cannot be used") == 1
    assert "many lines" not in caplog.text


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_captures_share_the_memory_that_a_library_holds_for_their_stream():
    matrix = torch.rand(64, 64, device="cuda")
    held = []
    for _ in range(8):
        record = CapturedPrograms()
        (product,), _ = record(lambda: [matrix @ matrix])
        del product, record
        held.append(torch.cuda.memory_allocated())
    assert held[-1] == held[1]  # cuBLAS takes 32 MiB once
