"""Functions of fixed shapes as CUDA graphs: one launch for their values, one for their gradients, or one for both.

A training step of splats waits for its host, which launches some hundred kernels one by one. With SSA_CUDA_GRAPHS=0 it
still does so; the kernels are the same.
"""

from __future__ import annotations

import gc
import logging
import os
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache

import torch
from torch import Tensor

from ssa_nerfstudio._system.gradients_by_hand import Evaluation, Function, Gradients, evaluate

Program = Callable[[], list[Tensor]]
Record = Callable[[Program], tuple[list[Tensor], Callable[[], object]]]
"""Records a program: where its results are going to be, and what computes them there, any number of times."""
_LOG = logging.getLogger(__name__)


def graphs_are_usable() -> bool:
    """Whether there is CUDA, and SSA_CUDA_GRAPHS is not 0."""
    return os.environ.get("SSA_CUDA_GRAPHS") != "0" and has_cuda()


@cache
def has_cuda() -> bool:
    """Whether this process can use CUDA, asked of the driver once."""
    return torch.cuda.is_available()


class CapturedPrograms:
    """A `Record` that captures CUDA graphs, all in one pool of memory.

    Programs that are captured later may use memory that earlier ones only need while they run.
    """

    def __init__(self) -> None:
        self._pool = torch.cuda.graph_pool_handle()
        self._stream = _capture_stream(torch.cuda.current_device())

    def __call__(self, program: Program) -> tuple[list[Tensor], Callable[[], object]]:
        """Run a program once, which loads its kernels and libraries, and capture it."""
        with self._aside():
            program()
        return self.capture(program)

    def capture(self, program: Program) -> tuple[list[Tensor], Callable[[], object]]:
        """Capture a program without running it; it must have run before."""
        graph = torch.cuda.CUDAGraph()
        with self._aside():
            # Not torch.cuda.graph, which also collects garbage and empties the cache, a tenth of a second each time.
            # Other threads (the viewer's) may use CUDA meanwhile.
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                results = program()
            finally:
                graph.capture_end()
        return results, graph.replay

    @contextmanager
    def _aside(self) -> Iterator[None]:
        """On a stream beside the current one, without Python freeing what a capture must not."""
        current, collecting = torch.cuda.current_stream(), gc.isenabled()
        self._stream.wait_stream(current)
        gc.disable()
        try:
            with torch.cuda.stream(self._stream):
                yield
        finally:
            current.wait_stream(self._stream)
            if collecting:
                gc.enable()


@cache
def _capture_stream(device: int) -> torch.cuda.Stream:
    """One for all captures: libraries hold memory for each stream on which they are used, cuBLAS 32 MiB."""
    return torch.cuda.Stream(device)


class RecordedFunction:
    """A function that was recorded once and is repeated in place.

    Inputs are copied to where they were when it was recorded; parameters are read where they are. Values and gradients
    are valid until the next call, which puts its own in their place.
    """

    def __init__(
        self, function: Function, inputs: Sequence[Tensor], parameters: Sequence[Tensor], record: Record, of_sum: bool
    ) -> None:
        """Record a function.

        Args:
            function: of the inputs and the parameters.
            inputs: with the shapes, types and needs of a gradient of all later calls.
            parameters: their memory must not move; the objects may be replaced.
            record: `CapturedPrograms`, or what repeats programs on a CPU in a test.
            of_sum: the gradient that is wanted is that of the sum of all values that have one, scalars. It is computed
                with the values, in one launch.
        """
        self._calls = 0
        self._inputs = [each.detach().clone().requires_grad_(each.requires_grad) for each in inputs]
        # Under other names, because autograd would wait for the stream on which a parameter was used before.
        aliases = [each.detach().requires_grad_(each.requires_grad) for each in parameters]
        arguments = [*self._inputs, *aliases]
        leaves = [each for each in arguments if each.requires_grad]
        self._one = torch.ones((), device=arguments[0].device)  # kept, because the recording reads it
        computed: list[Tensor] = []
        used: list[bool] = []

        def compute() -> list[Tensor]:
            with torch.enable_grad():
                computed[:] = function(*arguments)
            return [each.detach() for each in computed]

        def differentiate(again: bool = True) -> list[Tensor]:
            values = [each for each in computed if each.requires_grad]
            slopes = [self._one] * len(values) if of_sum else self._slopes
            # The graph is kept where a record runs this program more than once.
            found = torch.autograd.grad(values, leaves, slopes, retain_graph=again, allow_unused=True)
            used[:] = [each is not None for each in found]
            return [each.contiguous() for each in found if each is not None]

        if of_sum:
            found, self._recompute = record(lambda: [*compute(), *differentiate(again=False)])
            self._values, gradients = found[: len(computed)], found[len(computed) :]
        else:
            self._values, self._recompute = record(compute)
            self._recompute()
            self._slopes = [torch.zeros_like(each) for each in computed if each.requires_grad]
            gradients, self._rederive = record(differentiate)
        self._of_sum = of_sum
        self._smooth = [each.requires_grad and not of_sum for each in computed]
        each_found = iter(gradients)
        of_leaves = iter([next(each_found) if each else None for each in used])
        found_of = [next(of_leaves) if each.requires_grad else None for each in arguments]
        self._gradients = found_of[: len(inputs)], found_of[len(inputs) :]
        computed.clear()

    def __call__(self, inputs: Sequence[Tensor], parameters: Sequence[Tensor]) -> Evaluation:
        """Evaluate the function.

        Parameters may be other objects than those that were recorded: gsplat's relocation puts new ones around the same
        memory.
        """
        _copy(self._inputs, inputs)
        self._recompute()
        self._calls += 1
        call = self._calls
        values = [each.detach().requires_grad_(smooth) for each, smooth in zip(self._values, self._smooth)]  # noqa: B905

        def differentiate(slopes: Sequence[Tensor | None]) -> Gradients:
            if call != self._calls:
                raise RuntimeError(
                    "a recorded function was called again before the gradient of its last call was taken"
                )
            return self._gradients if self._of_sum else self._differentiated(slopes)

        return Evaluation(values, parameters, differentiate)

    def _differentiated(self, slopes: Sequence[Tensor | None]) -> Gradients:
        wanted = [each for each, smooth in zip(slopes, self._smooth, strict=True) if smooth]
        for mine, given in zip(self._slopes, wanted):  # noqa: B905
            if given is None:
                mine.zero_()
        pairs = [(mine, given) for mine, given in zip(self._slopes, wanted) if given is not None]  # noqa: B905
        _copy([mine for mine, _ in pairs], [given for _, given in pairs])
        self._rederive()
        return self._gradients


