"""Mutation testing of ``ethbrake_marl/physics`` and ``harm.py``: small changes to the code that some test must notice.

``make mutation`` (or ``python -m tests.physics.programme.mutation [--sample K] [--seed S] [--jobs J] [--only FILE]``).

Every mutant changes one node of the syntax tree: an arithmetic or comparison operator, a constant, a condition negated,
a statement removed, min and max swapped, a sign. It is written into a temporary copy of the repository, never into the
working tree. A process forked from one that has numpy, numba and pytest loaded then runs a quick suite there with
compilation switched off (a mutant dies in about a second). A mutant that lives through it meets a second suite,
compiled. A mutant is killed by a failed test, by an exception, or by running out of time. ``tolerances.py`` is not
mutated: it is the yardstick.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
PHYSICS = "ethbrake_marl/physics"
NOT_MUTATED = {"__init__.py", "tolerances.py"}
PATIENCE = 1.5  # times the processor time of the quick suite without a mutant, and
SHORTEST_LIMIT_S = 5.0
COMPILED_LIMIT_S = 600
SECONDS_PER_MUTANT = 2.2  # one process, for the estimate

KERNEL = (
    "tests/physics/test_advance.py", "tests/physics/test_ties.py", "tests/physics/test_forecast.py",
    "tests/physics/test_packed.py", "tests/physics/test_manufactured.py", "tests/physics/test_clusters.py",
    "tests/physics/test_against_exact.py",
)  # fmt: skip
QUICK = {
    "worlds.py": ("tests/physics/test_worlds.py", "tests/physics/test_advance.py"),
    "compiled.py": ("tests/physics/test_compiled.py",),
    "packed.py": ("tests/physics/test_packed.py", "tests/test_engine.py"),
    "sampled.py": ("tests/physics/test_sampled.py",),
    "forecast.py": ("tests/physics/test_forecast.py",),
    "harm.py": ("tests/test_harm.py", "tests/physics/test_ledger.py"),
}
COMPILED = ("tests/physics", "tests/golden/test_physics_hash.py", "tests/test_harm.py")
PYTEST = ("-x", "-q", "-p", "no:cacheprovider", "--rootdir=.")
SLOW = ("tests/physics/test_against_reference.py",)


@dataclass(frozen=True)
class Mutant:
    """One changed node of one file."""

    file: str
    line: int
    change: str
    source: str

    @property
    def name(self) -> str:
        """Where and what."""
        return f"{self.file}:{self.line}: {self.change}"


# ---------------------------------------------------------------- making mutants

ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Pow: ast.Mult,
}  # fmt: skip
BOUNDARY: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
SWAPPED = {"min": "max", "max": "min", "np.maximum": "np.minimum", "np.minimum": "np.maximum"}
REMOVABLE = (ast.Assign, ast.AugAssign, ast.Expr, ast.Continue, ast.Break, ast.Raise)


def mutants(file: Path) -> Iterator[Mutant]:
    """Every mutant of one file."""
    tree = ast.parse(file.read_text("utf-8"))
    name, seen = str(file.relative_to(ROOT)), Counter[str]()
    for node in list(_code(tree)):
        for what, field, value in (*_operators(node), *_conditions(node), *_values(node), *_removals(node)):
            change = what if "removed" in what else f"{what} in `{ast.unparse(node).splitlines()[0]}`"
            seen[change] += 1
            before = getattr(node, field)
            setattr(node, field, value)
            source = ast.unparse(ast.fix_missing_locations(tree)) + "\n"
            setattr(node, field, before)
            yield Mutant(name, getattr(node, "lineno", 0), f"{change} ({seen[change]})", source)


def _code(tree: ast.Module) -> Iterator[ast.AST]:
    """Nodes that are code: no imports, annotations, decorators, docstrings, or f-strings (messages)."""
    stack: list[ast.AST] = [tree]
    while stack:
        node = stack.pop()
        yield node
        for name, value in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "bases"):
                continue
            children = value if isinstance(value, list) else [value]
            skipped = (ast.Import, ast.ImportFrom, ast.JoinedStr, ast.arg)
            stack += [
                c for c in children if isinstance(c, ast.AST) and not isinstance(c, skipped) and not _docstring(c)
            ]


def _docstring(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


Change = tuple[str, str, object]  # what, the field of the node that changes, and its new value


def _operators(node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in ARITHMETIC:
        other = ARITHMETIC[type(node.op)]
        yield f"{type(node.op).__name__} -> {other.__name__}", "op", other()
    if isinstance(node, ast.Compare):
        for k, op in enumerate(node.ops):
            swapped = BOUNDARY[type(op)]
            yield f"{type(op).__name__} -> {swapped.__name__}", "ops", [*node.ops[:k], swapped(), *node.ops[k + 1 :]]
    if isinstance(node, ast.BoolOp):
        yield "and <-> or", "op", ast.Or() if isinstance(node.op, ast.And) else ast.And()
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        yield "sign dropped", "op", ast.UAdd()
    if isinstance(node, ast.Call) and (other_name := SWAPPED.get(ast.unparse(node.func))):
        yield f"-> {other_name}", "func", ast.parse(other_name, mode="eval").body


def _conditions(node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        yield "condition negated", "test", ast.UnaryOp(ast.Not(), node.test)


def _values(node: ast.AST) -> Iterator[Change]:
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        value = node.value
        if isinstance(value, bool):
            yield f"{value} -> {not value}", "value", not value
        else:
            other = value + 1 if isinstance(value, int) or value == 0 else value * 2
            yield f"{value!r} -> {other!r}", "value", other


def _removals(node: ast.AST) -> Iterator[Change]:
    for name in ("body", "orelse"):
        block = getattr(node, name, None)
        for k, statement in enumerate(block if isinstance(block, list) else []):
            if isinstance(statement, REMOVABLE) and not _docstring(statement):
                first = ast.unparse(statement).splitlines()[0]
                what = f"line {statement.lineno} `{first}` removed"
                yield what, name, [*block[:k], ast.copy_location(ast.Pass(), statement), *block[k + 1 :]]


# ---------------------------------------------------------------- running them


def copy_repository(folder: Path) -> Path:
    """What the tests need, in a folder of its own."""
    ignore = shutil.ignore_patterns("__pycache__", ".venv", "runs", ".git", "*.pyc")
    for name in ("ethbrake_marl", "tests", "scenarios", "train"):
        shutil.copytree(ROOT / name, folder / name, ignore=ignore)
    shutil.copy(ROOT / "pyproject.toml", folder / "pyproject.toml")
    return folder


def quick_files(file: str) -> tuple[str, ...]:
    """Test files of the quick suite for a mutated file, those that exist."""
    return tuple(t for t in QUICK.get(Path(file).name, KERNEL) if (ROOT / t).exists())


def quick_run(folder: Path, files: tuple[str, ...], limit_s: int) -> tuple[str, float]:
    """Run tests in a forked process: "passed", "failed" or "timeout", and the processor time it took."""
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))
        _run_pytest(folder, files)
    _, status, used = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    verdict = "passed" if code == 0 else "timeout" if code in (-signal.SIGXCPU, -signal.SIGKILL) else "failed"
    return verdict, used.ru_utime + used.ru_stime


def _run_pytest(folder: Path, files: tuple[str, ...]) -> None:
    """In the child: the tests, silently; never returns."""
    import pytest

    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    os.dup2(null, 2)
    os.chdir(folder)
    sys.dont_write_bytecode = True
    for name in [name for name in sys.modules if name.split(".")[0] == "tests"]:
        del sys.modules[name]  # those of the working tree
    code = 3
    try:
        code = int(pytest.main([*PYTEST, "-W", "ignore::pytest.PytestAssertRewriteWarning", *files]))
    finally:
        os._exit(code)


def compiled_run(folder: Path) -> str:
    """The compiled suite in a process of its own."""
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "0", "NUMBA_CACHE_DIR": str(folder / "numba")}
    ignored = [f"--ignore={name}" for name in SLOW]
    command = [sys.executable, "-B", "-m", "pytest", *PYTEST, *ignored, *COMPILED]
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=COMPILED_LIMIT_S, check=False
        )
    except subprocess.TimeoutExpired:
        return "timeout"
    finally:
        shutil.rmtree(folder / "numba", ignore_errors=True)
    return "passed" if done.returncode == 0 else "failed"


class Worker:
    """One temporary copy of the repository in which mutants are tried one after another."""

    def __init__(self, folder: Path) -> None:
        self.folder = copy_repository(folder)
        self.limit_s: dict[tuple[str, ...], int] = {}

    def try_mutant(self, mutant: Mutant, *, compiled: bool) -> str:
        """The verdict of one suite on one mutant; the copy is whole again afterwards."""
        file = self.folder / mutant.file
        original = file.read_text("utf-8")
        try:
            file.write_text(mutant.source, "utf-8")
            if compiled:
                return compiled_run(self.folder)
            files = quick_files(mutant.file)
            return quick_run(self.folder, files, self.limit_s[files])[0]
        finally:
            file.write_text(original, "utf-8")

    def check_whole(self, share: list[Mutant]) -> None:
        """The suites must pass without a mutant, or nothing would mean anything; how long they take sets the limit."""
        for files in sorted({quick_files(mutant.file) for mutant in share}):
            verdict, seconds = quick_run(self.folder, files, COMPILED_LIMIT_S)
            if verdict != "passed":
                raise RuntimeError(f"the quick suite fails without any mutant: {' '.join(files)}")
            self.limit_s[files] = round(PATIENCE * seconds + SHORTEST_LIMIT_S)


def preload() -> None:
    """Load what every test process needs once, before forking; nothing of the package itself."""
    os.environ["NUMBA_DISABLE_JIT"] = "1"
    os.environ["OMP_NUM_THREADS"] = "1"
    sys.path[:] = [p for p in sys.path if Path(p or ".").resolve() != ROOT]
    import hypothesis
    import numba
    import numpy
    import pytest

    assert numba.config.DISABLE_JIT and hypothesis and numpy and pytest


def try_share(share: list[Mutant], compiled: bool) -> list[str]:
    """Verdicts of one suite on some mutants, one after another, in a copy of their own."""
    with tempfile.TemporaryDirectory() as folder:
        worker = Worker(Path(folder))
        if not compiled:
            worker.check_whole(share)
        return [worker.try_mutant(mutant, compiled=compiled) for mutant in share]


def try_all(chosen: list[Mutant], jobs: int, *, compiled: bool) -> dict[Mutant, str]:
    """Verdicts of one suite, in ``jobs`` processes."""
    shares = [chosen[k::jobs] for k in range(jobs)]
    with get_context("fork").Pool(jobs) as pool:
        verdicts = pool.starmap(try_share, [(share, compiled) for share in shares], chunksize=1)
    return {m: v for share, found in zip(shares, verdicts, strict=True) for m, v in zip(share, found, strict=True)}


def chosen_mutants(only: str, sample: int, seed: int) -> list[Mutant]:
    """All mutants, or a sample of them."""
    files = [f for f in sorted((ROOT / PHYSICS).glob("*.py")) if f.name not in NOT_MUTATED]
    every = [m for f in (*files, ROOT / "ethbrake_marl/harm.py") if only in f.name for m in mutants(f)]
    if sample and sample < len(every):
        every = random.Random(seed).sample(every, sample)
    return every


def main() -> int:
    """Try the mutants and print what lived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sample", type=int, default=0, help="try only K mutants, chosen at random")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", default="", help="only files whose name contains this")
    parser.add_argument("--quick", action="store_true", help="leave out the compiled suite for those that live")
    given = parser.parse_args()
    chosen = chosen_mutants(given.only, given.sample, given.seed)
    estimate = len(chosen) * SECONDS_PER_MUTANT / given.jobs / 60.0
    print(
        f"{len(chosen)} mutants, about {estimate:.0f} min in {given.jobs} processes, and the survivors' compiled runs"
    )
    preload()
    begin = time.monotonic()
    verdicts = try_all(chosen, given.jobs, compiled=False)
    alive = [m for m in chosen if verdicts[m] == "passed"]
    print(f"quick suite: {len(chosen) - len(alive)}/{len(chosen)} killed in {(time.monotonic() - begin) / 60:.1f} min")
    if not given.quick:
        second = try_all(alive, given.jobs, compiled=True)
        verdicts |= second
        alive = [m for m in alive if second[m] == "passed"]
    report(chosen, alive, verdicts, time.monotonic() - begin)
    return 0 if len(alive) <= 0.05 * len(chosen) else 1


def report(chosen: list[Mutant], alive: list[Mutant], verdicts: dict[Mutant, str], seconds: float) -> None:
    """Killed by file, the survivors, and the share."""
    total, lived = Counter(m.file for m in chosen), Counter(m.file for m in alive)
    for file in sorted(total):
        print(f"{file:42s} {total[file] - lived[file]:4d}/{total[file]}")
    for mutant in alive:
        print(f"survived  {mutant.name}")
    killed = len(chosen) - len(alive)
    timeouts, good = sum(v == "timeout" for v in verdicts.values()), killed >= 0.95 * len(chosen)
    print(
        f"mutation: {killed}/{len(chosen)} killed ({100 * killed / len(chosen):.1f} %, {timeouts} by running out of"
        f" time), threshold 95 %, {seconds / 60:.1f} min: {'PASS' if good else 'FAIL'}"
    )


if __name__ == "__main__":
    sys.exit(main())
