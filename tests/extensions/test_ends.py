"""An end after a number of steps is the end of a shorter horizon to messages, another physics, plans and searches."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import HONEST
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.play import price
from ethbrake_marl.episode.shaping import potential
from ethbrake_marl.episode.state import END
from ethbrake_marl.extensions.search.best_harm import best_harm
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.motion.layout import FOREIGN
from tests.contract.interfaces import PAPER
from tests.faces.test_ends import check_ends, last, taken, told

NEWS = PAPER.replace(
    v2x={"preset": "nominal", "link_latency_s": 0.25, "persistence": "periodic", "tells": ["place", "speed"]}
)


def test_physics_of_another_kind__ends_there_too() -> None:
    paper_map = PAPER.replace(physics="paper-map")
    runs = [
        told(
            eb.parallel_env(each, reward={"harm": 1, "harm_count": "first", "terminal": 2}, max_cycles=most),
            12,
            ["vehicle_2"],
        )
        for each, most in ((paper_map, 4), (paper_map.replace(horizon_s=0.5 + 4 * 0.1), None))
    ]
    assert any(taken(runs[0], "cut")) and not any(taken(runs[1], "cut"))
    assert str(runs[0]) == str(runs[1])


@pytest.mark.parametrize("steps", [4, 12])
def test_messages__end_there_too(steps: int) -> None:
    eb.register_term("last", last)
    check_ends(NEWS, steps)


def test_plans_and_searches__end_where_the_game_does() -> None:
    env, worlds = eb.parallel_env(PAPER, max_cycles=9), PAPER.sample(20, seed=7)
    shorter = PAPER.replace(horizon_s=0.5 + 9 * 0.1)
    problems = [problem_of(env.game, worlds), problem_of(eb.open_game(shorter)[1], worlds)]
    assert (problems[0].identity != problems[1].identity).all()
    ends = [problem.follow(problem.coasting()) for problem in problems]
    assert ends[0].harm("total").tolist() == ends[1].harm("total").tolist()
    front, middle, rear = ends[0].speeds_mps.T
    own = front - ends[0].line[:, FOREIGN, 1]  # without what Vehicle 2 has given it
    motion = front**2 - own**2 + np.maximum(middle**2 - own**2, 0.0)
    assert (ends[1].harm("honest") - ends[0].harm("honest")).tolist() == pytest.approx(motion.tolist())
    assert (front > own).any() and (middle > own).any() and (rear > own).any()
    games = env.game, eb.open_game(shorter)[1]
    for game, last_state in zip(games, ends, strict=True):
        state = game.reset(worlds)
        assert price(game, state, np.zeros((20, 1, 1)), "honest").tolist() == last_state.harm("honest").tolist()
        held = hold(state, state.wanted, [2], np.zeros((20, 1, 1)), state.clock[:, END], "honest")[0, :, 0]
        assert held.tolist() == pytest.approx(last_state.harm("honest").tolist())
    settings = [game.settings._replace(harm_count=HONEST) for game in games]
    potentials = [potential(each, game.reset(worlds)) for each, game in zip(settings, games, strict=True)]
    assert (potentials[0] >= potentials[1]).all() and (potentials[0] > potentials[1]).any()
    for count, is_same in (("total", True), ("honest", False)):
        best = [best_harm(game, worlds, harm_counts=[count], budget=50).harm[count] for game in games]
        assert (best[0].tolist() == best[1].tolist()) == is_same and (best[0] <= best[1]).all()
