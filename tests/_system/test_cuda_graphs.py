"""Recorded functions against plain ones: on a CPU with programs that are run again, on CUDA with graphs."""

from __future__ import annotations

import pytest
import torch
from recordings import CUDA, recorder, run_again
from torch import Tensor

from ssa_nerfstudio._system.cuda_graphs import CapturedPrograms, RecordedCalls, RecordedFunction
from ssa_nerfstudio._system.gradients_by_hand import Evaluation, evaluate


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


def outcome(mixture: Mixture, inputs: list[Tensor], slope: float) -> list[Tensor | None]:
    """Values and gradients by autograd."""
    mixture.weights.grad = inputs[0].grad = None
    value, count, sums = mixture(*inputs)
    (slope * value + sums[1] * sums[2]).backward()
    return copies([value, count, sums, inputs[0].grad, mixture.weights.grad])


def found(evaluation: Evaluation, mixture: Mixture, slope: float) -> list[Tensor | None]:
    """The same of an evaluation."""
    value, count, sums = leaves = evaluation.values
    assert [each.requires_grad for each in leaves] == [True, False, True]
    (slope * value + sums[1] * sums[2]).backward()
    of_inputs = evaluation.backpropagate([each.grad for each in leaves])
    assert of_inputs[1] is None
    assert of_inputs[2] is None
    return copies([value, count, sums, of_inputs[0], mixture.weights.grad])


def copies(values: list[Tensor | None]) -> list[Tensor | None]:
    return [each if each is None else each.detach().clone() for each in values]


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("plain", [False, True])
def test_an_evaluation_has_the_values_and_gradients_of_autograd(device, plain):
    mixture = Mixture(device)
    parameters = [mixture.weights, mixture.unused]
    recorded = RecordedFunction(mixture, mixture.inputs(), parameters, recorder(device)(), of_sum=False)
    for step in range(3):
        with torch.no_grad():
            mixture.weights.add_(0.1)  # as an optimizer does, in place
        inputs = mixture.inputs()
        for slope in (1.0, 2.0 + step):
            expected = outcome(mixture, inputs, slope)
            mixture.weights.grad = None
            evaluation = evaluate(mixture, inputs, parameters, False) if plain else recorded(inputs, parameters)
            torch.testing.assert_close(found(evaluation, mixture, slope), expected)
    assert mixture.unused.grad is None


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("plain", [False, True])
def test_the_gradient_of_a_sum_comes_with_its_values(device, plain):
    mixture = Mixture(device)
    parameters = [mixture.weights, mixture.unused]

    def terms(*given: Tensor) -> tuple[Tensor, ...]:
        value, count, sums = mixture(*given)
        return value, sums.square().mean(), count, sums.detach()

    recorded = RecordedFunction(terms, mixture.inputs(), parameters, recorder(device)(), of_sum=True)
    for _ in range(3):
        inputs = mixture.inputs()
        value, other, *rest = terms(*inputs)
        mixture.weights.grad = None
        (value + other).backward()
        expected = copies([value, other, *rest, inputs[0].grad, mixture.weights.grad])
        mixture.weights.grad = None
        evaluation = evaluate(terms, inputs, parameters, True) if plain else recorded(inputs, parameters)
        assert not any(each.requires_grad for each in evaluation.values)
        of_inputs = evaluation.backpropagate()
        torch.testing.assert_close(copies([*evaluation.values, of_inputs[0], mixture.weights.grad]), expected)
    assert mixture.unused.grad is None


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("plain", [False, True])
def test_a_value_that_nothing_depends_on_has_no_slope(device, plain):
    mixture = Mixture(device)
    inputs, parameters = mixture.inputs(), [mixture.weights]
    recorded = RecordedFunction(mixture, inputs, parameters, recorder(device)(), of_sum=False)

    def call() -> Evaluation:
        return evaluate(mixture, inputs, parameters, False) if plain else recorded(inputs, parameters)

    for _ in range(2):  # the second follows a call whose sums had a slope
        found(call(), mixture, 1.0)
        mixture.weights.grad = None
        call().backpropagate([torch.ones((), device=device), None, None])
        assert mixture.weights.grad is not None
        gradient, mixture.weights.grad = mixture.weights.grad.clone(), None
        mixture(*inputs)[0].backward()
        torch.testing.assert_close(gradient, mixture.weights.grad)
        mixture.weights.grad = None


