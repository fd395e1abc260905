"""What films and figures refuse."""

from collections.abc import Callable
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.deceleration import deceleration_curve
from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.film import film_bytes, film_scenes
from ethbrake_marl.extensions.report.harm_figures import harm_by_agent
from ethbrake_marl.extensions.report.run_figures import harm_against_total_gap, learning_curve
from ethbrake_marl.extensions.report.seed_curves import SeedCurve, seed_curves
from ethbrake_marl.extensions.report.style import picture_ending
from ethbrake_marl.scenario.task import Task
from tests.contract.interfaces import CRASH
from tests.refused import refused

PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")


BRAKE = {"full_brake": eb.make_agent("full_brake")}


@pytest.fixture(scope="module")
def scene() -> Any:
    return film_scenes(CRASH.sample(1, seed=0).worlds, eb.make_agent("full_brake"), scenario=CRASH)[:1]


@pytest.mark.parametrize(
    ("films", "message"),
    [
        (lambda scene: film_bytes({"a": scene}, ".gif", fps=30), "film_bytes: fps = 30: 100 must be a multiple of fps"),
        (lambda scene: film_bytes({}, ".gif"), "film_bytes: there are no scenes; give at least one film"),
        (
            lambda scene: film_bytes({str(k): scene for k in range(13)}, ".gif"),
            "film: 13 agents are too many; give at most 12 agents",
        ),
        (
            lambda scene: film_bytes({str(k): scene * 5000 for k in range(2)}, ".gif"),
            "film of 2 agents for 200 s: the film needs 10,000 pictures, but at most 2,500 are allowed",
        ),
    ],
    ids=["rate", "none", "too many", "too long"],
)
def test_film__is_refused(films: Callable[[Any], bytes], message: str, scene: Any) -> None:
    with refused(message):
        films(scene)


FIGURES: dict[str, Callable[[], object]] = {
    "deceleration_curve: world has 2 worlds; give exactly one": lambda: deceleration_curve(
        PAPER.sample(2, 7).worlds, Task(PAPER, (1,))
    ),
    "deceleration_curve: points = 1: the number of points must be at least 2": lambda: deceleration_curve(
        PAPER.sample(1, 7).worlds, Task(PAPER, (1,)), points=1
    ),
    "SeedCurve.of: the training runs have no evaluated step in common": lambda: SeedCurve.of([{0: 1.0}, {1: 1.0}]),
    "seed_curves: a quantity has no curves": lambda: seed_curves({"harm": {}}),
    "harm_by_agent: there are no rows; give the summary of at least one agent": lambda: harm_by_agent([]),
    "learning_curve: there are no points; give at least one evaluation": lambda: learning_curve([]),
    "harm_against_total_gap: bins = 0: the number of bins must be at least 1": lambda: harm_against_total_gap(
        eb.evaluate(PAPER.sample(2, 7), BRAKE, scenario=PAPER), bins=0
    ),
    "agent 'ppo' was not evaluated; evaluated agents: full_brake": lambda: harm_against_total_gap(
        eb.evaluate(PAPER.sample(2, 7), BRAKE, scenario=PAPER), agents=["ppo"]
    ),
    "map.png.eps: the name of a picture file must end in .png, .svg or .pdf": lambda: picture_ending("map.png.eps"),
    "trajectories: there are no records": lambda: trajectories({}),
}


@pytest.mark.parametrize("message", FIGURES)
def test_figure__needs_something_to_draw(message: str) -> None:
    with refused(message):
        FIGURES[message]()
