"""Noisy and false reports, alone and in periodic messages."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.motion.layout import GAP, Floats
from tests.extensions.messages.line import LINE, played, seen_by, stepped
from tests.refused import refused

OLD = {"link_latency_s": 0.2, "senses": "none", "persistence": "periodic"}
PAPER = eb.load_scenario("paper-random").replace(early_impacts="keep")


def reports(**keys: Any) -> dict[str, Any]:
    return {"reports": keys}


def test_bias__is_in_what_others_see_and_nowhere_else() -> None:
    """Vehicle 2 at 18 m/s is 2 m/s slower than Vehicle 1 at 20 m/s, and seems to be 3 m/s slower."""
    listed = ["own.speed", "front_1.closing_speed", "front_1.gap"]
    scenario = LINE.replace(roles={**LINE.roles, "vehicle_1": "coast", "vehicle_3": "coast"})
    (game, state), (true, _) = (played(v2x, listed, scenario=scenario) for v2x in (reports(bias_mps=1.0), "paper"))
    now, then = seen_by(game, state, 2), seen_by(true, state, 2)
    assert then["front_1.closing_speed"] * 10.0 == pytest.approx(-2.0)
    assert now["front_1.closing_speed"] * 10.0 == pytest.approx(-3.0)
    assert (now["own.speed"], now["front_1.gap"]) == (then["own.speed"], then["front_1.gap"])
    assert state.speeds_mps.tolist() == [[20.0, 18.0, 22.0]]
    assert game.seen(state, 2).speeds_mps.tolist() == [[21.0, 18.0, 23.0]]
    assert game.layers[0].hides(state, 2).tolist() == [[False, True, False, True]]


def test_liar__seems_neither_to_brake_nor_to_mean_it() -> None:
    _, game = eb.open_game(LINE.replace(v2x=reports(liar="vehicle_1")))
    state = stepped(game, game.reset(game.draw(1, 7, 0)), -1.0)
    seen = game.seen(state, 2)
    assert state.forces_mps2[0].tolist() == [-6.0, -7.0, 0.0] and state.commands_mps2[0, 0] == -6.0
    assert seen.forces_mps2[0].tolist() == [0.0, -7.0, 0.0] and seen.commands_mps2[0, 0] == 0.0
    assert seen.speeds_mps.tolist() == state.speeds_mps.tolist()
    assert game.seen(state, 1).forces_mps2[0, 0] == -6.0  # it knows itself


def test_noise__is_normal_and_the_same_in_every_batch() -> None:
    scenario = PAPER.replace(v2x=reports(noise_mps=2.0))
    _, game = eb.open_game(scenario)

    def errors(first: int, n: int) -> list[Floats]:
        state, found = game.reset(scenario.sample(n, 7, first=first)), []
        for _ in range(3):
            found.append(game.seen(state, 2).speeds_mps - state.speeds_mps)
            state = stepped(game, state, -0.5)
        return found

    many = errors(0, 5000)
    for error in many:
        assert error[:, 1].tolist() == [0.0] * 5000
        assert error[:, [0, 2]].mean(axis=0) == pytest.approx([0.0, 0.0], abs=0.1)
        assert error[:, [0, 2]].std(axis=0) == pytest.approx([2.0, 2.0], abs=0.08)
    assert abs(np.corrcoef(np.concatenate([many[0], many[1]], axis=1)[:, [0, 2, 3, 5]].T) - np.eye(4)).max() < 0.06
    for error, alone in zip(many, errors(41, 1), strict=True):
        assert error[41].tobytes() == alone[0].tobytes()


def test_noise_of_places__is_in_the_gaps_that_others_see() -> None:
    """Vehicle 2 knows its own place, so its gaps have one error each; that ahead of Vehicle 1 has two for Vehicle 3."""
    v2x = reports(noise_m=0.5, noise_mps=2.0)
    scenario = eb.load_scenario("paper-random-obstacle").replace(early_impacts="keep", v2x=v2x)
    _, game = eb.open_game(scenario)
    many, alone = (game.reset(scenario.sample(n, 7, first=first)) for n, first in ((5000, 0), (1, 41)))
    gaps = {body: game.seen(many, body).line[:, GAP, :3] - many.line[:, GAP, :3] for body in (1, 2, 3)}
    for body, sizes in {1: [0.0, 0.5, 0.5**0.5], 2: [0.5, 0.5, 0.5], 3: [0.5, 0.5**0.5, 0.5]}.items():
        assert gaps[body].mean(axis=0) == pytest.approx([0.0] * 3, abs=0.03)
        assert gaps[body].std(axis=0) == pytest.approx(sizes, abs=0.03)
    assert gaps[2][:, 0] == pytest.approx(-gaps[2][:, 1])  # Vehicle 1 seems as much nearer to the obstacle
    assert game.seen(many, 2).line[41].tobytes() == game.seen(alone, 2).line[0].tobytes()
    speeds = game.seen(many, 2).speeds_mps - many.speeds_mps
    assert abs(np.corrcoef(gaps[2][:, 1], speeds[:, 0])[0, 1]) < 0.06
    later = stepped(game, many, -0.5)
    again = game.seen(later, 2).line[:, GAP, 1] - later.line[:, GAP, 1]
    assert abs(np.corrcoef(gaps[2][:, 1], again)[0, 1]) < 0.06


def test_place_in_a_message__has_one_error_for_all_who_receive_it() -> None:
    """All coast, so a message tells the place for ever; Vehicle 1 is 8 m ahead of Vehicle 2, and 14 m of Vehicle 3."""
    roles = {"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "coast"}
    coasting = LINE.replace(roles=roles, speeds_mps=[20, 20, 20], latency_s=[0, 0.5, 0.5])
    _, game = eb.open_game(coasting.replace(v2x={**OLD, **reports(noise_m=1.0)}))
    state, errors = game.reset(game.draw(1, 7, 0)), []
    for _ in range(8):
        (ahead, behind), both = game.seen(state, 2).gaps_m[0], game.seen(state, 3).gaps_m[0].sum()
        assert state.gaps_m.tolist() == [[8.0, 6.0]]
        assert both - 14.0 == pytest.approx(ahead - 8.0)
        errors.append((ahead - 8.0, behind - 6.0))
        state = stepped(game, state, 0.0)
    assert len({round(ahead, 9) for ahead, _ in errors}) > 4 and np.abs(errors).max() > 0.3


def test_old_message__keeps_its_error_until_the_next() -> None:
    """Messages are 0.2 s old and 0.5 s apart, so some decisions bring no new one: the estimate goes on as before."""
    scenario = LINE.replace(
        v2x={"preset": "nominal", **{key: OLD[key] for key in ("senses", "persistence")}, "senses": "both",
             "sensing_s": [9, 9], "message_period_s": 0.5, "loss_begins": 0.0, "loss_ends": 1.0,
             **reports(noise_mps=1.0)},
        roles={"vehicle_1": "coast", "vehicle_2": "learner", "vehicle_3": "coast"},
    )  # fmt: skip
    _, game = eb.open_game(scenario)
    state, errors, ages = game.reset(game.draw(1, 7, 0)), [], []
    for _ in range(20):
        errors.append(float(game.seen(state, 2).speeds_mps[0, 0]) - 20.0)
        ages.append(float(game.extra_infos(state)["age_s_vehicle_1"][0, 1]))
        state = stepped(game, state, 0.0)
    news = [later < earlier for earlier, later in pairwise(ages)]
    assert any(news) and not all(news)
    for (earlier, later), new in zip(pairwise(errors), news, strict=True):
        assert (earlier != later) == new


def test_liar_in_old_messages__seems_to_go_on_at_its_reported_speed() -> None:
    """Vehicle 1 brakes with 6 m/s2, and its messages are 0.2 s old: it seems 1.2 m/s faster if it hides its braking."""
    speeds = []
    for v2x in (OLD, {**OLD, **reports(liar="vehicle_1")}):
        _, game = eb.open_game(LINE.replace(v2x=v2x))
        state = game.reset(game.draw(1, 7, 0))
        for _ in range(3):
            state = stepped(game, state, 0.0)
        speeds.append(float(game.seen(state, 2).speeds_mps[0, 0] - state.speeds_mps[0, 0]))
    assert speeds == pytest.approx([0.0, 1.2])


def test_physics_and_rewards__have_the_same_bits() -> None:
    games = [eb.open_game(PAPER.replace(v2x=v2x))[1] for v2x in ("paper", reports(noise_mps=3.0, bias_mps=-2.0))]
    states = [game.reset(game.draw(50, 7, 0)) for game in games]
    for _ in range(12):
        steps = [game.step(state, np.full((50, 1), -0.3)) for game, state in zip(games, states, strict=True)]
        states = [after for after, _ in steps]
        assert steps[0][1].reward.tobytes() == steps[1][1].reward.tobytes()
        assert [array.tobytes() for array in states[0][:5]] == [array.tobytes() for array in states[1][:5]]


class Follows:
    """Brakes the more, the faster the vehicle ahead seems to be slower."""

    name = "follows"

    def __init__(self, knows: str) -> None:
        self.knows = knows

    def begin(self, alert: State, body: int) -> None:
        """Remember nothing."""

    def act(self, state: State, memory: None, body: int) -> Any:
        return -np.clip(state.speeds_mps[:, body - 1] - state.speeds_mps[:, body - 2], 0.0, 5.0), memory


@pytest.mark.parametrize(("knows", "differ"), [("messages", True), ("own sensors", True), ("true state", False)])
def test_agent__acts_on_reports_if_it_uses_sensors_and_messages(knows: str, differ: bool) -> None:
    harm = [
        eb.evaluate(PAPER.replace(v2x=v2x), {"mine": Follows(knows)}, episodes=20)["mine"]["total_harm"]
        for v2x in ("paper", reports(bias_mps=-3.0))
    ]
    assert (harm[0] != harm[1]).any() == differ


def test_bound_of_the_step_shield__holds_because_it_knows_the_true_model() -> None:
    scenario, game = eb.open_game("messages-noisy")
    team = eb.make_agent("ppo+step", scenario=scenario)
    states = [state for _, state in eb.play(game, scenario.sample(200, 7), team)]
    bounds = states[0].memories["shield"].price
    assert (states[-1].harm("first") <= bounds + 1e-9).all() and (bounds > 0.0).any()
    assert states[-1].memories["shield"].replaced.sum() > 100


def v2x(**keys: Any) -> Any:
    return lambda: LINE.replace(v2x=reports(**keys))


REFUSED: dict[str, Any] = {
    "v2x.reports = {}: must set noise_mps, noise_m, bias_mps or liar": v2x(),
    "v2x.reports.nois_mps: unknown key; did you mean noise_mps (metres per second)?": v2x(nois_mps=1.0),
    "v2x.reports.noise_mps = -1: must be greater than or equal to 0": v2x(noise_mps=-1),
    "v2x.reports.noise_mps = 0: has no effect; leave it out": v2x(noise_mps=0),
    "v2x.reports.noise_m = 0: has no effect; leave it out": v2x(noise_m=0),
    "v2x.reports.noise_m = 51: must be less than or equal to 50": v2x(noise_m=51),
    "v2x.reports.bias_mps = .nan: must be a finite number": v2x(bias_mps=float("nan")),
    "v2x.reports.bias_mps = true: must be a number": v2x(bias_mps=True),
    "v2x.reports.liar = 1: must be text": v2x(liar=1),
    "v2x.reports.liar = vehicle_7: unknown vehicle; ": v2x(liar="vehicle_7"),
    "it is random what the vehicles learn about each other": lambda: eb.worlds_from_table(
        v2x(noise_m=1.0)(), {"gap_1_m": [9.0]}
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_reports__are_checked(message: str) -> None:
    with refused(message):
        REFUSED[message]()