class RecordedCalls:
    """Evaluates functions plainly at first, and from the second call of a kind on as a recording."""

    def __init__(self, record: Callable[[], Record], of_sum: bool = False, limit: int = 8) -> None:
        """Record nothing yet.

        Args:
            record: makes what records, once for each epoch.
            of_sum: as of `RecordedFunction`.
            limit: number of recordings that are kept; what comes after them is called plainly.
        """
        self._make_record, self._of_sum, self._limit = record, of_sum, limit
        self._record: Record | None = None
        self._epoch: Hashable = None
        self._known: dict[Hashable, RecordedFunction | None] = {}
        self._failed = False

    def __call__(
        self,
        function: Function,
        inputs: Sequence[Tensor],
        parameters: Sequence[Tensor],
        kind: Hashable,
        epoch: Hashable = None,
    ) -> Evaluation:
        """Evaluate a function.

        Args:
            function, inputs, parameters: as of `RecordedFunction`.
            kind: all that a recording depends on beside the inputs' values.
            epoch: recordings of another one, or of parameters that have moved, are dropped.
        """
        # A gradient that accumulates may be a recording's own, which its next call writes over.
        if self._failed or torch.is_autocast_enabled() or any(each.grad is not None for each in parameters):
            return evaluate(function, inputs, parameters, self._of_sum)
        epoch = epoch, *[(each.data_ptr(), each.shape) for each in parameters]
        if epoch != self._epoch:
            self.forget()
            self._epoch = epoch
        kind = kind, *[(each.shape, each.dtype) for each in inputs]
        recorded = self._known.get(kind)
        if recorded is None:
            if kind not in self._known:
                if len(self._known) < self._limit:
                    self._known[kind] = None
                return evaluate(function, inputs, parameters, self._of_sum)
            try:
                self._record = self._record or self._make_record()
                recorded = RecordedFunction(function, inputs, parameters, self._record, self._of_sum)
                self._known[kind] = recorded
            except RuntimeError as error:
                self._failed, self._known = True, {}
                warn_of_plain_launches(error)
                return evaluate(function, inputs, parameters, self._of_sum)
        return recorded(inputs, parameters)

    def forget(self) -> None:
        """Drop all recordings, and with them their memory and that of the parameters that they were made of."""
        self._known, self._record, self._epoch = {}, None, None


def warn_of_plain_launches(error: RuntimeError) -> None:
    """Say that nothing can be captured, and why."""
    _LOG.warning(f"CUDA graphs cannot be used, steps take longer: {str(error).splitlines()[0]}")


def _copy(targets: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copy tensors with one launch for each of their types."""
    by_type: dict[torch.dtype, tuple[list[Tensor], list[Tensor]]] = {}
    for target, source in zip(targets, sources, strict=False):
        if target.data_ptr() != source.data_ptr():
            pair = by_type.setdefault(target.dtype, ([], []))
            pair[0].append(target)
            pair[1].append(source)
    with torch.no_grad():
        for pair in by_type.values():
            if len(pair[0]) == 1:  # a list takes the host twice as long
                pair[0][0].copy_(pair[1][0])
            else:
                torch._foreach_copy_(*pair)  # pyright: ignore[reportPrivateImportUsage]
