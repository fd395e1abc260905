"""Options of the version before: they do what they did, with a warning that names the new one."""

from __future__ import annotations

import json

import pytest
from typer.main import get_command

from ethbrake_marl.cli.app import app
from ethbrake_marl.cli.options import rename_old_options
from ethbrake_marl.errors import OldSpelling


@pytest.mark.parametrize("old", [["--count", "total"], ["--count=total"]])
def test_old_options__do_the_same(ethbrake, old):
    line = ("evaluate", "--agents", "e_v2x_bm", "--episodes", "20", "--json")
    new = ethbrake(*line, "--harm-count", "total")
    with pytest.warns(OldSpelling, match="--count is written --harm-count now"):
        answer = ethbrake(*line, *old)
    assert answer.status == 0
    assert json.loads(answer.out) == json.loads(new.out)


def test_rename_old_options__leaves_everything_else():
    line = ["evaluate", "--agents", "constant:-5", "--counts", "3", "--harm-count=first", "count"]
    assert rename_old_options(line, get_command(app)) == line


def test_old_option__of_a_command_that_never_had_it_is_unknown_without_a_note(ethbrake, tmp_path):
    answer = ethbrake("record", "--output", tmp_path / "x.gif", "--count", "total")
    assert answer.status == 2 and answer.err.count("\n") == 1
    assert "No such option: --count" in answer.err and "written" not in answer.err
