"""``ethbrake doctor``: what it finds wrong."""

import re
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

import ethbrake_marl
from ethbrake_marl import kernel_cache
from ethbrake_marl.agents import pairwise
from ethbrake_marl.cli import doctor
from ethbrake_marl.cli.doctor import Check, diagnose
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import EXTRA_OF
from ethbrake_marl.worlds import catalogue
from tests.fixtures.commands import Command, told_json


def found(name: str) -> tuple[bool, str]:
    check = next(check for check in diagnose() if check.name == name)
    return check.ok, check.detail


def test_doctor__a_sound_installation_is_ok(ethbrake: Command) -> None:
    answer, checks = ethbrake("doctor"), told_json(ethbrake("doctor", "--json"))
    assert (answer.status, answer.err) == (0, "")
    lines = answer.out.splitlines()
    assert all(line.startswith("OK ") for line in lines) and all(check["ok"] is True for check in checks)
    assert [line.split()[1] for line in lines] == [check["name"].split()[0] for check in checks]
    names = {check["name"] for check in checks}
    assert names >= {"python", "numpy", "torch", "physics", "baseline", "scenarios", "kernel cache"}


def test_doctor__names_the_folders_that_are_used() -> None:
    (own,) = ethbrake_marl.__path__
    assert found("ethbrake_marl")[1] == f"{ethbrake_marl.__version__} in {own}"
    assert found("python")[1].endswith(f" at {sys.executable}")
    assert found("kernel cache")[1] == str(kernel_cache.cache_folder())
    shipped = [entry.path.parent.parent for entry in catalogue.list_scenarios() if entry.shipped]
    assert found("scenarios")[1] == f"{len(shipped)} in {shipped[0]}" and len({*shipped}) == 1


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_doctor__one_failure_gives_exit_status_1(ethbrake: Command, monkeypatch, form: list[str]) -> None:
    checks = [Check("a", True, "x"), Check("b", False, "y")]
    monkeypatch.setattr("ethbrake_marl.cli.doctor.diagnose", lambda: checks)
    answer = ethbrake("doctor", *form)
    assert answer.status == 1 and ("FAIL  b  y" in answer.out) == (not form)


def test_dependencies__too_old_and_missing_ones_are_told(monkeypatch) -> None:
    wanted = ["numpy>=99", "no-such-package>=1", "scipy>=1", 'no-such-extra>=1; extra == "train"']
    monkeypatch.setattr(doctor, "requires", lambda name: wanted)
    assert not found("numpy")[0] and "needs >=99" in found("numpy")[1]
    assert found("no-such-package") == (False, "is not installed; needs >=1")
    assert found("no-such-extra") == (True, "is not installed; needs >=1")
    assert found("scipy")[0]


def test_extras__are_those_of_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "installing.md").read_text()
    listed = re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)
    assert {*EXTRA_OF.values()} == {*listed} - {"all", "docs"}
    names = [check.name for check in doctor._dependencies()]
    assert {"matplotlib", "optuna"} <= {*names} and "pytest" not in names and names.count("numpy") == 1


def test_checks__other_physics_another_optimum_and_a_damaged_folder_are_findings(monkeypatch) -> None:
    exact, optimum = State.harm, pairwise.pairwise

    def shifted(alert, body):
        best = optimum(alert, body)
        return best._replace(deceleration_mps2=best.deceleration_mps2 + 1e-4)

    monkeypatch.setattr(pairwise, "pairwise", shifted)
    assert not found("baseline")[0]
    monkeypatch.setattr(State, "harm", lambda state, count: 2.0 * exact(state, count))
    ok, told = found("physics")
    assert not ok and "harm 40 (exact: 20)" in told
    monkeypatch.setattr(catalogue, "list_scenarios", Mock(side_effect=OSError("gone")))
    assert found("scenarios") == (False, "OSError: gone")


def test_kernel_cache__that_is_damaged_is_named_and_mended(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    folder = tmp_path / "ethbrake_marl"
    assert found("kernel cache") == (True, str(folder))
    for name in "abcd":
        kernel_cache.save_data(name, name.encode())
    (folder / "a.compiled").write_bytes(b"")
    (folder / "b.compiled").unlink()
    (folder / "b.compiled" / "inside").mkdir(parents=True)
    (folder / "c.compiled").rename(folder / "e.compiled")
    (folder / "README").write_text("of somebody else")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", Mock(side_effect=PermissionError))
        patch.setattr(kernel_cache, "TemporaryFile", Mock(side_effect=OSError(30, "Read-only file system")))
        told = f"{folder}: Read-only file system; {kernel_cache.UNSTORED}; damaged files: 3, of which 1 are deleted now"
        assert found("kernel cache") == (False, told)
    assert found("kernel cache") == (True, f"{folder}; damaged files: 2, of which 2 are deleted now")
    assert found("kernel cache") == (True, str(folder))
    assert {path.name for path in folder.iterdir()} == {"d.compiled", "README"} and kernel_cache.load_data(
        "d", bytes
    ) == b"d"
