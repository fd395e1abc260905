"""Planted bugs that some test must find: errors that people make in such code. They are in ``bugs.yaml``.

    make programme NAME=faults ARGS="bugs --only WORD"

A bug is written into a copy of the repository, never into the working tree. In the copy the tests run that call the
changed function, likely and fast tests first, until one fails. Compiled functions are first tried without compilation.
A bug is found if a test fails, or if the tests do not end.

The calls of each test are recorded once per state of the repository. As a pytest plugin (``-p
tests.programmes.faults``, with a folder in the variable ``CALLS``) this file records, per process, the functions that
every test called, and its time. Calls of compiled functions are invisible; functions that mention their names count
instead.
"""

import ast
import hashlib
import importlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from tests.programmes import ROOT, Cases, Given, Told

PACKAGE = ROOT / "ethbrake_marl"
KEPT = ROOT / ".pytest_cache" / "calls"
BUGS = Path(__file__).with_name("bugs.yaml")
COPIES = ROOT / ".pytest_cache" / "copies"
PARTS = ("ethbrake_marl", "tests", "scenarios", "train", "docs", "README.md", "pyproject.toml", "Makefile")
PRELOADED = (
    "hypothesis", "numba", "numpy", "pytest", "torch", "stable_baselines3", "scipy.stats", "scipy.optimize", "pydantic",
    "matplotlib.pyplot", "gymnasium", "pettingzoo", "yaml", "rich", "typer", "tensorboard.compat.proto.event_pb2",
)  # fmt: skip
PYTEST = (
    "-q", "-m", "not long", "-p", "no:cacheprovider", "-p", "no:randomly", "--rootdir=.",
    "-W", "ignore::pytest.PytestAssertRewriteWarning",  # of what is loaded before
)  # fmt: skip

BUDGET_S = 40.0  # processor time of the tests that are tried, as they take without a fault
MOST_FILES = 30
EACH_S = 2.0  # of a test without compilation: what takes longer is left to the compiled run
INTERPRETED_S = 40.0  # of all of them
COMPILING_S = 240.0  # beyond the budget: to compile what was changed, and to be slower than usual
MOST_MEMORY_BYTES = 10 * 2**30


# ---------------------------------------------------------------- recording


