"""The package imports one way, without a circle, stays light, and its core needs no extra."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

from ethbrake_marl import errors
from ethbrake_marl.errors import EXTRA_OF, MissingExtra, naming_extras, need
from tests.refused import refused

ROOT = Path(__file__).resolve().parents[1]


PACKAGE = "ethbrake_marl"


def modules(package: Path) -> Iterator[tuple[str, Path]]:
    for path in sorted(package.rglob("*.py")):
        yield path.relative_to(package).parts[0].removesuffix(".py"), path


def imported_by_text(tree: ast.AST) -> Iterator[tuple[int, str]]:
    for node in ast.walk(tree):
        match node:
            case ast.Call(
                func=ast.Attribute(attr="import_module" | "__import__") | ast.Name(id="import_module" | "__import__"),
                args=[ast.Constant(value=str(module)), *_],
            ):
                yield node.lineno, module


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


def test_package__imports_no_module_of_its_own_by_a_text() -> None:
    """Import-linter would not see it. What is loaded late stands in a table of "module:function" instead."""
    found = [(path, each) for _, path in modules(ROOT / PACKAGE) for each in imported_by_text(tree_of(path))]
    assert [(path, line) for path, (line, module) in found if module.split(".")[0] == PACKAGE] == []


def test_import__loads_nothing_heavy_and_says_nothing() -> None:
    program = """
import sys
import ethbrake_marl
found = {"torch", "matplotlib", "stable_baselines3"} & set(sys.modules)
ethbrake_marl.evaluate, ethbrake_marl.parallel_env  # without what only figures and reports need
found |= {"torch", "matplotlib", "jinja2", "scipy.stats"} & set(sys.modules)
import ethbrake_marl.cli.app
found |= {"torch", "stable_baselines3"} & set(sys.modules)
sys.exit(", ".join(found) or None)
"""
    assert ended(program) == (0, "", "")


def ended(program: str, *, cwd: Path = ROOT, warnings: str = "error") -> tuple[int, str, str]:
    """Exit status, stdout and stderr of a Python program that begins as the script `ethbrake` does."""
    result = subprocess.run(
        [sys.executable, "-W", warnings, "-c", f"import sys; sys.argv[0] = '/somewhere/bin/ethbrake'\n{program}"],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )
    return result.returncode, result.stdout, result.stderr


HEAVY = ("numba", "numpy", "scipy", "gymnasium", "torch", "matplotlib")


STARTS = f"""
import os
from typer.main import get_command
from ethbrake_marl.cli.app import app, run_command

def ask(*words):
    status = run_command(words)
    if status or (found := set(sys.modules) & set({HEAVY!r})):
        sys.exit(f"{{words}}, {{dict(os.environ).get('COMP_WORDS')}}: status {{status}}, imported {{found}}")

def ask_each(command, *words):
    ask(*words, "--help")
    for name, inner in getattr(command, "commands", {{}}).items():
        ask_each(inner, *words, name)

ask("--version")
ask_each(get_command(app))
os.environ |= {{"_ETHBRAKE_COMPLETE": "complete_bash", "COMP_WORDS": "ethbrake evaluate --sce", "COMP_CWORD": "2"}}
try:
    ask()
except SystemExit as end:
    sys.exit(end.code or ", ".join(set(sys.modules) & set({HEAVY!r})) or None)
"""


def test_start__version_every_help_and_completion_import_nothing_heavy() -> None:
    status, out, err = ended(STARTS)
    assert (status, err) == (0, "")
    assert out.endswith("\n--scenario\n")
    assert "Train a policy, or the policies of several learners." in out


@pytest.mark.parametrize(
    ("use", "load", "hint"),
    [
        (
            "ethbrake_marl.Scenario",
            "training.recipe import load_recipe as load; name = 'step'",
            "'step' names another kind: shield",
        ),
        (
            "run_command(['scenario', 'show', 'paper-random'])",
            "worlds.catalogue import load_scenario as load; name = 'vine-paper+step'",
            "'vine-paper' names another kind: agent",
        ),
    ],
)
def test_first_use__registers_environments_and_a_hint_knows_names_of_every_kind(use: str, load: str, hint: str) -> None:
    program = f"""
import ethbrake_marl
from ethbrake_marl.cli.app import run_command
assert "gymnasium" not in sys.modules
{use}
assert "EthBrake-v3" in sys.modules["gymnasium"].registry
from ethbrake_marl.{load}
try:
    load(name)
except ValueError as error:
    print(error)
"""
    status, out, err = ended(program)
    assert (status, err) == (0, "") and hint in out


EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]


LINE = "-m pip install 'ethbrake-marl[train]'"


# Runs what the core promises where no package of an extra can be imported.
WITHOUT_EXTRAS = """
import sys
for name in {absent}:
    sys.modules[name] = None
import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import MissingExtra

for name in eb.__all__:
    getattr(eb, name)
help(eb)
eb.env(), eb.parallel_env(), eb.EthBrakeEnv(), eb.EthBrakeVectorEnv(2)
for name in ("train", "resume", "TrainResult", "make_sb3_vec_env", "EthBrakeVecEnv"):
    assert name not in dir(eb) and name not in eb.__all__
    try:
        getattr(eb, name)
    except MissingExtra as error:
        assert str(error).endswith({line!r})
    else:
        sys.exit(f"{{name}} was imported")
lineup = "ppo,ppo+episode,e_v2x_bm"
assert run_command(["evaluate", "--agents", lineup, "--episodes", "20", "--json"]) == 0
assert run_command(["doctor", "speed", "--quick"]) == 2
sys.exit(run_command(["train", "--steps", "1"]))
"""


def test_core__runs_where_no_extra_can_be_imported(tmp_path: Path) -> None:
    program = WITHOUT_EXTRAS.format(absent=sorted(EXTRA_OF), line=LINE)
    status, _, err = ended(program, cwd=tmp_path, warnings="default")
    assert status == 2 and err.splitlines()[-1].endswith(LINE), err
    assert list(tmp_path.iterdir()) == []


def test_missing_extra__names_a_command_of_this_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for installed, command in (("pip", f"{sys.executable} -m pip"), ("", f"uv pip install --python {sys.executable}")):
        monkeypatch.setattr(errors, "find_spec", {installed: object()}.get)
        with refused(f"install it with: {command}", MissingExtra):
            need("torch")


def test_naming_extras__leaves_other_missing_modules_alone() -> None:
    with pytest.raises(ModuleNotFoundError) as caught, naming_extras():
        import_module("no_such_package_of_ours")
    assert not isinstance(caught.value, MissingExtra)


def test_extras__are_those_of_the_table_and_all_is_their_sum() -> None:
    assert {"dev", "docs", "all", *EXTRA_OF.values()} == set(EXTRAS)
    distribution = {
        "stable_baselines3": "stable-baselines3",
        "pygame": "pygame-ce",
        "imageio_ffmpeg": "imageio-ffmpeg",
        "hydra": "hydra-core",
    }
    for package, extra in EXTRA_OF.items():
        names = [re.split(r"[<>=\[]", line)[0] for line in EXTRAS[extra]]
        assert distribution.get(package, package) in map(str.lower, names)
    assert EXTRAS["all"] == [f"ethbrake-marl[{','.join(dict.fromkeys(EXTRA_OF.values()))}]"]
