from __future__ import annotations

import io

import pytest
import typer
from rich.console import Console
from rich.progress import Progress

from ethbrake_marl.cli.terminal import Bars, interruptible


def test_bars__without_a_terminal_news_are_lines(capsys):
    bars = Bars(None)
    bars.show("training", 0, 1000, {"first_impact_harm": 9.0})
    bars.show("training", 500, 1000, {"first_impact_harm": 9.0})
    bars.show("training", 1000, 1000, {"first_impact_harm": 8.0}, note="stopped")
    bars.show("ppo", 5, 10)
    assert capsys.readouterr().err.splitlines() == [
        "training, first-impact harm 9.00: 0 of 1,000",
        "stopped",
        "training, first-impact harm 8.00: 1,000 of 1,000",
        "ppo: 5 of 10",
    ]


def test_bars__without_a_terminal_every_ten_seconds_bring_a_line_with_the_time_that_is_left(capsys, monkeypatch):
    times = iter((100.0, 105.0, 110.5, 111.0, 121.0))
    monkeypatch.setattr("ethbrake_marl.cli.terminal.time.monotonic", lambda: next(times))
    bars = Bars(None)
    for done in (0, 100, 210, 220, 420):
        bars.show("ppo", done, 1000)
    assert capsys.readouterr().err.splitlines() == [
        "ppo: 0 of 1,000",
        "ppo: 210 of 1,000, about 40 s left",
        "ppo: 420 of 1,000, about 29 s left",
    ]


def test_bars__on_a_terminal_each_part_has_one_bar():
    screen = io.StringIO()
    with Progress(console=Console(file=screen, force_terminal=True, width=100)) as progress:
        bars = Bars(progress)
        bars.show("training", 10, 1000)
        bars.show("training", 1024, 1000)  # a training ends after the update in which its steps are reached
        bars.show("ppo", 5, 10, note="said once")
        assert [(task.description, task.completed, task.total) for task in progress.tasks] == [
            ("training", 1000, 1000),
            ("ppo", 5, 10),
        ]
    assert screen.getvalue().count("said once") == 1


def test_interruptible__ctrl_c_is_one_line_and_the_status_of_an_interruption(capsys):
    with pytest.raises(typer.Exit) as raised, interruptible("nothing was written"):
        raise KeyboardInterrupt
    assert raised.value.exit_code == 130
    assert capsys.readouterr().err == "interrupted; nothing was written\n"
