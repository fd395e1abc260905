"""Nothing that shapes a world, an episode, a list or a recorded result has other last bits on another processor.

The C library, numpy and scipy choose their exponentials, powers and matrix products by processor. The package's calls
of them are listed here, each with the reason why it may stay; ``tests/golden/test_machines.py`` tries recorded results
on other processors.
"""

import ast
from pathlib import Path

from tests.test_imports import tree_of

PACKAGE = Path(__file__).resolve().parents[1] / "ethbrake_marl"

TRANSCENDENTAL = {
    *("exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "logaddexp", "pow", "power", "float_power", "cbrt"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "arcsin", "arccos", "arctan", "arctan2", "sinh", "cosh"),
    *("tanh", "asinh", "acosh", "atanh", "arcsinh", "arccosh", "arctanh", "hypot", "erf", "erfc", "gamma", "lgamma"),
    *("logspace", "geomspace", "sinc", "dist"),
}
BY_MACHINE = {  # sums whose order the linear algebra library chooses
    *("dot", "vdot", "inner", "outer", "matmul", "tensordot", "einsum", "linalg", "convolve", "correlate", "polyfit"),
    *("cov", "corrcoef", "trapezoid", "kron"),
}
DRAWN = {"standard_normal", "normal", "lognormal", "exponential", "gamma", "beta"}  # of numpy's generators

SQUARES = "squares of arrays, which numpy multiplies, or powers of whole numbers"
TRAINED = "training: torch's own sums differ by machine, too"
REMAINS = {
    ("evaluation/statistics.py", "**"): SQUARES,
    ("evaluation/statistics.py", "math.cbrt"): "ends of an interval for few recordings",
    ("evaluation/statistics.py", "scipy.special"): "quantiles for the ends of an interval; the last bit of the t"
    " quantile differs for 1 in 1,000 counts where the processor has no FMA. Means and errors are exact sums",
    ("training/recipe.py", "math.cos"): TRAINED,
}


def is_exact(base: ast.expr) -> bool:
    """Whether its powers are: of whole numbers and of two they are."""
    return isinstance(base, ast.Constant) and (isinstance(base.value, int) or base.value == 2.0)


def imported(module: str, names: list[ast.alias]) -> set[str]:
    if module.startswith("scipy"):
        return {module}
    chosen = {f"{module}.{each.name}" for each in names if each.name in TRANSCENDENTAL | BY_MACHINE}
    return chosen if module in {"math", "cmath", "numpy"} else set()


def called(node: ast.AST) -> set[str]:
    """What a piece of code calls whose last bits a processor, or a library for it, chooses."""
    match node:
        case ast.Attribute(value=ast.Name(id="np" | "math" | "numpy" as module), attr=name):
            return {f"{module}.{name}"} & {f"{module}.{each}" for each in TRANSCENDENTAL | BY_MACHINE}
        case ast.Attribute(value=ast.Name(id="rng" | "random" as generator), attr=name) if name in DRAWN:
            return {f"{generator}.{name}"}
        case ast.ImportFrom(module=str(module), names=names):
            return imported(module, names)
        case ast.Import(names=names):
            return {each.name for each in names if each.name.split(".")[0] in {"scipy", "cmath"}}
        case ast.BinOp(op=ast.MatMult()):
            return {"@"}
        case ast.BinOp(op=ast.Pow(), left=base):
            return set() if is_exact(base) else {"**"}
    return set()


def calls_in(folder: Path) -> set[tuple[str, str]]:
    """(file, what it calls) below a folder, but those of extensions."""
    found = set()
    for path in sorted(folder.rglob("*.py")):
        if folder != PACKAGE or PACKAGE / "extensions" not in path.parents:
            for node in ast.walk(tree_of(path)):
                found |= {(path.relative_to(folder).as_posix(), name) for name in called(node)}
    return found


def test_the_package__calls_nothing_that_differs_by_processor_but_what_is_listed() -> None:
    assert calls_in(PACKAGE) == set(REMAINS)
