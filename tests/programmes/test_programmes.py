"""The programmes: their runner, what they say on the pages, samples of long ones, the hostile one's cage, faults."""

import ast
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.docs.printed import rows
from tests.programmes import ROOT, Told, __main__ as runner, audit, bounds, faults, hostile, libraries
from tests.programmes.audit import Package
from tests.programmes.cage import Case, judge
from tests.programmes.faults import PACKAGE, Callers, functions_of

PAGE = ROOT / "docs" / "internals" / "bundles.md"


def run(*words: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """A programme in a process of its own."""
    command = [sys.executable, "-m", "tests.programmes", *words]
    given = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(command, cwd=ROOT, env=given, capture_output=True, text=True, check=False)


# ---------------------------------------------------------------- the runner


def fails() -> Told:
    raise AssertionError("why")


@pytest.mark.parametrize(
    ("words", "status", "end"),
    [
        ((), 1, "FAIL: 1 of 3 good, 1 failed, 1 without a verdict"),
        (("--only", "good"), 0, "PASS: 1 of 1 good, 0 failed, 0 without a verdict"),
        (("--only", "unknown"), 1, "FAIL: 0 of 0 good, 0 failed, 0 without a verdict"),
        (("--within", "-1"), 0, "PASS: 0 of 3 good, 0 failed, 3 without a verdict"),
        (("--list",), 0, "skipped"),
    ],
)
def test_runner__says_how_the_cases_ended_and_exits_by_it(words, status, end, monkeypatch, capsys):
    cases = {"good": lambda: Told(True, "fine"), "fails": fails, "skipped": lambda: Told(None)}
    programme = type("programme", (), {"cases": staticmethod(lambda given: iter(cases.items()))})
    monkeypatch.setattr(runner, "import_module", lambda name: programme)
    assert runner.main(["audit", *words]) == status
    assert capsys.readouterr().out.splitlines()[-1] == end


def test_runner__lists_every_programme_and_knows_no_other(capsys):
    assert runner.main([]) == 0 and {"audit", "shield", "wheel"} <= runner.programmes().keys()
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [*runner.programmes()]
    assert runner.main(["nobody"]) == 2


# ---------------------------------------------------------------- bounds


def test_bounds__names_folders_of_tests_that_there_are() -> None:
    assert [folder for folder in bounds.TESTS if not [*(ROOT / "tests" / folder).glob("test_*.py")]] == []


# ---------------------------------------------------------------- audit


def test_packages__that_are_here_have_licences_that_are_known() -> None:
    found = [each for each in audit.packages() if each.installed]
    assert len(found) > 50
    assert [f"{each.name}: {each.licence!r}" for each in found if not each.family] == []


def test_table__lists_every_pinned_package_under_its_licence() -> None:
    lines = (ROOT / "docs" / "licences.csv").read_text("utf-8").splitlines()
    listed = dict(line.split(",") for line in lines[1:])
    assert len(listed) == len(lines) - 1
    found = audit.packages()
    assert sorted(each.name for each in found) == sorted(listed)
    assert [each.name for each in found if each.installed and each.family != listed[each.name]] == []


# ---------------------------------------------------------------- libraries

WAYS = [pytest.param(way, id=f"{way.library}: {way.title}") for way in libraries.ways()]
HERE = [each for each in WAYS if each.values[0].library in ("Stable-Baselines3", "SuperSuit")]


def test_page_of_libraries__has_a_row_for_every_way():
    _, *table = rows("results/libraries", "## Other libraries")
    assert [tuple(row[k] for k in (0, 2, 3)) for row in table] == [
        (way.library, libraries.lowered(way.title), way.ran) for way in libraries.ways()
    ]


@pytest.mark.parametrize("way", WAYS)
def test_way__can_be_copied(way):
    lines = [line for line in way.code.splitlines() if line.strip()]
    assert 1 <= len(lines) <= 11 and max(map(len, lines)) <= 120
    if way.language == "python":
        compile(way.whole, way.title, "exec")


@pytest.mark.parametrize("way", HERE)
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
def test_way__runs_in_the_projects_own_environment(way, tmp_path, monkeypatch):
    if find_spec("stable_baselines3") is None:
        pytest.skip("needs the extra train")
    from stable_baselines3 import PPO

    monkeypatch.chdir(tmp_path)
    usual = tuple(64 if value == 2048 else value for value in PPO.__init__.__defaults__)
    monkeypatch.setattr(PPO.__init__, "__defaults__", usual)
    names: dict[str, object] = {}
    exec(re.sub(r"n_steps=\d+", "n_steps=32", re.sub(r"\b\d+_000\b", "64", way.code)), names)
    assert names["agent"].act is not None


# ---------------------------------------------------------------- hostile files, proofs


@pytest.mark.slow
def test_hostile_files__a_sample_of_the_attack_breaks_no_rule():
    done = run("hostile", "--sample", "1", "--only", "e: ")
    assert done.returncode == 0 and done.stdout.count("\nok ") > 50, done.stdout + done.stderr


@pytest.mark.slow
def test_proofs__every_statement_and_every_planted_bug():
    pytest.importorskip("z3")
    done = run("proofs", NUMBA_DISABLE_JIT="1")
    assert done.stdout.splitlines()[-1] == "PASS: 27 of 27 good, 0 failed, 0 without a verdict", done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "cases"),
    [
        ("physics --small-step-worlds 64 --only|brakes that", 16),
        ("shield --build-up-worlds 2000 --only|build-up: in pieces, N = 3, first", 10),
        ("shield --joint-worlds 400 --only|joint: in pieces", 24),
    ],
)
def test_attacks__a_sample_of_what_only_programmes_run(words, cases):
    options, only = words.split("|")
    done = run(*options.split(), only)
    assert done.stdout.splitlines()[-1] == f"PASS: {cases} of {cases} good, 0 failed, 0 without a verdict", done.stdout


