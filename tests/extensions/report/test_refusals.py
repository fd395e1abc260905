"""What films and figures refuse."""

from collections.abc import Callable

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.report.deceleration import deceleration_curve
from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.film import film
from ethbrake_marl.extensions.report.run_figures import harm_against_total_gap
from ethbrake_marl.extensions.report.seed_curves import SeedCurve
from ethbrake_marl.extensions.report.style import picture_ending
from ethbrake_marl.first_edition.scenario.task import Task
from tests.first_edition.contract.interfaces import CRASH
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")


BRAKE = {"full_brake": eb.make_agent("full_brake")}


def test_film__is_refused() -> None:
    one = CRASH.sample(1, seed=0)
    agents = {str(k): BRAKE["full_brake"] for k in range(99)}
    for words, call in (
        ("99 agents: needs", lambda: film(one.worlds, agents, ".gif", scenario=CRASH)),
        ("must be one of .gif, .mp4, .png", lambda: film(one.worlds, BRAKE, ".svg", scenario=CRASH)),
        ("world has 2 worlds", lambda: film(CRASH.sample(2, seed=0).worlds, BRAKE, ".gif", scenario=CRASH)),
    ):
        with refused(words):
            call()


FIGURES: dict[str, Callable[[], object]] = {
    "exactly one": lambda: deceleration_curve(PAPER.sample(2, 7).worlds, Task(PAPER, (1,))),
    "points": lambda: deceleration_curve(PAPER.sample(1, 7).worlds, Task(PAPER, (1,)), points=1),
    "no evaluated step in common": lambda: SeedCurve.of([{0: 1.0}, {1: 1.0}]),
    "bins": lambda: harm_against_total_gap(eb.evaluate(PAPER.sample(2, 7), BRAKE, scenario=PAPER), bins=0),
    ".png, .svg or .pdf": lambda: picture_ending("map.png.eps"),
    "no records": lambda: trajectories({}),
}


@pytest.mark.parametrize("message", FIGURES)
def test_figure__needs_something_to_draw(message: str) -> None:
    with refused(message):
        FIGURES[message]()
