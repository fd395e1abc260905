"""Texts of errors and what a terminal is shown."""

import pickle
import re
from pathlib import Path
from typing import Any

import pytest
from rich.text import Text

import ethbrake_marl as eb
from ethbrake_marl.cli.command import Out
from ethbrake_marl.errors import (
    LINE_LIMIT,
    CorruptBundle,
    InvalidInput,
    PhysicsError,
    UnknownName,
    check_whole_number,
    one_line,
    plain_text,
)


def test_control_characters__are_shown_not_sent(capsys: pytest.CaptureFixture[str]) -> None:
    assert plain_text("a\tb\nc\r", keep="\n\t") == "a\tb\nc\\r"
    Out().note("runs/\x1b[2J\nx")
    assert capsys.readouterr().err == "runs/\\x1b[2J\\nx\n"
    Out().show("# \u202egnp\n", Text("[/] ppo@\x1b[31m :smile:"), "6\N{NO-BREAK SPACE}m/s²")
    assert capsys.readouterr().out == "# \\u202egnp\n\n[/] ppo@\\x1b[31m :smile:\n6\N{NO-BREAK SPACE}m/s²\n"


def test_physics_error__lists_a_few_worlds_and_travels_between_processes() -> None:
    error = PhysicsError({k: "broke" for k in range(8)})
    copy = pickle.loads(pickle.dumps(error))
    assert (copy.worlds, str(copy)) == (error.worlds, str(error))
    assert str(copy).endswith("world 3: broke; world 4: broke; and 3 more worlds")


@pytest.mark.parametrize("family", [InvalidInput, CorruptBundle])
def test_message__shows_what_would_command_the_terminal(family) -> None:
    assert str(family("a\x1b[2J \u202egnp\n\x9b b\u2028\ud800")) == "a\\x1b[2J \\u202egnp\\n\\x9b b\\u2028\\ud800"
    assert str(family("vehicle_2: 7 m/s² is too fast – «mine»")) == "vehicle_2: 7 m/s² is too fast – «mine»"


@pytest.mark.parametrize("long", ["\x1b" * 100_000, "\u202e" * (LINE_LIMIT - 1)], ids=["escape", "right to left"])
def test_message__that_is_long_keeps_its_beginning_and_end(long) -> None:
    text = str(InvalidInput(f"mine.yaml, line 3: gaps_m = {long}: must be a number"))
    assert text.startswith("mine.yaml, line 3: gaps_m = ") and text.endswith(": must be a number")
    assert f"({len(long) + 46:,} characters)" in text
    assert len(text) <= LINE_LIMIT and text.isprintable()


@pytest.mark.parametrize(
    ("text", "same"), [("x" * 5000, False), ("a" * LINE_LIMIT, True)], ids=["long", "at the limit"]
)
def test_one_line__is_the_same_the_second_time(text, same) -> None:
    assert (one_line(text) == text) == same
    assert one_line(one_line(text)) == one_line(text)


@pytest.mark.parametrize("value", [True, 1.0, 0, 9])
def test_whole_number__is_in_its_range_and_no_truth_value(value: object) -> None:
    with pytest.raises(InvalidInput, match=r"worlds = .*: must be a whole number in 1\.\.8"):
        check_whole_number("worlds", value, 1, 8)
    check_whole_number("worlds", 8, 1, 8)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: eb.evaluate("ppo+step", "paper-random"), "'ppo' names another kind: agent, recipe"),
        (lambda: eb.make_agent("step"), "'step' names another kind: shield"),
        (lambda: eb.evaluate(measures="pushed", episodes=1), "did you mean 'pushed_m' or 'pushed_mps'?"),
        (lambda: eb.load_scenario("level-0-sensor"), "did you mean 'level-0-sensors'?"),
        (lambda: eb.parallel_env(reward={"comfort": 1.0}), "must be registered first, for instance by --load FILE.py"),
    ],
)
def test_unknown_name__of_something_else_or_with_two_neighbours(call: Any, message: str) -> None:
    with pytest.raises(UnknownName, match=re.escape(message)):
        call()


def test_make_env__is_called_parallel_env() -> None:
    with pytest.raises(AttributeError, match="did you mean 'parallel_env'"):
        eb.make_env  # noqa: B018


USERS_FILE = """\
import json
from pathlib import Path

def missing():
    return Path("model.json").read_text()

def damaged():
    return json.loads("{")

class Odd:
    name, knows = "odd", "own sensors"
    def begin(self, alert, body):
        return None
    def act(self, state, memory, body):
        return json.loads("["), memory
"""


@pytest.mark.parametrize(
    ("name", "message"),
    [("missing", "a relative path begins in the current folder (mine.py, line 5)"), ("Odd", "(mine.py, line 15)")],
)
def test_error_of_a_users_code__names_the_users_line(name: str, message: str, empty_folder: Path) -> None:
    Path("mine.py").write_text(USERS_FILE)
    with pytest.raises(InvalidInput) as raised:
        eb.evaluate("paper-random", f"mine.py:{name}", episodes=1)
    assert str(raised.value).endswith(message)
