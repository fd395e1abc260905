"""The public names of the package: each listed once, shown by an example that runs, and described."""

from __future__ import annotations

import ast
import doctest
import inspect
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest
from pydantic import BaseModel

import ethbrake_marl as eb

ROOT = Path(__file__).resolve().parents[1]
PUBLIC = {name: getattr(eb, name) for name in eb.__all__ if name != "__version__"}
CLASSES = {name: value for name, value in PUBLIC.items() if inspect.isclass(value)}
MOST_WORDS = 100  # of a public docstring; more belongs into docs/
MANY_PARAMETERS = 4  # and more are described one by one


def own_docstring(value: Any) -> str:
    """The docstring that stands at the name itself, never an inherited one."""
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    return inspect.cleandoc(text or "")


def prose(text: str) -> str:
    """A docstring without its list of arguments and its examples."""
    without_arguments = re.sub(r"(?ms)^Args:\n.*?(\n\n(?=\S)|\Z)", "", text)
    return re.sub(r"(?ms)^>>> .*?(\n\n|\Z)", "", without_arguments)


def listed_arguments(text: str) -> set[str]:
    """The names that a docstring's ``Args:`` list describes."""
    lists = re.findall(r"(?ms)^Args:\n(.*?)(?:\n\n(?=\S)|\Z)", text)
    return {name for part in lists for line in re.findall(r"(?m)^    (\w[\w, ]*):", part) for name in line.split(", ")}


def commented_fields(value: type) -> set[str]:
    """Fields of a class whose own line, or the line above, says what they are."""
    lines = inspect.getsource(value).splitlines()
    found = set()
    for above, line in zip(["", *lines], lines, strict=False):
        field = re.match(r"    (\w+): ", line)
        if field and ("  # " in line or above.startswith("    # ")):
            found.add(field.group(1))
    return found


def undescribed(value: Any) -> list[str]:
    """Parameters that neither ``Args:`` nor, for a class that is a list of fields, a comment describes."""
    if is_dataclass(value):
        names = [field.name for field in fields(value) if field.init]
    elif isinstance(value, type) and issubclass(value, BaseModel):
        names = [name for name, field in value.model_fields.items() if field.description is None]
    else:
        try:
            parameters = inspect.signature(value).parameters.values()
        except ValueError:  # of an exception
            return []
        names = [p.name for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
    if len(names) < MANY_PARAMETERS:
        return []
    described = listed_arguments(own_docstring(value))
    if inspect.isclass(value):
        for base in value.__mro__:
            described |= commented_fields(base) if base.__module__.startswith("ethbrake_marl") else set()
    return [name for name in names if name not in described]


def examples() -> Iterator[Any]:
    """Every docstring of the package that holds an example."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    for path in sorted((ROOT / "ethbrake_marl").rglob("*.py")):
        if ">>> " in path.read_text("utf-8"):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            for found in finder.find(import_module(name), name.removeprefix("ethbrake_marl."), globs={}):
                if found.examples:
                    yield pytest.param(found, id=found.name)


def test_table__lists_each_name_once_and_each_can_be_imported() -> None:
    text = (ROOT / "ethbrake_marl" / "__init__.py").read_text("utf-8")
    names = re.findall(r"\b(\w+) as \1\b", text)
    assert sorted(names) == sorted(set(names))
    assert set(names) == set(PUBLIC)
    assert set(PUBLIC) <= set(dir(eb))


def test_every_name__is_used_by_the_file_that_mypy_reads() -> None:
    file = Path(__file__).with_name("every_public_name.py")
    nodes = ast.walk(ast.parse(file.read_text("utf-8")))
    used = {n.attr for n in nodes if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "eb"}
    assert set(eb.__all__) - used == set()
    assert f"--strict ethbrake_marl {file.relative_to(ROOT)}" in (ROOT / "Makefile").read_text("utf-8")


def test_unknown_name__suggests_the_nearest() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'evalute'; did you mean 'evaluate'\?"):
        eb.evalute  # type: ignore[attr-defined]  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'zzzzzz'$"):
        eb.zzzzzz  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("name", CLASSES)
def test_public_class__has_an_example(name: str) -> None:
    assert ">>> " in own_docstring(CLASSES[name])


def test_examples__those_of_every_public_class_are_run() -> None:
    run = {param.values[0].name.rpartition(".")[2] for param in examples()}
    assert {value.__name__ for value in CLASSES.values()} - run == set()


@pytest.mark.parametrize("example", [*examples()])
def test_example__runs(example: doctest.DocTest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    report: list[str] = []
    failed, _ = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example, out=report.append)
    assert not failed, "".join(report)


@pytest.mark.parametrize("name", PUBLIC)
def test_public_name__says_what_it_is_in_few_words(name: str) -> None:
    words = len(prose(own_docstring(PUBLIC[name])).split())
    assert 0 < words <= MOST_WORDS


@pytest.mark.parametrize("name", PUBLIC)
def test_public_name__describes_its_parameters_where_they_are_many(name: str) -> None:
    assert undescribed(PUBLIC[name]) == []


def test_undescribed__finds_a_planted_omission() -> None:
    def planted(a: int, b: int, c: int, d: int) -> None:
        """Claim.

        Args:
            a, b: two.
            c: one.

        """

    assert isinstance(planted, FunctionType)
    assert undescribed(planted) == ["d"]


QUESTIONS = frozenset({"What", "Who", "Whose", "How", "Where", "Whether", "When", "Which", "Why"})


@pytest.mark.parametrize("path", sorted((ROOT / "ethbrake_marl").rglob("*.py")), ids=lambda path: path.stem)
def test_module__says_what_it_is(path: Path) -> None:
    text = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
    assert text and re.split(r"\W", text)[0] not in QUESTIONS, f"{path}: {text.splitlines()[:1]}"
