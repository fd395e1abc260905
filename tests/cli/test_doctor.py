"""``ethbrake doctor``: what it finds wrong."""

import json
import re
import sys
from pathlib import Path

import pytest

import ethbrake_marl
from ethbrake_marl import kernel_cache
from ethbrake_marl.cli import doctor
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import EXTRA_OF
from tests.fixtures.commands import Command, told_json


def versions() -> dict[str, tuple[bool, str]]:
    return {name: (ok, detail) for name, ok, detail in doctor._versions()}


def test_doctor__a_sound_installation_is_ok(ethbrake: Command) -> None:
    answer, checks = ethbrake("doctor"), told_json(ethbrake("doctor", "--json"))
    assert (answer.status, answer.err) == (0, "")
    lines = [re.split("  +", line) for line in answer.out.splitlines()[2:]]
    assert [line[:2] for line in lines] == [[check["name"], "OK"] for check in checks]
    assert all(check["ok"] is True for check in checks)
    details = {check["name"]: check["detail"] for check in checks}
    (own,) = ethbrake_marl.__path__
    assert details["ethbrake_marl"] == f"{ethbrake_marl.__version__} in {own}"
    assert details["python"].endswith(f" at {sys.executable}") and {"numpy", "torch"} <= {*details}
    assert details["kernel cache"] == str(kernel_cache.cache_folder())
    assert details["physics"] == "harm of one impact 20 (exact: 20)"


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_doctor__one_failure_gives_exit_status_1(ethbrake: Command, monkeypatch, form: list[str]) -> None:
    monkeypatch.setattr(doctor, "_versions", lambda: [("a", True, "x"), ("b", False, "y")])
    answer = ethbrake("doctor", *form)
    words = [line.split() for line in answer.out.splitlines()]
    assert answer.status == 1 and (["b", "FAIL", "y"] in words) == (not form)


def test_dependencies__too_old_and_missing_ones_are_told(monkeypatch) -> None:
    wanted = ["numpy>=99", "no-such-package>=1", "scipy>=1", 'no-such-extra>=1; extra == "train"']
    monkeypatch.setattr(doctor, "requires", lambda name: wanted)
    ok, told = versions()["numpy"]
    assert not ok and told.endswith("; needs >=99")
    assert versions()["no-such-package"] == (False, "is not installed; needs >=1")
    assert versions()["no-such-extra"] == (True, "is not installed")
    assert versions()["scipy"][0]


def test_extras__are_those_of_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "installing.md").read_text()
    listed = re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)
    assert {*EXTRA_OF.values()} == {*listed} - {"all", "docs"}
    names = [name for name, *_ in doctor._versions()]
    assert {"matplotlib", "optuna"} <= {*names} and "pytest" not in names and names.count("numpy") == 1


def test_physics__another_one_and_one_that_cannot_be_imported_are_findings(ethbrake: Command, monkeypatch) -> None:
    exact = State.harm
    with monkeypatch.context() as patch:
        patch.setattr(State, "harm", lambda state, count: 2.0 * exact(state, count))
        assert doctor._impact() == ("physics", False, "harm of one impact 40 (exact: 20)")
    monkeypatch.setitem(sys.modules, "ethbrake_marl.evaluation.evaluate", None)
    answer = ethbrake("doctor")
    assert answer.status == 1 and re.search("physics +FAIL +ModuleNotFoundError: ", answer.out)


def test_kernel_cache__that_is_damaged_or_of_others_is_named(tmp_path: Path, monkeypatch, ethbrake: Command) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(doctor, "_impact", lambda: ("physics", True, ""))
    folder = tmp_path / "ethbrake_marl"

    def found() -> tuple[bool, str]:
        checks = json.loads(ethbrake("doctor", "--json").out)
        (check,) = (check for check in checks if check["name"] == "kernel cache")
        return check["ok"], check["detail"]

    assert found() == (True, str(folder))
    for name in "abcde":
        kernel_cache.save_data(name, name.encode())
    (folder / "README").write_text("of somebody else")
    assert found() == (True, str(folder))
    (folder / "a.compiled").write_bytes(b"")
    (folder / "b.compiled").unlink()
    (folder / "b.compiled").mkdir()
    (folder / "c.compiled").rename(folder / "f.compiled")
    (folder / "d.compiled").chmod(0o664)
    told = f"{folder}: 4 of its files are damaged or can be written by others; delete it"
    assert found() == (False, told) and kernel_cache.load_data("e", bytes) == b"e"
    folder.chmod(0o770)
    told = f"{folder}: belongs to another user, or others can write to it, so {kernel_cache.UNSTORED}"
    assert found() == (False, told)
