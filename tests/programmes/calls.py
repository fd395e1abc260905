"""Which test calls which function of the package: recorded once for a tree, and asked for by who changes a function.

As a plugin of pytest (``-p tests.programmes.calls``, with ``CALLS`` naming a folder) it writes, for each process, what
every test called and how long it took. Compiled functions are not seen being called: whoever mentions their name
stands for them.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.programmes import ROOT

PACKAGE = ROOT / "ethbrake_marl"
KEPT = ROOT / ".pytest_cache" / "calls"


# ---------------------------------------------------------------- recording


class Recorder:
    """Notes calls of Python functions; one thread after another may be inside."""

    def __init__(self, file: Path) -> None:
        self.file, self.calls, self.inside = file, set[Any](), str(PACKAGE) + os.sep
        self.of_fixture: dict[Any, set[str]] = {}
        self.tests: dict[str, tuple[float, list[str]]] = {}

    def __call__(self, frame: Any, event: str, arg: object) -> None:
        self.calls.add(frame.f_code)

    def taken(self) -> set[str]:
        """Functions called since the last time, as ``file:qualname``."""
        calls, self.calls = self.calls, set()
        return {
            f"{code.co_filename.removeprefix(self.inside)}:{code.co_qualname.partition('.<locals>.<')[0]}"
            for code in calls
            if code.co_filename.startswith(self.inside)
        }

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """What a fixture calls, whoever asked for it first."""
        before = self.taken()
        try:
            return (yield)
        finally:
            self.of_fixture[fixturedef] = self.taken()
            self.calls_of_test |= before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: Any) -> Iterator[Any]:
        """All calls of one test."""
        self.calls_of_test: set[str] = set()
        self.taken()
        begun = time.process_time()
        sys.settrace(self)
        threading.settrace(self)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            called = self.calls_of_test | self.taken()
            for definitions in item._fixtureinfo.name2fixturedefs.values():
                for definition in definitions:
                    called |= self.of_fixture.get(definition, set())
            self.tests[item.nodeid] = time.process_time() - begun, sorted(called)

    def pytest_sessionfinish(self) -> None:
        """Write what this process saw."""
        if self.tests:
            self.file.write_text(json.dumps(self.tests), "utf-8")


def pytest_configure(config: pytest.Config) -> None:
    """Record, if somebody asks for it."""
    if folder := os.environ.get("CALLS"):
        config.pluginmanager.register(Recorder(Path(folder) / f"{os.environ.get('PYTEST_XDIST_WORKER', 'main')}.json"))


def record(jobs: int, *more: str) -> dict[str, tuple[float, list[str]]]:
    """Test -> its processor time and the functions it calls; from the last record, if no file has changed since."""
    digest = hashlib.sha256()
    for file in sorted([*PACKAGE.rglob("*.py"), *(ROOT / "tests").rglob("*.py")]):
        digest.update(file.read_bytes())
    folder = KEPT / digest.hexdigest()[:16]
    if not (folder / "done").exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.programmes.calls", "-n", str(jobs), *more]
        done = subprocess.run(command, cwd=ROOT, env={**os.environ, "CALLS": str(folder)}, check=False)
        if done.returncode not in (0, 1):
            raise RuntimeError(f"the suite did not run: exit status {done.returncode}")
        (folder / "done").touch()
    return {test: found for file in folder.glob("*.json") for test, found in json.loads(file.read_text()).items()}


# ---------------------------------------------------------------- functions of a file


class Function(NamedTuple):
    """A function, a class or a module of the package."""

    key: str  # file:qualname, as calls are noted; the module itself is ``file:<module>``
    first: int
    last: int
    callable: bool  # no class and no module
    compiled: bool
    words: frozenset[str]  # names and attributes that its body mentions


def functions_of(file: Path) -> list[Function]:
    """What a file defines: the module first, then what stands in it, each before its parts."""
    tree, place = ast.parse(file.read_text("utf-8")), file.relative_to(PACKAGE).as_posix()
    last = len(file.read_text("utf-8").splitlines())
    found = [Function(f"{place}:<module>", 1, last, False, False, frozenset())]

    def walk(node: ast.AST, prefix: str, compiled: bool) -> None:
        for child in ast.iter_child_nodes(node):
            if not isinstance(child, ast.FunctionDef | ast.ClassDef):
                walk(child, prefix, compiled)
                continue
            name, inside = prefix + child.name, isinstance(child, ast.FunctionDef)
            marked = compiled or any("compiled" in ast.unparse(each) for each in child.decorator_list)
            words = {getattr(n, "id", None) or getattr(n, "attr", "") for n in ast.walk(child)}
            first = min([child.lineno, *(each.lineno for each in child.decorator_list)])
            last_line = child.end_lineno or first
            found.append(Function(f"{place}:{name}", first, last_line, inside, marked, frozenset(words)))
            walk(child, f"{name}.<locals>." if inside else f"{name}.", marked)

    walk(tree, "", False)
    return found


class Callers:
    """The tests of a tree, by what they call."""

    def __init__(self, recorded: dict[str, tuple[float, list[str]]]) -> None:
        self.cpu_s = {test: seconds for test, (seconds, _) in recorded.items()}
        self.callers = defaultdict[str, set[str]](set)
        for test, (_, called) in recorded.items():
            for key in called:
                self.callers[key].add(test)
        self.functions = {f.key: f for file in sorted(PACKAGE.rglob("*.py")) for f in functions_of(file)}

    def at(self, file: Path, line: int) -> Function:
        """The innermost function around a line."""
        place = file.relative_to(PACKAGE).as_posix() + ":"
        around = [f for f in self.functions.values() if f.key.startswith(place) and f.first <= line <= f.last]
        return min(around, key=lambda f: f.last - f.first)

    def of(self, function: Function, words: Iterable[str] = ()) -> set[str]:
        """Tests that call a function; if none is seen to, those of who mentions its name.

        Outside of functions, those of who mentions one of the ``words`` that get a value there, or the class.
        """
        found = set(self.callers.get(function.key, ())) if function.callable else set()
        frontier = {function.key.rpartition(":")[2].rpartition(".")[2], *(() if function.callable else words)}
        known: set[str] = set()
        while not found and frontier - known:
            known |= frontier
            mentioning = [f for f in self.functions.values() if f.words & frontier]
            for f in mentioning:
                found |= self.callers.get(f.key, set())
            frontier = {f.key.rpartition(":")[2].rpartition(".")[2] for f in mentioning}
        return found

    def ordered(
        self, function: Function, words: Iterable[str], topic: str, budget_s: float, most_files: int
    ) -> list[str]:
        """Tests that may notice a change of a function: likely and quick ones first, as many as the time allows.

        Likely are those of its module, those that are named by a word of the ``topic``, and those of its folder.
        """
        found = self.of(function, words)
        room = "tests/" + function.key.rpartition(":")[0].removesuffix(".py").partition("/")[0]
        module = "/test_" + function.key.rpartition(":")[0].rpartition("/")[2] + "::"

        subjects = set(re.findall("[a-z]{6,}", topic.lower()))

        def rank(test: str) -> tuple[bool, bool, bool, float]:
            return (
                module not in test,
                not any(subject in test for subject in subjects),
                not test.startswith((room + "/", room.replace("tests/", "tests/test_"))),
                self.cpu_s[test],
            )

        chosen: list[str] = []
        files: set[str] = set()
        spent = 0.0
        near = {test for test in self.cpu_s if test.startswith(room + "/")} - found
        if function.compiled:  # whose callers are not known by sight
            found, near = found | near, set()
        for test in [*sorted(found, key=rank), *sorted(near, key=rank)]:
            file = test.partition("::")[0]
            if spent + self.cpu_s[test] <= budget_s and (file in files or len(files) < most_files):
                chosen.append(test)
                files.add(file)
                spent += self.cpu_s[test]
        return chosen
