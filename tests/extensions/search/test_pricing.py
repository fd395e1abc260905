"""What profiles cost: by hand, as agents that follow them, in every count and objective; and hashes of worlds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.drive import Team, drive
from ethbrake_marl.episode.objectives import amounts, objectives_of
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.search.best_harm import driven_profiles
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, problem_of
from ethbrake_marl.motion.layout import BRAKE_RATE, FORCE, GAP, LATENCY, MASS, SPEED, Floats
from tests.extensions.proofs.worlds import worlds
from tests.refused import refused

NAMES = (
    "paper-random",
    "paper-random-obstacle",
    "paper-random-buildup",
    "cooperation-3-pair",
    "engineering-queue-ahead",
)


@dataclass
class Follows:
    """Drives one column of profiles."""

    profiles: Profiles
    column: int
    name: str = "follows"
    knows: str = "true model"

    def begin(self, alert: State, body: int) -> Floats:
        return self.profiles.stepwise(100)[:, :, self.column]

    def act(self, state: State, memory: Floats, body: int) -> tuple[Floats, Floats]:
        return memory[np.arange(state.n), state.steps], memory


def problem_in(name: str, n: int = 20, **settings) -> Problem:
    scenario, game = eb.open_game(name)
    return problem_of(game, scenario.sample(n, seed=3), **settings)


def random_profiles(problem: Problem, phases: int = 7, seed: int = 0) -> Profiles:
    rng, n = np.random.default_rng(seed), problem.n
    ends = np.sort(rng.integers(0, 50, (n, phases)), axis=1)
    ends[:, -1] = problem.last_step
    low, high = problem.bounds[:, np.newaxis, :, 0], problem.bounds[:, np.newaxis, :, 1]
    commands = low + rng.random((n, phases, len(problem.bodies))) * (high - low)
    return Profiles(ends, np.where(rng.random(commands.shape) < 0.3, low, commands))


@pytest.mark.parametrize("name", NAMES)
def test_follow__to_the_last_bit_what_agents_do(name: str) -> None:
    scenario, game = eb.open_game(name)
    alert, problem = scenario.sample(20, seed=3), problem_in(name)
    profiles = random_profiles(problem)
    followed = problem.follow(profiles)
    team = Team("follows", {body: Follows(profiles, c) for c, body in enumerate(problem.bodies.tolist())})
    driven = drive(game, alert, team)
    assert followed.line.tobytes() == driven.line.tobytes()
    assert followed.clock[:, :5].tobytes() == driven.clock[:, :5].tobytes() and followed.harm("total").any()
    again = driven_profiles(problem, game, alert, team)
    assert problem.follow(again).line.tobytes() == driven.line.tobytes()


def test_follow__by_hand() -> None:
    """Vehicle 2, 20 m/s and 20 m behind a standing one, brakes with 5 m/s2: w^2 = 400 - 2 * 5 * 20 = 200."""
    _, game = eb.open_game("paper-random")
    problem = problem_of(game, worlds([[20.0, 500.0]], [[0.0, 20.0, 0.0]], 5.0, drive=5.0, restitution=0.0), [2])
    values = problem.values(problem.constant(np.array([[[-5.0], [0.0]]])).take([0]))
    assert values["first"] == pytest.approx([200.0], abs=1e-9) and values["total"] == pytest.approx([200.0], abs=1e-9)
    assert problem.take([0, 0]).values(problem.constant(np.array([[[-5.0], [0.0]]])))["first"][1] == pytest.approx(
        400.0
    )


@pytest.mark.parametrize("objective", ["maximin", "mass-weighted", "weighted:1,4,1", "social:30", "own"])
@pytest.mark.parametrize("count", ["first", "total"])
def test_value__is_the_objective_of_the_controlled_vehicle(objective: str, count: str) -> None:
    problem = problem_in("paper-random-obstacle", objective=objective, count=count)
    last = problem.follow(random_profiles(problem))
    (body,) = problem.bodies.tolist()
    expected = amounts(objectives_of(objective, 3), None, last, count)[:, body - 1]
    assert problem.value(last) == pytest.approx(expected, rel=1e-12) and (problem.value(last) > 0.0).any()


def test_stepwise__and_back() -> None:
    profiles = Profiles(np.array([[2, 2, 4]]), np.array([[[-1.0], [-2.0], [-3.0]]]))
    assert profiles.stepwise(6)[0, :, 0].tolist() == [-1.0, -1.0, -3.0, -3.0, -3.0, -3.0]
    assert Profiles.of_steps(profiles.stepwise(4), np.array([3])).ends.tolist() == [[1, 2, 3, 3]]


# recorded from version 0.5: the shipped tables hold these hashes
IDENTITIES = {
    "paper-random": 0xEA8CDDCC0206331A,
    "paper-random-obstacle": 0xA13E65B184B72DDA,
    "paper-random-buildup": 0xF8DD54C4839C05D1,
    "cooperation-3-pair": 0x19C7100D644821BB,
}


@pytest.mark.parametrize("name", IDENTITIES)
def test_identity__is_that_of_the_tables(name: str) -> None:
    scenario, game = eb.open_game(name)
    assert problem_of(game, scenario.sample(3, seed=7)).identity[0] == IDENTITIES[name]


def test_identity__is_of_everything_that_decides_the_harm_and_of_one_world_alone() -> None:
    scenario, game = eb.open_game("paper-random-buildup")
    alert = scenario.sample(2, seed=7)
    seen = {int(problem_of(game, alert).identity[0])}
    for array, row, body in (
        (alert.line, SPEED, 1),
        (alert.line, GAP, 0),
        (alert.line, FORCE, 3),
        (alert.car, MASS, 2),
        (alert.car, LATENCY, 3),
        (alert.car, BRAKE_RATE, 1),
    ):
        before = array[0, row, body]
        array[0, row, body] = 0.75 * before if 0.0 < before < 1e200 else 12.0
        seen.add(int(problem_of(game, alert).identity[0]))
        array[0, row, body] = before
    others = [{"bodies": [3]}, {"bodies": [2, 3]}]
    seen |= {int(problem_of(game, alert, **each).identity[0]) for each in others}
    seen.add(int(problem_of(game._replace(rules=game.rules._replace(horizon_s=7.0)), alert).identity[0]))
    assert len(seen) == 10
    one = problem_of(game, alert)
    assert (
        problem_of(game, alert.take([1])).identity == one.identity[1] and one.counting("total").identity is one.identity
    )


def wrong(change: Callable[[Profiles], Profiles]) -> Callable[[], object]:
    problem = problem_in("paper-random", 2)
    return lambda: problem.follow(change(random_profiles(problem)))


REFUSED: dict[str, Callable[[], object]] = {
    "ends has the shape (1, 7) and commands_mps2 (1, 7, 1); must be (2, K) and (2, K, 1)": wrong(lambda p: p.take([0])),
    "command 99 m/s2 of vehicle_2 in row 0; must be in [-7, 7] m/s2": wrong(
        lambda p: Profiles(p.ends, p.commands_mps2 * 0 + 99)
    ),
    "profiles: ends must not decrease": wrong(lambda p: Profiles(p.ends[:, ::-1], p.commands_mps2)),
    "vehicles [4]: must be one or more of 1 to 3, each once": lambda: problem_in("paper-random", bodies=[4]),
    "vehicles []: must be one or more of 1 to 3, each once": lambda: problem_in("paper-random", bodies=[]),
    "vehicles [2, 2]: must be one or more of 1 to 3, each once": lambda: problem_in("paper-random", bodies=[2, 2]),
    "objective 'injury:CURVE': is not a weighted sum": lambda: problem_in("paper-random", objective="injury:lr4s"),
    "objective 'own': the 2 controlled vehicles have different objectives": lambda: problem_in(
        "cooperation-3-pair", objective="own"
    ),
    "horizon_s = 0.4: must be after the first decision at 0.5 s": lambda: problem_of(
        (game := eb.open_game("paper-random")[1])._replace(rules=game.rules._replace(horizon_s=0.4)),
        eb.load_scenario("paper-random").sample(1, seed=7),
    ),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_problem__is_refused(message: str) -> None:
    with refused(message):
        REFUSED[message]()
