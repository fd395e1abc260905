"""Kinds of faults that users met, each at the public surface with several inputs of its kind."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from tests.refused import refused

FIRST_USES = """
import threading

import ethbrake_marl as eb

uses = [
    lambda: eb.parallel_env("paper-random"),
    lambda: eb.parallel_env("cooperation-3-pair"),
    lambda: eb.make_agent("ppo"),
    lambda: eb.make_agent("e_v2x_bm", scenario="paper-random"),
    lambda: eb.load_recipe("ppo"),
    lambda: eb.summarise(eb.evaluate("paper-random", "full_brake", episodes=3)),
    lambda: eb.list_scenarios(),
]
failed = []


def call(use):
    try:
        use()
    except Exception as error:
        failed.append(error)


threads = [threading.Thread(target=call, args=(use,)) for use in uses * 2]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert not failed, failed
"""


def test_first_uses__may_come_from_several_threads() -> None:
    subprocess.run([sys.executable, "-c", FIRST_USES], check=True, timeout=300)


HOME = {
    "scenario": lambda: eb.load_scenario("~/x.yaml"),
    "recipe": lambda: eb.load_recipe("~/x.yaml"),
    "policy": lambda: eb.load_policy("~/x"),
    "agent": lambda: eb.make_agent("policy@~/x"),
    "worlds": lambda: eb.read_worlds("paper-random", "~/x.csv"),
    "result": lambda: eb.read_result("~/x.json"),
    "run": lambda: eb.resume("~/x"),
}


@pytest.mark.parametrize("read", HOME.values(), ids=HOME)
def test_tilde__is_the_home_folder(read: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with refused(str(tmp_path / "x"), eb.EthBrakeError):
        read()


def test_tilde__is_the_home_folder_of_what_is_written_and_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "own.py").write_text(
        "import ethbrake_marl as eb\n\ndef gap(game, alert, last):\n    '''Last gap.'''\n    return last.gaps_m[:, 0]\n"
        "\ndef brake():\n    return eb.make_agent('full_brake')\n"
    )
    result = eb.evaluate("paper-random", "~/own.py:brake", episodes=2, measures="~/own.py:gap")
    eb.load_shipped("ppo").save("~/policy")
    (tmp_path / "out").mkdir()
    written = eb.write_results("~/out", eb.summarise(result), result, rows="csv")
    assert [path.parent for path in written] == [tmp_path / "out"] * 2
    assert eb.make_agent("policy@~/policy").name == "policy@~/policy" and not os.path.lexists("~")


@pytest.mark.parametrize(
    "closed", [">&- 2>&-", *(pytest.param(each, marks=pytest.mark.slow) for each in (">&-", "2>&-"))]
)
def test_command__whose_streams_are_closed_does_its_work(closed: str, tmp_path: Path) -> None:
    command = f"'{sys.executable}' -m ethbrake_marl evaluate --episodes 2 --output '{tmp_path}/out' {closed}"
    assert subprocess.run(command, shell=True, check=False, timeout=300).returncode == 0
    assert (tmp_path / "out/results.json").exists()
