"""Functions in a form that mutmut changes: it leaves those with a decorator, and what an import calls, as they are."""

from __future__ import annotations

import ast

_AS_THEY_ARE = ("intrinsic", "overload", "triton.jit")
"""Decorators of functions that nothing can call as Python functions."""
_KERNEL = "__import__('benchmarks.mutation.kernels', fromlist=['Kernel']).Kernel"


def undecorated(source: str) -> str:
    """Apply decorators in a statement after each function, and let every call make what is made when a module is read.

    `@a @b def f(): ...` becomes `def f(): ...` and `f = a(b(f))`, which is what decorators mean. A kernel of numba's
    becomes a `kernels.Kernel`, because numba compiles no function that chooses a mutant. `f = make_f(...)` becomes a
    function that calls `make_f(...)(...)`: modules are read before a mutant is chosen.

    Args:
        source: of a module.
    """
    lines = source.splitlines()
    module = ast.parse(source)
    for node in module.body:
        match node:
            case ast.Assign([ast.Name(name)], ast.Call(ast.Name(maker))) if maker.startswith("make_"):
                assert node.lineno == node.end_lineno
                call = ast.unparse(node.value)
                lines[node.lineno - 1] = f"def {name}(*given, **named): return {call}(*given, **named)"
    for function in reversed([node for node in _functions(module) if node.decorator_list]):
        decorators = [ast.unparse(decorator) for decorator in function.decorator_list]
        names = [decorator.partition("(")[0] for decorator in decorators]
        if decorators in (["staticmethod"], ["classmethod"]) or any(name.endswith(_AS_THEY_ARE) for name in names):
            continue
        first = function.decorator_list[0].lineno - 1
        applied = function.name
        for decorator, name in zip(reversed(decorators), reversed(names), strict=True):
            applied = f"{_KERNEL}({applied}, {decorator})" if name == "njit" else f"{decorator}({applied})"
        assert function.end_lineno is not None
        lines.insert(function.end_lineno, f"{' ' * function.col_offset}{function.name} = {applied}")
        del lines[first : function.lineno - 1]
    return "\n".join(lines) + "\n"


def _functions(module: ast.Module) -> list[ast.FunctionDef]:
    """Functions of a module and methods of its classes, in order."""
    bodies = [module.body, *(node.body for node in module.body if isinstance(node, ast.ClassDef))]
    found = [node for body in bodies for node in body if isinstance(node, ast.FunctionDef)]
    return sorted(found, key=lambda node: node.lineno)
