"""An end after a number of steps is the end of a shorter horizon to messages, another physics, plans and searches."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.play import price
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.extensions.search.pricing import problem_of
from tests.contract.interfaces import PAPER
from tests.faces.test_ends import check_ends, last, told

NEWS = PAPER.replace(
    v2x={"preset": "nominal", "link_latency_s": 0.25, "persistence": "periodic", "tells": ["place", "speed"]}
)


def test_physics_of_another_kind__ends_there_too() -> None:
    paper_map = PAPER.replace(physics="paper-map")
    runs = [
        told(eb.parallel_env(each, reward={"harm": 1, "terminal": 2}, max_cycles=most), 12, ["vehicle_2"])
        for each, most in ((paper_map, 4), (paper_map.replace(horizon_s=0.5 + 4 * 0.1), None))
    ]
    assert str(runs[0]) == str(runs[1])


@pytest.mark.parametrize("steps", [4, 12])
def test_messages__end_there_too(steps: int) -> None:
    eb.register_term("last", last)
    check_ends(NEWS, steps)


def test_plans_and_searches__end_where_the_game_does() -> None:
    env, worlds = eb.parallel_env(PAPER, max_cycles=9), PAPER.sample(20, seed=7)
    shorter = PAPER.replace(horizon_s=0.5 + 9 * 0.1)
    problems = [problem_of(env.game, worlds), problem_of(eb.open_game(shorter)[1], worlds)]
    assert (problems[0].identity == problems[1].identity).all()
    ends = [problem.follow(problem.coasting()) for problem in problems]
    assert ends[0].harm("honest").tolist() == ends[1].harm("honest").tolist()
    state = env.game.reset(worlds)
    assert price(env.game, state, np.zeros((20, 1, 1)), "honest").tolist() == ends[0].harm("honest").tolist()
    best = [
        best_harm(game, worlds, harm_counts=["honest"], budget=50).harm for game in (env.game, eb.open_game(shorter)[1])
    ]
    assert best[0]["honest"].tolist() == best[1]["honest"].tolist()
