"""The public names of the package: each listed once, shown by an example that runs, and described."""

import ast
import doctest
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb

ROOT = Path(__file__).resolve().parents[1]
PUBLIC = {name: getattr(eb, name) for name in eb.__all__ if name != "__version__"}
CLASSES = {name: value for name, value in PUBLIC.items() if inspect.isclass(value)}


def own_docstring(value: Any) -> str:
    """The docstring that stands at the name itself, never an inherited one."""
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    return inspect.cleandoc(text or "")


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
    names = re.findall(r"\b(\w+) as \1\b", (ROOT / "ethbrake_marl" / "__init__.py").read_text("utf-8"))
    assert sorted(names) == sorted(PUBLIC)
    assert set(dir(eb)) == {"__version__", *PUBLIC}  # Tab shows public names only


def test_every_name__is_used_by_the_file_that_mypy_reads() -> None:
    file = Path(__file__).with_name("every_public_name.py")
    nodes = ast.walk(ast.parse(file.read_text("utf-8")))
    used = {n.attr for n in nodes if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "eb"}
    assert set(eb.__all__) - used == set()
    assert f"--strict ethbrake_marl {file.relative_to(ROOT)}" in (ROOT / "Makefile").read_text("utf-8")


def test_examples__every_public_class_has_one_and_it_is_run() -> None:
    run = {param.values[0].name.rpartition(".")[2] for param in examples()}
    assert [name for name, value in CLASSES.items() if ">>> " not in own_docstring(value)] == []
    assert {value.__name__ for value in CLASSES.values()} - run == set()


def test_examples__none_is_left_out() -> None:
    texts = [path.read_text("utf-8") for path in (ROOT / "ethbrake_marl").rglob("*.py")]
    prompts = sum(len(re.findall(r"(?m)^ *>>> ", text)) for text in texts)
    assert prompts == sum(len(param.values[0].examples) for param in examples())
    assert [text[:80] for text in texts if re.search(r"(?m)^ *(```|\.\. code)", text)] == []


@pytest.mark.parametrize("example", [*examples()])
def test_example__runs(example: doctest.DocTest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    report: list[str] = []
    failed, _ = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example, out=report.append)
    assert not failed, "".join(report)
