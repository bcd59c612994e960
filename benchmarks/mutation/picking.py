"""Which tests try a change, and in which order."""

from __future__ import annotations

import ast


def quickest_first(tests: list[str], seconds: dict[str, float], budget: float) -> tuple[list[str], float]:
    """Tests within a budget, those of the quickest file first; a file's stay together, as they share fixtures."""
    files: dict[str, list[str]] = {}
    for test in sorted(tests, key=lambda name: seconds[name]):
        files.setdefault(test.partition("::")[0], []).append(test)
    chosen, total = [], 0.0
    for test in (test for of in sorted(files.values(), key=lambda of: sum(map(seconds.get, of))) for test in of):
        if not chosen or total + seconds[test] <= budget:
            chosen.append(test)
            total += seconds[test]
    return chosen, total


def statement(function: list[str], place: int) -> list[int]:
    """Places of the smallest statement at a line of a function, of a compound one its head; else of all of the body."""
    (wrapper,) = ast.parse("\n".join(["if True:", *(f" {line}" for line in function)])).body
    (definition,) = [node for node in ast.walk(wrapper) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)][:1]
    found = range(definition.body[0].lineno, len(function) + 2)
    for node in ast.walk(definition):
        if isinstance(node, ast.stmt) and node is not definition:
            inner = getattr(node, "body", None) or getattr(node, "cases", None)
            first = min((below.lineno for below in inner if hasattr(below, "lineno")), default=0) if inner else 0
            last = first - 1 if first > node.lineno else node.end_lineno or node.lineno
            if node.lineno <= place + 2 <= last and last - node.lineno < len(found):
                found = range(node.lineno, last + 1)
    return [line - 2 for line in found]
