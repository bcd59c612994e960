"""How far the rasterizers in float32 are from the reference in float64: `python tests/stability/compare_bodies.py`

Prints, for each hard case, the largest relative error (2-norm) over its scenes and the output that has it, of the `cpu`
body and, on a machine with CUDA, of gsplat. Cases within 1e-4 are counted only.
"""

from __future__ import annotations

import test_rasterizer_cases as cases
import torch

from ssa_nerfstudio.rasterization import RasterizerName

SMALL = 1e-4
"""Errors below this are float32's rounding (the tolerance of the comparison in docs/results.md)."""


def worst(case: cases.Case, body: RasterizerName) -> tuple[float, str]:
    """The largest error of a body in a case, and the output that has it; a failed check counts as infinite."""
    cases.SINGLE_PRECISION.clear()
    cases.BODY = body
    try:
        case.check()
    except AssertionError:
        return float("inf"), "not finite"
    errors = [(error, name) for scene in cases.SINGLE_PRECISION for name, error in scene.items()]
    return max(errors, default=(0.0, ""))


def main() -> None:
    """Print the table."""
    bodies: list[RasterizerName] = ["cpu", "gsplat"] if torch.cuda.is_available() else ["cpu"]
    print(f"| case | {' | '.join(f'{body}, float32' for body in bodies)} |")
    print("|---" * (1 + len(bodies)) + "|")
    small = 0
    for case in cases.RASTERIZER.cases:
        found = [worst(case, body) for body in bodies]
        if all(error <= SMALL for error, _ in found):
            small += 1
        else:
            print(f"| {case.name} | {' | '.join(f'{error:.1e} ({name})' for error, name in found)} |")
    print(f"\n{small} of {len(cases.RASTERIZER.cases)} cases are within {SMALL:.0e}.")


if __name__ == "__main__":
    main()
