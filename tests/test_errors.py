"""What a message may hold: one line, of bounded length, that commands no terminal."""

import pytest
from rich.text import Text

from ethbrake_marl.cli.command import Out, say
from ethbrake_marl.errors import (
    LINE_LIMIT,
    AlreadyExists,
    CorruptBundle,
    InvalidInput,
    UnknownName,
    one_line,
    plain_text,
)


@pytest.mark.parametrize("family", [InvalidInput, UnknownName, AlreadyExists, CorruptBundle])
def test_message__shows_what_would_command_the_terminal(family: type[Exception]) -> None:
    assert str(family("a\x1b[2J \u202egnp\n\x9b b\u2028\ud800")) == r"a\x1b[2J \u202egnp\n\x9b b\u2028\ud800"
    assert str(family("vehicle_2: 7 m/s² is too fast – «mine»")) == "vehicle_2: 7 m/s² is too fast – «mine»"


@pytest.mark.parametrize("long", ["x" * 100_000, "\x1b" * 100_000, "\u202e" * (LINE_LIMIT - 1), "é" * (2 * LINE_LIMIT)])
def test_message__keeps_beginning_and_end_of_what_is_long(long: str) -> None:
    text = str(InvalidInput(f"mine.yaml, line 3: gaps_m = {long}: must be a number"))
    assert text.startswith("mine.yaml, line 3: gaps_m = ") and text.endswith(": must be a number")
    assert f"({len(long) + 46:,} characters)" in text
    assert len(text) <= LINE_LIMIT and text.isprintable()


@pytest.mark.parametrize("text", ["plain", "\x1b[2J", "x" * 5000, "a" * LINE_LIMIT])
def test_one_line__is_the_same_the_second_time(text: str) -> None:
    once = one_line(text)
    assert one_line(once) == once and (once == text) == (text in ("plain", "a" * LINE_LIMIT))
    assert plain_text("a\tb\nc\r", keep="\n\t") == "a\tb\nc\\r"


def test_terminal__every_way_to_it_is_clean(capsys: pytest.CaptureFixture[str]) -> None:
    say("runs/\x1b[2J\nx")
    Out().show("# \u202egnp\n", Text("[/] ppo@\x1b[31m :smile:"), "6\N{NO-BREAK SPACE}m/s²")
    captured = capsys.readouterr()
    assert captured.err == "runs/\\x1b[2J\\nx\n"
    assert captured.out == "# \\u202egnp\n\n[/] ppo@\\x1b[31m :smile:\n6\N{NO-BREAK SPACE}m/s²\n"
