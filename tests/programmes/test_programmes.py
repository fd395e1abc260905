"""The programmes: their runner, the page of libraries, bounds, bugs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from ethbrake_marl.motion.digest import physics_digest
from tests.programmes import Told, __main__ as runner, bounds, bugs, libraries

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
    assert runner.main([]) == 0 and {"bugs", "core", "wheel"} <= runner.programmes().keys()
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [*runner.programmes()]
    assert runner.main(["nobody"]) == 2


# ---------------------------------------------------------------- bounds


@pytest.mark.parametrize(("python", "good"), [(sys.executable, False), ("3.1", None)])
def test_versions__that_cannot_be_installed_fail_unless_that_python_is_missing(python, good, tmp_path, monkeypatch):
    monkeypatch.setattr(bounds, "KEPT", tmp_path)
    for variable in ("UV_OFFLINE", "UV_NO_CACHE"):
        monkeypatch.setenv(variable, "1")
    told = bounds.attempt("lowest-light", python, [], 0.0)
    assert told.good is good and told.text.startswith("not installed: ")


# ---------------------------------------------------------------- libraries

WAYS = [pytest.param(way, id=f"{way.library}: {way.title}") for way in libraries.ways()]
HERE = [each for each in WAYS if each.values[0].library in ("Stable-Baselines3", "SuperSuit")]


@pytest.mark.parametrize("way", WAYS)
def test_way__can_be_copied(way):
    lines = [line for line in way.code.splitlines() if line.strip()]
    assert 1 <= len(lines) <= 11 and max(map(len, lines)) <= 120
    if way.language == "python":
        compile(way.whole, way.title, "exec")


@pytest.mark.parametrize("way", HERE)
@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::DeprecationWarning")
def test_way__runs_in_the_projects_own_environment(way, tmp_path, monkeypatch):
    ppo = pytest.importorskip("stable_baselines3", reason="needs the extra train").PPO
    pytest.importorskip(way.library.lower().replace("-", "_"), reason="SuperSuit needs Python below 3.13")

    monkeypatch.chdir(tmp_path)
    usual = tuple(64 if value == 2048 else value for value in ppo.__init__.__defaults__)
    monkeypatch.setattr(ppo.__init__, "__defaults__", usual)
    names: dict[str, object] = {}
    exec(re.sub(r"n_steps=\d+", "n_steps=32", re.sub(r"\b\d+_000\b", "64", way.code)), names)
    assert names["agent"].act is not None


# ---------------------------------------------------------------- planted bugs


def test_bugs__each_patch_stands_in_the_code_exactly_once() -> None:
    assert bugs.misfits() == [] and len(bugs.planted()) >= 100


def test_bug__is_planted_in_the_copy_and_taken_out_again(tmp_path, monkeypatch) -> None:
    copy = bugs.copy_of_the_repository(tmp_path / "copy")
    bug = bugs.planted()[0]
    file, old, new = bug.patches[0]
    asked: list[tuple[bool, list[str]]] = []
    digest = "import ethbrake_marl.motion.digest as d; print(d.physics_digest())"

    def failing(copy: Path, tests: list[str]) -> str:
        told = subprocess.run([sys.executable, "-c", digest], cwd=copy, capture_output=True, text=True, check=True)
        assert told.stdout.strip() == physics_digest()  # or tables and proofs would give the bug away
        asked.append((new in (copy / bugs.PACKAGE / file).read_text("utf-8"), tests))
        return ""

    monkeypatch.setattr(bugs, "failing", failing)
    copies = bugs.SimpleQueue[Path]()
    copies.put(copy)
    assert bugs.finder(bug, copies) == ""
    assert asked == [(True, ["tests/motion"]), (True, ["tests", "--ignore=tests/motion"])]
    assert old in (copy / bugs.PACKAGE / file).read_text("utf-8")


def test_tests_near_a_file__are_those_of_its_folder() -> None:
    assert bugs.near("extensions/search/search.py") == ["tests/extensions/search"]
    assert "tests/test_agent_names.py" in bugs.near("agent_names.py")