def test_proofs__refuse_compiled_functions():
    done = run("proofs", NUMBA_DISABLE_JIT="0")
    assert done.returncode == 1 and "compilation must be switched off" in done.stderr


@pytest.mark.parametrize(
    ("case", "fault"),
    [
        (Case("x", ("nonsense",), lambda folder: (folder / "../../x").touch()), "left a file outside its folder: x"),
        (Case("x", ("--version",), lambda folder: None), "the file was not refused"),
        (
            Case("x", ("nonsense",), Path.resolve, reader=lambda: os.mkdir("/tmp/x-of-a-test")),
            "tried to change a file outside",
        ),
        (Case("x", ("nonsense",), Path.resolve, reader=lambda: os.system("true")), "executed: os.system"),
        (Case("x", ("nonsense",), Path.resolve, reader=lambda: 1), "python: no error"),
        (Case("x", ("nonsense",), Path.resolve, reader=lambda: Path("new").touch()), "changed: inside/new"),
    ],
)
def test_judge__tells_what_breaks_a_rule(case, fault, tmp_path):
    assert [told for told in judge(case, tmp_path / "case").faults if told.startswith(fault)]


def test_page__says_how_much_the_attack_holds():
    groups = [group for kind in hostile.KINDS for group in hostile.by_category(kind, 0).values()]
    assert f"{sum(map(len, groups)):,} files and command lines of {len(groups)} categories" in PAGE.read_text("utf-8")


# ---------------------------------------------------------------- faults


def test_bugs__each_patch_stands_in_the_code_exactly_once() -> None:
    bugs, misfits = faults.planted()
    assert misfits == []
    assert {bug.folder for bug in bugs} >= {"physics", "engine", "shields", "extensions", "training", "ethbrake_marl"}


def test_mutants__are_code_of_as_many_lines_and_the_same_for_the_same_seed() -> None:
    mutants = faults.sample_of("files", 40, 3)
    assert len(mutants) == 40
    assert [m.digest for m in faults.sample_of("files", 5, 3)] == [m.digest for m in mutants[:5]]
    for mutant in mutants:
        ((file, text),) = mutant.texts
        original = (PACKAGE / file).read_text("utf-8")
        ast.parse(text)
        assert text != original
        assert text.count("\n") == original.count("\n")


@pytest.mark.parametrize(
    ("licence", "family"),
    [
        ("MIT", "MIT"),
        ("GPL / BSD License", "BSD"),
        ("GNU General Public License v3 (GPLv3)", ""),
        ("AGPL-3.0", ""),
        ("", ""),
        ("Proprietary", ""),
        ("MIT AND GPL-3.0", ""),
    ],
)
def test_licence__that_is_not_known_is_a_fault(licence: str, family: str) -> None:
    package = Package("mine", "1.0", "1.0", licence)
    assert (package.family or "") == family
    assert package.fault == ("" if family else f"licence {licence!r} is unknown")


def test_version__that_is_not_the_pinned_one_is_a_fault_but_not_its_local_part() -> None:
    assert Package("torch", "2.13.0", "2.13.0+cpu", "BSD").fault == ""
    assert Package("torch", "2.13.0", "2.12.0", "BSD").fault == "is pinned to 2.13.0"


def test_tests_of_a_function__are_those_that_call_it() -> None:
    summing = ["physics/state.py:sum_rows"]
    tests = Callers(
        {
            "tests/test_a.py::test_one": (0.1, ["physics/advance.py:advance"]),
            "tests/test_b.py::test_two": (0.2, summing),
            "tests/physics/test_c.py::test_three": (9.0, summing),
            "tests/test_d.py::test_shoving": (9.0, summing),
        }
    )
    kernel = next(f for f in functions_of(PACKAGE / "physics/advance.py") if f.key.endswith(":advance_worlds"))
    assert kernel.compiled
    assert tests.of(kernel) == {"tests/test_a.py::test_one"}
    file = PACKAGE / "physics/state.py"
    first = file.read_text("utf-8").splitlines().index("def sum_rows(values: Floats) -> Floats:") + 1
    summed = tests.at(file, first + 2)
    assert summed.key == "physics/state.py:sum_rows"


def test_tests__near_the_module_come_first_then_the_quick_ones() -> None:
    file = PACKAGE / "physics/state.py"
    first = file.read_text("utf-8").splitlines().index("def sum_rows(values: Floats) -> Floats:") + 1
    summing = ["physics/state.py:sum_rows"]
    tests = Callers(
        {
            "tests/test_a.py::test_one": (0.1, ["physics/advance.py:advance"]),
            "tests/test_b.py::test_two": (0.2, summing),
            "tests/physics/test_c.py::test_three": (9.0, summing),
            "tests/test_d.py::test_shoving": (9.0, summing),
        }
    )
    summed = tests.at(file, first + 2)
    assert tests.ordered(summed, (), "", 10.0, 9) == [
        "tests/physics/test_c.py::test_three",
        "tests/test_b.py::test_two",
    ]
    assert tests.ordered(summed, (), "", 5.0, 9) == ["tests/test_b.py::test_two"]
    assert tests.ordered(summed, (), "shoving counted twice", 10.0, 9) == [
        "tests/test_d.py::test_shoving",
        "tests/test_b.py::test_two",
    ]
