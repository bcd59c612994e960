"""Functions whose gradients are taken by hand: autograd does not know of their values."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, ...]]
"""Of tensors. It draws no random numbers, reads nothing from the device and launches the same kernels at every call."""
Gradients = tuple[Sequence[Tensor | None], Sequence[Tensor | None]]
"""Of inputs and of parameters; None where there is none."""
Differentiate = Callable[[Sequence[Tensor | None]], Gradients]


class Evaluation:
    """Values of a function that autograd does not know of, and its gradient, which is taken by hand and once.

    A node of autograd costs the host a tenth of a millisecond, more than to launch a recording.
    """

    def __init__(self, values: list[Tensor], parameters: Sequence[Tensor], differentiate: Differentiate) -> None:
        """Make one.

        Args:
            values: without history.
            parameters: those that receive gradients.
            differentiate: of the slopes of the values; the gradients of the inputs and those of the parameters.
        """
        self.values = values
        self._parameters, self._differentiate = parameters, differentiate

    def backpropagate(self, slopes: Sequence[Tensor | None] = ()) -> Sequence[Tensor | None]:
        """Add the gradient to that of the parameters.

        Args:
            slopes: derivatives with respect to the values, None for those that nothing depends on; of a sum none.

        Returns:
            The gradients of the inputs.
        """
        of_inputs, of_parameters = self._differentiate(slopes)
        for parameter, gradient in zip(self._parameters, of_parameters):  # noqa: B905 - at every step
            if gradient is not None:
                parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient
        return of_inputs


def evaluate(function: Function, inputs: Sequence[Tensor], parameters: Sequence[Tensor], of_sum: bool) -> Evaluation:
    """Call a function without a recording; arguments as of `RecordedFunction`."""
    with torch.enable_grad():
        leaves = [each.detach().requires_grad_(each.requires_grad) for each in inputs]
        computed = function(*leaves, *parameters)

    def differentiate(slopes: Sequence[Tensor | None]) -> Gradients:
        given = [None] * len(computed) if of_sum else slopes
        wanted = [(v, s) for v, s in zip(computed, given, strict=True) if v.requires_grad and (of_sum or s is not None)]
        # Into the parameters' gradients at once, because autograd brings them into the parameters' layout.
        learned = [each for each in (*leaves, *parameters) if each.requires_grad]
        torch.autograd.backward([v for v, _ in wanted], [s for _, s in wanted], inputs=learned)
        return [each.grad for each in leaves], []

    values = [each.detach().requires_grad_(each.requires_grad and not of_sum) for each in computed]
    return Evaluation(values, parameters, differentiate)
