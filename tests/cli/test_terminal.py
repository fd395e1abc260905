from __future__ import annotations

import io

import pytest
import typer
from rich.console import Console

from ethbrake_marl.cli.command import Commands, Out


def test_progress__without_a_terminal_news_are_lines(capsys):
    out = Out()
    out.progress("training", 0, 1000, {"first_impact_harm": 9.0})
    out.progress("training", 500, 1000, {"first_impact_harm": 9.0})
    out.progress("training", 1000, 1000, {"first_impact_harm": 8.0}, note="stopped")
    out.progress("ppo", 5, 10)
    assert capsys.readouterr().err.splitlines() == [
        "training, first-impact harm 9.00: 0 of 1,000",
        "stopped",
        "training, first-impact harm 8.00: 1,000 of 1,000",
        "ppo: 5 of 10",
    ]


def test_progress__without_a_terminal_every_ten_seconds_bring_a_line_with_the_time_that_is_left(capsys, monkeypatch):
    times = iter((100.0, 105.0, 110.5, 111.0, 121.0))
    monkeypatch.setattr("ethbrake_marl.cli.command.time.monotonic", lambda: next(times))
    out = Out()
    for done in (0, 100, 210, 220, 420):
        out.progress("ppo", done, 1000)
    assert capsys.readouterr().err.splitlines() == [
        "ppo: 0 of 1,000",
        "ppo: 210 of 1,000, about 40 s left",
        "ppo: 420 of 1,000, about 29 s left",
    ]


def test_progress__on_a_terminal_each_part_has_one_bar_above_what_comes_next(monkeypatch, capsys):
    screen, out = io.StringIO(), Out()
    monkeypatch.setattr(out, "_stderr", Console(file=screen, force_terminal=True, width=100))
    out.progress("training", 10, 1000)
    out.progress("training", 1024, 1000)  # a training ends after the update in which its steps are reached
    out.progress("ppo", 5, 10, note="said once")
    bars = out._bars
    assert bars is not None
    assert [(task.description, task.completed, task.total) for task in bars.tasks] == [
        ("training", 1000, 1000),
        ("ppo", 5, 10),
    ]
    assert screen.getvalue().count("said once") == 1
    out.note("written")
    assert bars.finished is False and not bars.live.is_started and out._bars is None
    assert capsys.readouterr().err.endswith("written\n")


def test_command__ctrl_c_is_one_line_and_the_status_of_an_interruption(capsys):
    group = Commands()

    @group.add("wait", "wait", kept="what was found is kept")
    def wait(out: Out) -> None:
        """Wait."""
        raise KeyboardInterrupt

    (registered,) = group.registered_commands
    assert registered.callback is not None
    with pytest.raises(typer.Exit) as raised:
        registered.callback()
    assert raised.value.exit_code == 130
    assert capsys.readouterr().err == "interrupted; what was found is kept\n"