class Recorder:
    """Records calls of Python functions, in one thread at a time."""

    def __init__(self, file: Path) -> None:
        self.file, self.calls, self.inside = file, set[Any](), str(PACKAGE) + os.sep
        self.of_fixture: dict[Any, set[str]] = {}
        self.tests: dict[str, tuple[float, list[str]]] = {}

    def __call__(self, frame: Any, event: str, arg: object) -> None:
        self.calls.add(frame.f_code)

    def taken(self) -> set[str]:
        """Return the functions called since the last time, as ``file:qualname``, and forget them."""
        calls, self.calls = self.calls, set()
        return {
            f"{code.co_filename.removeprefix(self.inside)}:{code.co_qualname.partition('.<locals>.<')[0]}"
            for code in calls
            if code.co_filename.startswith(self.inside)
        }

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Record the calls of a fixture, for all tests that use it."""
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
        """Write the record of this process."""
        if self.tests:
            self.file.write_text(json.dumps(self.tests), "utf-8")


def pytest_configure(config: pytest.Config) -> None:
    """Start recording if the variable ``CALLS`` is set."""
    if folder := os.environ.get("CALLS"):
        config.pluginmanager.register(Recorder(Path(folder) / f"{os.environ.get('PYTEST_XDIST_WORKER', 'main')}.json"))


def record(jobs: int, *more: str) -> dict[str, tuple[float, list[str]]]:
    """Return test -> (processor time, called functions); from the last record if no file has changed."""
    files = sorted([*PACKAGE.rglob("*.py"), *(ROOT / "tests").rglob("*.py")])
    digest = hashlib.sha256(b"".join(file.read_bytes() for file in files))
    folder = KEPT / digest.hexdigest()[:16]
    if not (folder / "done").exists():
        folder.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.programmes.faults", "-n", str(jobs), *more]
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


@cache
def functions_of(file: Path) -> list[Function]:
    """Return the module, functions and classes of a file; outer ones come before inner ones."""
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
    """The tests of a repository, by the functions that they call."""

    def __init__(self, recorded: dict[str, tuple[float, list[str]]]) -> None:
        self.cpu_s = {test: seconds for test, (seconds, _) in recorded.items()}
        self.callers = defaultdict[str, set[str]](set)
        for test, (_, called) in recorded.items():
            for key in called:
                self.callers[key].add(test)
        self.functions = {f.key: f for file in sorted(PACKAGE.rglob("*.py")) for f in functions_of(file)}

    def at(self, file: Path, line: int) -> Function:
        """Return the innermost function that contains a line."""
        place = file.relative_to(PACKAGE).as_posix() + ":"
        around = [f for f in self.functions.values() if f.key.startswith(place) and f.first <= line <= f.last]
        return min(around, key=lambda f: f.last - f.first)

    def of(self, function: Function) -> set[str]:
        """Tests that call a function; if none is seen to, those of who mentions its name."""
        found = set(self.callers.get(function.key, ())) if function.callable else set()
        frontier = {function.key.rpartition(":")[2].rpartition(".")[2]}
        known: set[str] = set()
        while not found and frontier - known:
            known |= frontier
            mentioning = [f for f in self.functions.values() if f.words & frontier]
            for f in mentioning:
                found |= self.callers.get(f.key, set())
            frontier = {f.key.rpartition(":")[2].rpartition(".")[2] for f in mentioning}
        return found

    def ordered(self, function: Function, topic: str, budget_s: float, most_files: int) -> list[str]:
        """Tests that may notice a change of a function: likely and quick ones first, as many as the time allows.

        Likely are those of its module, those that are named by a word of the ``topic``, and those of its folder.
        """
        found = self.of(function)
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


# ---------------------------------------------------------------- faults


@dataclass(frozen=True)
class Fault:
    """A change of the package: the new texts of its files."""

    name: str
    file: str  # below the package; the first one that changes
    line: int
    texts: tuple[tuple[str, str], ...]  # file below the package, its text


def planted() -> tuple[list[Fault], list[str]]:
    """Return the planted bugs that fit the code, and the names of those that do not."""
    bugs, misfits = [], []
    for name, patches in yaml.safe_load(BUGS.read_text("utf-8")).items():
        texts: dict[str, str] = {}
        fits = True
        for place, old, new in patches:
            text = texts.get(place) or (PACKAGE / place).read_text("utf-8")
            if text.count(old) != 1:
                misfits.append(f"{name}: {place} holds {old!r} {text.count(old)} times, not once")
                fits = False
            texts[place] = text.replace(old, new)
        if not fits:
            continue
        place, old, _ = patches[0]
        text = (PACKAGE / place).read_text("utf-8")
        at = text.find(old) + next((k for k, (a, b) in enumerate(zip(old, patches[0][2], strict=False)) if a != b), 0)
        bugs.append(Fault(name, place, text[:at].count("\n") + 1, tuple(texts.items())))
    return bugs, misfits


# ---------------------------------------------------------------- one copy of the repository


class Listener:
    """Pytest plugin in the child process: chooses and orders the tests, and notes the first failure."""

    def __init__(self, tests: list[str], each_s: float | None, pipe: int) -> None:
        self.places = {test: k for k, test in enumerate(tests)}
        self.each_s, self.pipe = each_s, pipe

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Keep only the chosen tests, in the chosen order."""
        items[:] = sorted((i for i in items if i.nodeid in self.places), key=lambda i: self.places[i.nodeid])

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self) -> Iterator[Any]:
        """Ends a test that takes too long without compilation, as if it had been skipped."""
        if self.each_s is not None:
            signal.setitimer(signal.ITIMER_PROF, self.each_s)
        try:
            return (yield)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note the first failure."""
        if report.failed:
            os.write(self.pipe, f"{report.nodeid}\n".encode())

    pytest_collectreport = pytest_runtest_logreport  # a file of tests that cannot even be read


def _too_slow(*_: object) -> None:
    pytest.skip("too slow without compilation")


class Copy:
    """A copy of the repository with its own kernels, in which faults are tried one after another."""

    def __init__(self, number: int, jobs: int) -> None:
        self.folder = COPIES / str(number)
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        skipped = shutil.ignore_patterns("__pycache__", ".venv", "runs", ".git", "*.pyc")
        for name in PARTS:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, self.folder / name, ignore=skipped)
            elif (ROOT / name).exists():
                shutil.copy2(ROOT / name, self.folder / name)
        self.tests = Callers(record(jobs))
        self.red_anyway: dict[bool, set[str]] = {True: set(), False: set()}  # compiled or not -> tests
        self.green: dict[bool, set[str]] = {True: set(), False: set()}  # those known to pass without a fault
        self.digests: dict[str, str] = json.loads(self.ask(_digests))

    @contextmanager
    def changed(self, fault: Fault) -> Iterator[None]:
        """Context manager: the copy has the fault inside the block."""
        kernels = COPIES / f"{self.folder.name}-kernels" / PACKAGE.name
        before = set(kernels.rglob("*")) if kernels.is_dir() else set()
        try:
            for file, text in fault.texts:
                (self.folder / PACKAGE.name / file).write_text(text, "utf-8")
            yield
        finally:
            for file, _ in fault.texts:
                shutil.copy2(PACKAGE / file, self.folder / PACKAGE.name / file)
            for other in set(kernels.rglob("*")) - before if self.function(fault).compiled else ():
                other.unlink(missing_ok=True)

    def function(self, fault: Fault) -> Function:
        """Where a fault is."""
        return self.tests.at(PACKAGE / fault.file, fault.line)

    def ask(self, what: Any, *given: Any, cpu_s: float = COMPILING_S) -> str:
        """Run a function in a forked process of this folder. Return its output, or how it ended if it wrote nothing."""
        ends, begins = os.pipe()
        child = os.fork()
        if child == 0:
            code = 1
            try:
                os.close(ends)
                self._settle(cpu_s)
                what(self, begins, *given)
                code = 0
            finally:
                os._exit(code)
        os.close(begins)
        with os.fdopen(ends, "rb") as pipe:
            answer = pipe.read().decode()
        _, status, _ = os.wait4(child, 0)
        ended = os.waitstatus_to_exitcode(status)
        return answer or ("" if ended == 0 else "(no end)" if ended < 0 else f"(exit status {ended})")

    def _settle(self, cpu_s: float) -> None:
        """In the child process: silence output, set limits, and change the folder."""
        limit = round(cpu_s)
        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(20 * limit)
        signal.signal(signal.SIGPROF, _too_slow)
        kernels = COPIES / f"{self.folder.name}-kernels"
        os.environ |= {"NUMBA_CACHE_DIR": str(kernels), "PYTHONPATH": str(self.folder)}
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os.chdir(self.folder)
        sys.dont_write_bytecode = True
        sys.path.insert(0, str(self.folder))
        for name in [name for name in sys.modules if name.split(".")[0] in ("tests", PACKAGE.name)]:
            del sys.modules[name]  # those of the working tree

    def red(self, tests: list[str], *, compiled: bool, own_kernels: bool = False, every: bool = False) -> list[str]:
        """Return the first of these tests that fails now, or all that fail; empty if none does."""
        tests = [test for test in tests if test not in self.red_anyway[compiled]]
        if not tests:
            return []
        limit = COMPILING_S + 3.0 * BUDGET_S if compiled else INTERPRETED_S
        red = self.ask(_run, tests, compiled, own_kernels, every, cpu_s=limit).splitlines()
        return [] if not compiled and red == ["(no end)"] else red

    def verdict(self, fault: Fault) -> str:
        """Return the first test that finds a fault; empty if none does."""
        function = self.function(fault)
        tests = self.tests.ordered(function, fault.name, BUDGET_S, MOST_FILES)
        for compiled in (False, True) if function.compiled else (True,):
            while True:
                with self.changed(fault):
                    red = self.red(tests, compiled=compiled, own_kernels=function.compiled)[:1]
                if not red or red[0] in self.green[compiled]:
                    break
                named = not red[0].startswith("(")  # else all came to an end, which says nothing if they do so anyway
                again = [test for test in tests if not named or test.startswith(red[0])][:1]
                if not self.red(again, compiled=compiled):
                    self.green[compiled] |= set(red) if named else set()
                    break
                if not named:
                    raise RuntimeError(f"the tests do not run without a fault, either: {again}: {red}")
                # It fails without the fault, too, and is seldom alone in that.
                self.red_anyway[compiled] |= {*red, *again, *self.red(tests, compiled=compiled, every=True)}
            if red:
                return red[0]
        return ""


def _digests(self: Copy, pipe: int) -> None:
    """In a child: the folder of the machine code of each file, as long as no kernel changes."""
    from ethbrake_marl.motion.compiling import folder_of

    files = sorted((self.folder / PACKAGE.name).rglob("*.py"))
    found = {str(file): str(folder_of(str(file))) for file in files if b"compiling import" in file.read_bytes()}
    os.write(pipe, json.dumps(found).encode())


def _run(self: Copy, pipe: int, tests: list[str], compiled: bool, own_kernels: bool, every: bool) -> None:
    """In a child: some tests, until one fails or all of them; those that fail are written to the pipe."""
    import numba

    numba.config.DISABLE_JIT = not compiled
    os.environ["NUMBA_DISABLE_JIT"] = str(int(not compiled))
    if compiled and not own_kernels:
        from ethbrake_marl.motion import compiling

        own = compiling.folder_of
        compiling.folder_of = cache(lambda file: Path(self.digests[file]) if file in self.digests else own(file))
    plugin = Listener(tests, None if compiled else EACH_S, pipe)
    files = list(dict.fromkeys(test.partition("::")[0] for test in tests))
    status = int(pytest.main([*PYTEST, *([] if every else ["-x"]), *files], plugins=[plugin]))
    if status in (3, 4):  # pytest itself failed, or could not begin: the fault is met by whoever imports the package
        os.write(pipe, f"(exit status {status} of pytest)\n".encode())


# ---------------------------------------------------------------- all of them


_COPIES: list[Copy] = []  # that of this process


def make_copy(numbers: Any, jobs: int) -> None:
    """Make the copy of the repository for this worker process."""
    _COPIES.append(Copy(numbers.get(), jobs))


def try_fault(fault: Fault) -> str:
    """Return the verdict on one fault, in the copy of this process."""
    return _COPIES[0].verdict(fault)


def preload() -> None:
    """Import modules that every process needs, before forking; none of them is part of the package."""
    os.environ |= {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    sys.path[:] = [p for p in sys.path if Path(p or ".").resolve() != ROOT]
    for name in PRELOADED:
        importlib.import_module(name)


OPTIONS = {
    "what": {"choices": ("bugs",), "nargs": "?"},
    "--jobs": {"type": int, "default": 2, "help": "number of processes"},
}


def cases(given: Given) -> Cases:
    """Yield all planted bugs with the test that finds each."""
    bugs, misfits = planted()
    for wrong in misfits:
        yield wrong, partial(Told, False, "the bug's text is not in the code")
    bugs = [bug for bug in bugs if given.only in bug.name]
    if bugs and not given.list:
        record(given.jobs)
        preload()
    context = get_context("fork")
    numbers = context.SimpleQueue()
    for number in range(given.jobs):
        numbers.put(number)
    with ProcessPoolExecutor(given.jobs, context, make_copy, (numbers, given.jobs)) as pool:
        tried = {} if given.list else {bug.name: pool.submit(try_fault, bug) for bug in bugs}

        def told(bug: Fault) -> Told:
            red = tried[bug.name].result()
            return Told(bool(red), red or "no test finds it")

        for bug in bugs:
            yield bug.name, partial(told, bug)