def test_a_gradient_after_another_call_is_refused():
    mixture = Mixture("cpu")
    inputs, parameters = mixture.inputs(), [mixture.weights]
    recorded = RecordedFunction(mixture, inputs, parameters, run_again(), of_sum=False)
    first = recorded(inputs, parameters)
    recorded(inputs, parameters)
    with pytest.raises(RuntimeError, match="called again"):
        first.backpropagate([torch.ones(()), None, None])


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
    expected = outcome(mixture, inputs, 3.0)

    def call(kind: str, epoch: int) -> int:
        before, mixture.weights.grad = made.programs, None
        torch.testing.assert_close(found(calls(mixture, inputs, parameters, kind, epoch), mixture, 3.0), expected)
        return made.programs - before

    assert [call("a", 0) for _ in range(3)] == [0, 2, 0]  # values and gradients are a program each
    assert [call("b", 0) for _ in range(3)] == [0, 2, 0]
    assert [call("c", 0) for _ in range(3)] == [0, 0, 0]  # beyond the limit
    assert [call("a", 1) for _ in range(3)] == [0, 2, 0]
    mixture.weights.data = mixture.weights.data.clone()  # as a refinement does
    assert [call("a", 1) for _ in range(3)] == [0, 2, 0]


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_inputs_of_another_type_or_shape_are_no_inputs_of_a_recording(device):
    mixture = Mixture(device)
    calls, parameters = RecordedCalls(recorder(device)), [mixture.weights]
    for _ in range(3):
        x, offset, picture = mixture.inputs()
        for inputs in (
            [x, offset, picture],
            [x, offset, picture + 0.5],  # which a recording with integers would round
            [x, offset.expand(5, 3).contiguous(), picture],
        ):
            expected = outcome(mixture, inputs, 1.0)
            mixture.weights.grad = None
            torch.testing.assert_close(found(calls(mixture, inputs, parameters, "kind"), mixture, 1.0), expected)
    assert [each is not None for each in calls._known.values()] == [True] * 3


def test_nothing_is_recorded_under_autocast(monkeypatch):
    """A recording would go on in the types of the step that made it."""
    mixture, made = Mixture("cpu"), Counted(run_again)
    calls, inputs = RecordedCalls(made), mixture.inputs()
    for autocast in (True, False):
        monkeypatch.setattr(torch, "is_autocast_enabled", lambda autocast=autocast: autocast)
        for _ in range(3):
            mixture.weights.grad = None
            calls(mixture, inputs, [mixture.weights], "kind")
        assert made.programs == (0 if autocast else 2)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_gradients_reach_a_parameter_that_took_anothers_place_in_memory(device):
    """As gsplat's relocation does: new parameters around the same numbers."""
    mixture = Mixture(device)
    calls = RecordedCalls(recorder(device))
    inputs = mixture.inputs()
    for _ in range(3):
        values = found(calls(mixture, inputs, [mixture.weights], "kind"), mixture, 1.0)
        former, mixture.weights = mixture.weights, torch.nn.Parameter(mixture.weights.data)
        assert former.data_ptr() == mixture.weights.data_ptr()
    assert values[-1] is not None
    torch.testing.assert_close(values, outcome(mixture, inputs, 1.0))


@pytest.mark.parametrize("through_calls", [True, False])
def test_gradients_accumulate_as_without_recordings(through_calls):
    """A recording would write over the gradient of its last call."""
    mixture = Mixture("cpu")
    parameters, slopes = [mixture.weights], [torch.ones(()), None, None]
    calls = RecordedCalls(run_again)
    other = RecordedFunction(mixture, mixture.inputs(), parameters, run_again(), of_sum=False)

    def gradient(inputs: list[Tensor], accumulate: bool, plain: bool) -> Tensor:
        if not accumulate:
            mixture.weights.grad = None
        if plain:
            evaluation = evaluate(mixture, inputs, parameters, False)
        else:
            evaluation = calls(mixture, inputs, parameters, "kind")
        evaluation.backpropagate(slopes)
        assert mixture.weights.grad is not None
        return mixture.weights.grad.clone()

    views = [mixture.inputs() for _ in range(4)]
    expected = sum(gradient(inputs, accumulate=False, plain=True) for inputs in views[2:])
    for inputs in views[:3]:  # the third is a recording
        gradient(inputs, accumulate=False, plain=False)
    if through_calls:
        found = gradient(views[3], accumulate=True, plain=False)
    else:  # of two recordings, whose gradients are in two places
        other(views[3], parameters).backpropagate(slopes)
        found = mixture.weights.grad
    torch.testing.assert_close(found, expected)


def test_where_nothing_can_be_recorded_calls_are_plain_and_say_so_once(caplog):
    def refuse():
        raise RuntimeError("operation not permitted\nand many lines more")

    mixture, calls = Mixture("cpu"), RecordedCalls(refuse)
    inputs = mixture.inputs()
    expected = outcome(mixture, inputs, 1.0)
    for _ in range(4):
        mixture.weights.grad = None
        torch.testing.assert_close(found(calls(mixture, inputs, [mixture.weights], "kind"), mixture, 1.0), expected)
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
