"""What profiles cost, by hand and as agents drive them, in every count and objective; and hashes of worlds."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.episode.objectives import Harm, amounts, objectives_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.search.best_harm import driven_profiles
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, beside_braking, problem_of
from ethbrake_marl.motion.layout import BRAKE_RATE, BRAKING, DRIVING, FORCE, GAP, LATENCY, MASS, SPEED
from tests.extensions.proofs.worlds import worlds
from tests.refused import refused


class Wild:
    """Holds each command for three decisions; the commands lie anywhere within the capacities."""

    name, knows = "wild", "true model"

    def begin(self, alert: State, body: int) -> None:
        """Remember nothing."""

    def act(self, state: State, memory: None, body: int) -> Any:
        share = (0.37 * (state.steps // 3) + 0.2 * body) % 1.0
        return share * (state.car[:, BRAKING, body] + state.car[:, DRIVING, body]) - state.car[:, BRAKING, body], memory


def driven(name: str, **settings: Any) -> tuple[Problem, Profiles, State]:
    """A problem, what wild agents drive in it, and the last states of their episodes."""
    scenario, game = eb.open_game(name)
    alert, team = scenario.sample(20, seed=3), Team("wild", dict.fromkeys(scenario.learners, Wild()))
    problem = problem_of(game, alert, **settings)
    return problem, driven_profiles(problem, game, alert, team), play_to_end(game, alert, team)


@pytest.mark.parametrize("body", [3])
def test_beside_braking__one_vehicle_drives_as_alone_although_the_other_decides_earlier(body: int) -> None:
    (_, pair), (one, game) = eb.open_game("cooperation-3-pair"), eb.open_game("cooperation-3-pair", [f"vehicle_{body}"])
    alert = one.sample(20, seed=3)
    together, alone = problem_of(pair, alert), problem_of(game, alert)
    profiles = driven_profiles(alone, game, alert, Team("wild", {body: Wild()}))
    both = together.follow(beside_braking(together, alone, profiles))
    assert both.borne_harm("honest") == pytest.approx(alone.follow(profiles).borne_harm("honest"), abs=1e-9)


@pytest.mark.parametrize("name", ["paper-random-obstacle", "paper-random-buildup", "cooperation-3-pair"])
def test_follow__to_the_last_bit_what_agents_do(name: str) -> None:
    problem, profiles, last = driven(name)
    followed = problem.follow(profiles)
    assert followed.line.tobytes() == last.line.tobytes() and followed.harm("total").any()
    assert followed.clock[:, :5].tobytes() == last.clock[:, :5].tobytes()
    assert 10 < profiles.ends.shape[1] < 30  # one phase for each change


def test_follow__by_hand() -> None:
    """Vehicle 2, 20 m/s and 20 m behind a standing one, brakes with 5 m/s2: w^2 = 400 - 2 * 5 * 20 = 200."""
    game = eb.open_game("paper-random")[1]
    problem = problem_of(game, worlds([[20.0, 500.0]], [[0.0, 20.0, 0.0]], 5.0, drive=5.0, restitution=0.0), [2])
    values = problem.take([0, 0]).values(problem.constant(np.array([[[-5.0], [0.0]]])))
    assert values["first"] == pytest.approx([200.0, 400.0]) and values["total"][0] == pytest.approx(200.0)


@pytest.mark.parametrize("objective", ["maximin", "weighted:1,4,1", "social:30", "own", "weighted:1,1,1000"])
@pytest.mark.parametrize("count", ["total"])
def test_value__is_the_objective_of_the_controlled_vehicle(objective: str, count: str) -> None:
    problem, _, last = driven("paper-random-obstacle", objective=objective, harm_count=count)
    expected = amounts(objectives_of(objective, 3), None, last, HarmCount.of(count))[:, int(problem.bodies[0]) - 1]
    assert problem.value(last) == pytest.approx(expected, rel=1e-12) and (problem.value(last) > 0.0).any()


def test_stepwise__and_back() -> None:
    profiles = Profiles(np.array([[2, 2, 4]]), np.array([[[-1.0], [-2.0], [-3.0]]]))
    assert profiles.stepwise(6)[0, :, 0].tolist() == [-1.0, -1.0, -3.0, -3.0, -3.0, -3.0]
    assert Profiles.of_steps(profiles.stepwise(4), np.array([3])).ends.tolist() == [[1, 2, 3, 3]]


@pytest.mark.parametrize(
    ("name", "identity"),  # recorded from version 0.5: the shipped tables hold these hashes
    [
        ("paper-random", 0xEA8CDDCC0206331A), ("paper-random-obstacle", 0xA13E65B184B72DDA),
        ("paper-random-buildup", 0xF8DD54C4839C05D1), ("cooperation-3-pair", 0x19C7100D644821BB),
    ],
)  # fmt: skip
def test_identity__is_that_of_the_tables(name: str, identity: int) -> None:
    scenario, game = eb.open_game(name)
    assert problem_of(game, scenario.sample(3, seed=7)).identity[0] == identity


def test_identity__is_of_everything_that_decides_the_harm_and_of_one_world_alone() -> None:
    scenario, game = eb.open_game("paper-random-buildup")
    alert = scenario.sample(2, seed=7)
    whole = problem_of(game, alert).identity
    seen = {int(whole[0])}
    for part, row, body in (
        (0, SPEED, 1), (0, GAP, 0), (0, FORCE, 3), (1, MASS, 2), (1, LATENCY, 3), (1, BRAKE_RATE, 1),
    ):  # fmt: skip
        other = alert.take([0, 1])
        before = other[part][0, row, body]
        other[part][0, row, body] = 0.75 * before if 0.0 < before < 1e200 else 12.0
        seen.add(int(problem_of(game, other).identity[0]))
    seen |= {int(problem_of(game, alert, bodies).identity[0]) for bodies in ([3], [2, 3])}
    seen.add(int(problem_of(game._replace(settings=game.settings._replace(horizon_s=7.0)), alert).identity[0]))
    assert len(seen) == 10 and problem_of(game, alert.take([1])).identity == whole[1]


def reacting(vehicle: str) -> eb.Scenario:
    roles = {"vehicle_2": "learner", vehicle: "ppo"}
    return eb.load_scenario("paper-random").replace(early_impacts="keep", roles=roles)


def of(bodies: Any, name: str | eb.Scenario = "paper-random", objective: str = "total") -> Callable[[], object]:
    scenario, game = eb.open_game(name)
    return lambda: problem_of(game, scenario.sample(2, 7), bodies, objective=objective)


def whole(harm: Harm, vehicle: int) -> Any:
    """Harm of the line."""
    return harm.whole


def of_a_registered_objective() -> object:
    eb.register_objective("whole", whole)
    return of(None, objective="whole")()


REFUSED: dict[str, Callable[[], object]] = {
    "command 99 m/s2 of vehicle_2 in row 0; must be in [-7, 7] m/s2": lambda: of([2])().follow(
        of([2])().constant(np.full((2, 1, 1), 99.0))
    ),
    "vehicle_3 is driven by 'ppo', whose commands are not known at the alert": of([2], reacting("vehicle_3")),
    "profiles: ends must not decrease": lambda: of([2])().follow(Profiles(np.array([[9, 3]] * 2), np.zeros((2, 2, 1)))),
    "vehicles [4]: must be one or more of 1 to 3, each once": of([4]),
    "objective 'whole': is not a weighted sum": of_a_registered_objective,
    "objective 'own': the 2 controlled vehicles have different objectives": of(None, "cooperation-3-pair", "own"),
}


@pytest.mark.parametrize("message", REFUSED)
def test_problem__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()
