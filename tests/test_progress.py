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


@pytest.mark.parametrize("done, left", [(1, ""), (30, ""), (31, ", about 625 s left")])
def test_time_left__is_estimated_from_a_few_per_cent_of_the_work(done: int, left: str, monkeypatch, capsys) -> None:
    seconds = iter([0.0, 20.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(seconds))
    show = ShownProgress()
    show(Progress("training", 0, 1_000))
    capsys.readouterr()
    show(Progress("training", done, 1_000))
    assert capsys.readouterr().err == f"training: {done} of 1,000{left}\n"


@pytest.mark.parametrize(
    ("metrics", "text"),
    [
        ({"updates": 3, "shove_cost": 2.0, "first_impact_harm": 1.0}, "shove cost 2.00"),  # a registered count
        ({"first_impact_harm": 1.0, "total_harm": 2.0}, "first-impact harm 1.00"),
        ({"total_harm": 2.0, "objective": 4.0}, "cost of all 4.00"),
        ({"collision_rate": 0.5}, ""),
    ],
)
def test_harm__is_that_of_the_count_that_is_minimised(metrics: dict[str, float], text: str) -> None:
    objective = "cost of all" if "objective" in metrics else ""
    assert Progress("training", 1, 2, metrics, objective=objective).harm == text


def test_harm__stands_beside_the_step_of_its_measurement(capsys) -> None:
    for steps, text in ((300, "honest cost 4.50"), (0, "honest cost 4.50 at step 0")):
        ShownProgress()(Progress("training", 300, 1_000, {"steps": steps, "honest_cost": 4.5}))
        assert capsys.readouterr().err == f"training: 300 of 1,000, {text}\n"
