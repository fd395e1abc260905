"""Progress on stderr: on a terminal one line that is updated in place, otherwise a line every ten seconds."""

import sys

import pytest

from ethbrake_marl import progress
from ethbrake_marl.progress import Progress, ShownProgress


def shown(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *, terminal: bool) -> str:
    """What is printed of a task that goes on at a quarter, is done after 12 s, and is followed by another one."""
    seconds = iter([0.0, 4.0, 12.0, 13.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(seconds))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    show = ShownProgress()
    for each in (Progress("worlds", 1000, 4000), Progress("worlds", 2000, 4000), Progress("worlds", 4000, 4000)):
        show(each)
    show(Progress("figures", 0, 2, note="one is\nleft out"))
    show.end()
    return capsys.readouterr().err


def test_progress__is_a_line_every_ten_seconds(monkeypatch, capsys) -> None:
    lines = ["worlds: 1,000 of 4,000", "worlds: 4,000 of 4,000", "one is\\nleft out", ""]
    assert shown(monkeypatch, capsys, terminal=False) == "\n".join(lines)


def test_progress__is_updated_in_place_on_a_terminal(monkeypatch, capsys) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    begin, half, *rest = shown(monkeypatch, capsys, terminal=True).split("\r")
    assert (begin, half) == ("", "[##        ] worlds: 1,000 of 4,000\x1b[K")
    assert rest == [
        "[#####     ] worlds: 2,000 of 4,000, about 8 s left\x1b[K",
        "[##########] worlds: 4,000 of 4,000\x1b[K\none is\\nleft out\n",
        "[          ] figures: 0 of 2\x1b[K\n",
    ]
