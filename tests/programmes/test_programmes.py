"""The programmes: their runner, the page of libraries, samples of long ones, the cage of hostile files, bugs."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.docs.printed import rows
from tests.programmes import ROOT, Told, __main__ as runner, faults, hostile, libraries


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
    assert runner.main(["wheel", *words]) == status
    assert capsys.readouterr().out.splitlines()[-1] == end


def test_runner__lists_every_programme_and_knows_no_other(capsys):
    assert runner.main([]) == 0 and {"motion", "shields", "wheel"} <= runner.programmes().keys()
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [*runner.programmes()]
    assert runner.main(["nobody"]) == 2


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


# ---------------------------------------------------------------- hostile files, proofs, attacks


@pytest.mark.slow
def test_hostile_files__are_all_refused_as_they_should_be():
    done = run("hostile")
    assert done.stdout.splitlines()[-1].startswith("PASS: 73 of 73 good"), done.stdout + done.stderr


@pytest.mark.parametrize(
    ("fault", "command"),
    [
        ("DEED: os.mkdir", lambda: os.mkdir("/tmp/of-a-test")),
        ("DEED: executed os.system", lambda: os.system("true")),
        ("exit status 0", lambda: None),
        ("code was executed", lambda: Path("pwned").touch()),
    ],
)
def test_judge__tells_what_breaks_a_rule(fault, command, tmp_path):
    good, told = hostile.judge(hostile.Case("x", command, lambda folder: None), tmp_path / "case")
    assert not good and fault in told


@pytest.mark.slow
def test_proofs__every_statement_and_every_planted_bug():
    pytest.importorskip("z3")
    done = run("proofs", NUMBA_DISABLE_JIT="1")
    assert done.stdout.splitlines()[-1] == "PASS: 15 of 15 good, 0 failed, 0 without a verdict", done.stdout


# ---------------------------------------------------------------- planted bugs


def test_bugs__each_patch_stands_in_the_code_exactly_once() -> None:
    bugs, misfits = faults.planted()
    assert misfits == [] and len(bugs) >= 25


def test_tests_of_a_function__are_those_that_call_it_near_ones_first():
    summing = ["motion/contact.py:gap_after"]
    tests = faults.Callers(
        {
            "tests/test_a.py::test_one": (0.1, ["motion/drive.py:drive"]),
            "tests/test_b.py::test_two": (0.2, summing),
            "tests/motion/test_c.py::test_three": (9.0, summing),
        }
    )
    file = faults.PACKAGE / "motion/contact.py"
    first = file.read_text("utf-8").splitlines().index("def gap_after(gap, closing, pressing, jerk, time):") + 1
    near_ones_first = ["tests/motion/test_c.py::test_three", "tests/test_b.py::test_two"]
    assert tests.ordered(tests.at(file, first + 2), "", 10.0, 9) == near_ones_first
    assert tests.ordered(tests.at(file, first + 2), "", 5.0, 9) == near_ones_first[1:]
