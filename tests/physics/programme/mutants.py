"""Mutants: the syntax tree of a file with one node changed."""

from __future__ import annotations

import ast
import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.programme.suites import ROOT, below_package


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

    @property
    def key(self) -> str:
        """Where and what, without the line: stays the same while code above moves."""
        return f"{below_package(self.file).removeprefix('physics/')}: {self.change}"

    @property
    def digest(self) -> str:
        """Of the whole mutated file."""
        return hashlib.sha256(self.source.encode()).hexdigest()[:20]


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
                what = f"`{first}` removed"
                yield what, name, [*block[:k], ast.copy_location(ast.Pass(), statement), *block[k + 1 :]]
