"""No random game breaks an invariant, and each invariant finds a bug that is planted for it."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.episode.counts import HONEST
from ethbrake_marl.episode.reward import Rewarding
from ethbrake_marl.evaluation import statistics
from ethbrake_marl.extensions.proofs import measures
from ethbrake_marl.extensions.search.pricing import problem_of
from ethbrake_marl.extensions.search.tables import shipped_tables
from ethbrake_marl.faces.face import Face
from ethbrake_marl.motion.layout import BRAKING, MOVING
from ethbrake_marl.shields.step import StepShield
from tests import games

# Not yet part of `make test`: three of these tests fail, because the games do not know all that changed since commit
# 6de67c9a3, for which they were written.
pytestmark = [
    pytest.mark.nightly,
    pytest.mark.filterwarnings("ignore::UserWarning"),
]  # many objectives free some impacts
KNOWN = "plan:estimated"  # reads more than it says, until the planner is mended
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def number(request: pytest.FixtureRequest) -> int:
    """``--games N`` plays N games, and a fifth as many with a shield; ``--games-seed`` chooses others."""
    return int(request.config.getoption("games") or (500 if request.config.getoption("all") else 50))


@pytest.mark.parametrize("shielded", [None, True], ids=["any", "shielded"])
def test_no_game_breaks_an_invariant(shielded: bool | None, number: int, request: pytest.FixtureRequest) -> None:
    for index in range(number // 5 if shielded else number):
        drawn = games.draw(request.config.getoption("games_seed"), index, shielded)
        faults = {name: text for name, text in games.broken(drawn).items() if not text.startswith(KNOWN)}
        assert not faults, f"game {index}: {faults}; {games.shrunk(drawn, min(faults))}"


@pytest.mark.slow
def test_optimised_python_plays_the_same_games(number: int) -> None:
    command = [sys.executable, "-O", "-c", f"from tests.games import digest; print(digest(1, {number // 5}))"]
    answer = subprocess.run(command, cwd=ROOT, env={**os.environ}, capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == games.digest(1, number // 5)


def free_motion(step: Any) -> Any:
    def planted(*arguments: Any, **settings: Any) -> Any:
        after, what = step(*arguments, **settings)
        line = after.line.copy()
        line[:, MOVING] = 0.0
        return after._replace(line=line), what

    return planted


BUGS: dict[str, tuple[Any, str, Callable[[Any], Any]]] = {  # invariant -> place of a bug: right -> wrong
    "shield_keeps_its_bound": (StepShield, "bound", lambda right: lambda *given: 0.9 * right(*given)),
    "who_bears": (eb.State, "borne_harm", lambda right: lambda *given: 1.01 * right(*given)),
    "motion_is_charged": (eb.Game, "step", free_motion),
    "knows_no_more": (Held, "act", lambda right: lambda _, state, memory, body: (memory / state.mass_t.sum(1), memory)),
    "same_bits": (eb.State, "take", lambda right: lambda state, rows: right(state, rows[::-1])),
    "least_harm_is_proven": (
        measures, "_bound", lambda right: lambda *given: (bound := right(*given))._replace(harm=bound.harm + 1e6),
    ),
    "doors_agree": (Face, "_rewards", lambda right: lambda *given: 1.01 * right(*given)),
    "rewards_add_up": (Rewarding, "shared", lambda right: lambda *given: dict.fromkeys(right(*given), np.ones(2))),
    "intervals_count_worlds": (statistics, "_mean", lambda right: lambda *given: replace(right(*given), freedom=99.0)),
}  # fmt: skip


@pytest.mark.parametrize("invariant", games.INVARIANTS, ids=lambda invariant: invariant.__name__)
def test_an_invariant_finds_its_bug(invariant: Callable[[Any], None], monkeypatch: pytest.MonkeyPatch) -> None:
    name, (owner, attribute, plant) = invariant.__name__, BUGS[invariant.__name__]

    def is_found(index: int) -> bool:
        drawn = games.draw(2, index, name == "shield_keeps_its_bound")
        if games.broken(drawn, [invariant]):
            return False
        with monkeypatch.context() as planted:
            planted.setattr(owner, attribute, plant(getattr(owner, attribute)))
            return name in games.broken(drawn, [invariant])

    assert any(map(is_found, range(200)))


@pytest.mark.xfail(strict=True, reason="best known commands stand on a knife edge, until they are searched anew")
def test_best_known_commands_can_be_held() -> None:
    """0.01 m/s2 off, with the better sign in each world, they cost at most 1 % more; exact, what the table says."""
    for table in shipped_tables():
        scenario, game = eb.open_game(table.header["scenario"])
        problem = problem_of(game, scenario.sample(500, table.header["list_seed"]))
        known, profiles = table.stored(problem, HONEST)
        braking, costs = problem.state.car[:, BRAKING][:, np.newaxis, problem.bodies], []
        for off in (0.0, -0.01, 0.01):
            held = np.where(profiles.commands_mps2 > 1e-6 - braking, profiles.commands_mps2 + off, -braking)
            costs.append(problem.value(problem.follow(profiles._replace(commands_mps2=np.maximum(held, -braking)))))
        assert np.array_equal(costs[0], known), f"{scenario.name}: another cost than the table's"
        mean, held_mean = known.mean(), np.minimum(*costs[1:]).mean()
        assert held_mean <= 1.01 * mean, f"{scenario.name}: {mean}, and {held_mean} 0.01 m/s2 off"
