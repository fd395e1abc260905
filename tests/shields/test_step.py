"""The step shield: hand cases, its properties, several learners, its own agents, and the seams for extensions."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.agent_names import make_agent, open_game
from ethbrake_marl.agents.policy_agent import LearnedAgent
from ethbrake_marl.agents.scripts import Held
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.counts import COUNTS, HONEST
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.hold import hold
from ethbrake_marl.episode.play import follow_plans, price
from ethbrake_marl.episode.state import END, State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.motion.layout import BRAKING
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.shields.fallbacks import CHANGES, SINGLE_ACTIONS, best_constant, first_plans
from ethbrake_marl.shields.shield import ShieldReason
from ethbrake_marl.shields.step import StepShield, constant
from ethbrake_marl.worlds.user_worlds import worlds_from_state
from tests.shields.attack import LINES, WAYS

NAN = np.nan


def opened(name: str, n: int = 20, seed: int = 7, **options: Any) -> tuple[Game, State]:
    scenario, game = open_game(LINES[name]())
    game = game._replace(shield=StepShield(**options))
    return game, game.reset(scenario.sample(n, seed))


def at(gaps_m: list[float], speeds_mps: list[float]) -> tuple[Game, State]:
    scenario, game = open_game("paper-random")
    game = game._replace(shield=StepShield())
    return game, game.reset(worlds_from_state(scenario, {"gaps_m": gaps_m, "speeds_mps": speeds_mps}))


def step(game: Game, state: State, *proposed: Any) -> State:
    return game.step(state, np.array([proposed], float))[0]


def told(state: State, game: Game) -> dict[str, Any]:
    return game.shield.infos(game, state)


# ------------------------------------------------------------------------------------------------ by hand


def test_far_apart_and_at_rest__everything_is_accepted() -> None:
    game, state = at([500.0, 500.0], [10.0, 10.0, 10.0])
    assert state.memories["shield"].price == [0.0]
    state = step(game, state, 0.0)
    infos = told(state, game)
    assert infos["applied_action"][0, 1] == 0.0 and not infos["intervened"].any()
    assert ShieldReason(int(infos["reason"][0, 1])) in (ShieldReason.PLAN_REMAINS, ShieldReason.SAME_AS_PLAN)
    assert infos["bound_harm"] == [0.0] and infos["margin"][0, 1] == 0.0


def test_close_behind_a_braking_vehicle__driving_is_replaced() -> None:
    game, state = at([3.0, 60.0], [20.0, 20.0, 20.0])
    state = step(game, state, 1.0)
    infos = told(state, game)
    assert infos["reason"][0].tolist() == [-1, ShieldReason.NO_CERTIFICATE, -1]
    assert infos["intervened"][0].tolist() == [False, True, False]
    assert infos["proposed_action"][0].tolist() == [0.0, 1.0, 0.0] and infos["margin"][0, 1] < 0.0
    assert infos["applied_action"][0, 1] == (planned := state.memories["shield"].plan[0, 0, 0])
    assert told(step(game, state, planned), game)["reason"][0, 1] == ShieldReason.SAME_AS_PLAN


def test_nothing_proposed__the_plan_is_followed_and_costs_its_price() -> None:
    game, state = opened("paper")
    plan, bound = state.memories["shield"].plan, state.memories["shield"].price
    expected = price(game, state, plan, "honest")
    while not state.ended.all():
        running = ~state.ended
        state, _ = game.step(state, np.full((20, 1), NAN))
        assert (state.memories["shield"].reason[running] == ShieldReason.NOT_A_NUMBER).all()
    assert (state.harm() == bound).all() and (bound == expected).all()


def test_ended_episodes_are_left_alone() -> None:
    game, state = opened("obstacle", 30)
    while not state.ended.any():
        state, _ = game.step(state, np.ones((30, 1)))
    ended, replaced = state.ended, state.memories["shield"].replaced
    after, _ = game.step(state, np.ones((30, 1)))
    memory = after.memories["shield"]
    assert (memory.reason[ended] == ShieldReason.ENDED).all() and not memory.intervened[ended].any()
    assert (memory.replaced[ended] == replaced[ended]).all() and (memory.replaced[~ended] > replaced[~ended]).any()


def test_at_the_alert_the_bound_is_the_cheapest_first_plan() -> None:
    scenario, game = open_game(LINES["pair"]())
    alert = scenario.sample(10, 7)
    state = game._replace(shield=StepShield()).reset(alert)
    harms = [price(game, state, plan, HONEST) for plan in first_plans(game, alert, state, HONEST)]
    assert len(harms) == 5  # E-V2X-BM of each, the descent, full braking, E-V2X-BM of all; one learner: E-V2X-BM alone
    _, alone = open_game("paper-random")
    assert len(first_plans(alone, alert, state, HONEST)) == 1
    assert (state.memories["shield"].price == np.min(harms, axis=0)).all()
    assert (state.memories["shield"].price <= harms[-2]).all()


@pytest.mark.parametrize("name", ["pair", "five", "build-up, all"])
@pytest.mark.parametrize("count", ["honest", "first"])
def test_the_bound_of_several_learners__is_at_most_the_harm_of_the_team_e_v2x_bm(name: str, count: str) -> None:
    scenario, game = open_game(LINES[name]())
    alert = scenario.sample(60, 7)
    agent = make_agent("e_v2x_bm", scenario=scenario, harm_count=count)
    team = Team("all", dict.fromkeys(scenario.learners, agent))
    bound = game._replace(shield=StepShield(harm_count=count)).reset(alert).memories["shield"].price
    assert (bound <= play_to_end(game, alert, team).harm(count) + 1e-6).all()


# ------------------------------------------------------------------------------------------------ properties


@settings(max_examples=8)
@given(
    name=st.sampled_from(list(LINES)),
    count=st.sampled_from([*COUNTS]),
    way=st.sampled_from(list(WAYS)),
    allowance=st.sampled_from([0.0, 3.0]),
    cap=st.sampled_from([None, "baseline"]),
    seed=st.integers(0, 10_000),
)
def test_harm_is_the_certified_harm(name: str, count: str, way: str, allowance: float, cap: Any, seed: int) -> None:
    game, state = opened(name, 8, seed, harm_count=count, allowance=allowance, cap=cap)
    rng, L, k = np.random.default_rng(seed), len(game.settings.learners), 0
    first, caps, bound = state.memories["shield"].first, state.memories["shield"].caps, told(state, game)["bound_harm"]
    while not state.ended.all():
        state, _ = game.step(state, WAYS[way](rng, k, (8, L)), donate=bool(k % 2))
        infos, k = told(state, game), k + 1
        assert (infos["bound_harm"] <= bound).all()
        bound = infos["bound_harm"].copy()
        shown = ~infos["intervened"] & (infos["reason"] > 0) & (infos["reason"] != ShieldReason.ENDED)
        assert (infos["margin"][shown] >= 0.0).all()
        assert (infos["margin"][infos["reason"] == ShieldReason.NO_CERTIFICATE] < 0.0).all()
    memory = state.memories["shield"]
    assert (state.harm(count) == memory.price).all()
    assert (memory.price <= first + allowance).all() and (first == memory.first).all()
    if cap:
        assert (state.borne_harm(count) <= caps).all() and (infos["own_harm"] == state.borne_harm(count)).all()
        assert (infos["baseline_own_harm"] == caps).all()


def test_a_step_that_does_not_donate_leaves_the_state() -> None:
    game, state = opened("all", 6)
    before = {key: np.copy(value) for key, value in state.memories["shield"]._asdict().items() if value is not None}
    for _ in range(2):
        after, _ = game.step(state, np.full((6, 3), 0.3))
    for key, value in before.items():
        np.testing.assert_array_equal(getattr(state.memories["shield"], key), value)
    again, _ = game.step(state, np.full((6, 3), 0.3), donate=True)
    np.testing.assert_array_equal(again.line, after.line)
    np.testing.assert_array_equal(again.memories["shield"].plan, after.memories["shield"].plan)


def test_rows_do_not_know_of_each_other() -> None:
    game, state = opened("pair", 12)
    proposed = np.random.default_rng(3).uniform(-1.0, 1.0, (12, 2))
    rows = np.array([7, 2, 11])
    whole, part = game.step(state, proposed)[0].take(rows), game.step(state.take(rows), proposed[rows])[0]
    np.testing.assert_array_equal(whole.line, part.line)
    for each, other in zip(whole.memories["shield"], part.memories["shield"], strict=True):
        np.testing.assert_array_equal(each, other)


def test_an_allowance_replaces_less() -> None:
    replaced = []
    for allowance in (0.0, 5.0):
        game, state = opened("paper", 60, allowance=allowance, harm_count="first")
        while not state.ended.all():
            state, _ = game.step(state, np.full((60, 1), -0.2), donate=True)
        replaced.append(state.memories["shield"].replaced.mean())
    assert replaced[1] < 0.9 * replaced[0]


# ------------------------------------------------------------------------------------------------ several learners


def test_one_bad_proposal_does_not_spoil_a_good_one() -> None:
    game, state = opened("pair", 60)
    rng, alone = np.random.default_rng(4), np.zeros(2, np.int64)
    for _ in range(12):
        proposed = rng.uniform(-1.0, 1.0, (60, 2))
        planned = state.memories["shield"].plan[np.arange(60), state.steps]
        state, _ = game.step(state, proposed)
        memory = state.memories["shield"]
        accepted = (memory.reason == ShieldReason.PLAN_REMAINS) | (memory.reason == ShieldReason.CONSTANT)
        assert (memory.applied[accepted] == proposed[accepted]).all()
        for one, other in ((0, 1), (1, 0)):
            rows = accepted[:, one] & (memory.reason[:, other] == ShieldReason.NO_CERTIFICATE)
            assert (memory.margin[rows, one] >= 0.0).all() and (memory.margin[rows, other] < 0.0).all()
            alone[one] += rows.sum()
            if one == 1:  # the plan was not changed before
                assert (memory.applied[rows, 0] == planned[rows, 0]).all()
    assert (alone > 0).all()


@pytest.mark.parametrize("name", ["all"])
def test_proposals_that_are_rejected_together_are_tried_one_by_one_to_the_last_learner(name: str) -> None:
    game, state = opened(name)
    rng, learners = np.random.default_rng(4), len(game.settings.learners)
    rejected, accepted = np.zeros((2, learners), np.int64)
    for _ in range(12):
        proposed, before = rng.uniform(-1.0, 1.0, (20, learners)), state
        state, _ = game.step(state, proposed)
        memory = state.memories["shield"]
        bad = memory.reason == ShieldReason.NO_CERTIFICATE
        accepted += (~bad & bad.any(axis=1, keepdims=True)).sum(axis=0)
        for column in range(learners):
            rows = np.flatnonzero(bad[:, column:].all(axis=1))  # this trial was of the plan that stands
            plans = memory.plan[rows].copy()
            plans[np.arange(len(rows)), before.steps[rows], column] = proposed[rows, column]
            assert (price(game, before.take(rows), plans, HONEST) > memory.price[rows]).all()
            rejected[column] += len(rows)
    assert (rejected > 0).all() and (accepted > 0).all()


# ------------------------------------------------------------------------------------------------ its own agents


def shielded(agent: Any, name: str = "paper", n: int = 40, **options: Any) -> tuple[Any, Any, Team]:
    scenario, game = open_game(LINES[name]())
    drivers = dict.fromkeys(game.settings.learners.tolist(), agent)
    return game, scenario.sample(n, 7), Team("mine", drivers, StepShield(drivers, **options))


def test_a_team_better_than_constants_is_left_alone() -> None:
    game, alert, team = shielded(LearnedAgent(load_shipped("ppo")), harm_count="first")
    last, alone = play_to_end(game, alert, team), play_to_end(game, alert, team._replace(shield=None))
    memory = last.memories["shield"]
    better = alone.harm("first") <= memory.first
    assert better.mean() > 0.9 and (memory.replaced[better] == 0).all()
    np.testing.assert_allclose(last.harm("first")[better], alone.harm("first")[better], atol=1e-6)


def test_an_agent_worse_than_constants_is_held_to_them() -> None:
    game, alert, team = shielded(make_agent("full_brake"))
    last, alone = play_to_end(game, alert, team), play_to_end(game, alert, team._replace(shield=None))
    assert (last.harm() <= alone.harm()).all() and last.harm().mean() < 0.8 * alone.harm().mean()


def test_its_agents_drive_on_after_a_proposal_from_outside() -> None:
    scenario, game = open_game("paper-random")
    guard = StepShield({2: LearnedAgent(load_shipped("ppo"))})
    game = game._replace(shield=guard)
    state, seen, rng = game.reset(scenario.sample(60, 7)), set(), np.random.default_rng(2)
    while not state.ended.all():
        state, _ = game.step(state, rng.uniform(-1.0, 1.0, (60, 1)))
        seen |= set(state.memories["shield"].reason.ravel().tolist())
    assert ShieldReason.POLICY_ROLLOUT in seen
    assert (state.harm() == state.memories["shield"].price).all()


class Wavering:
    """Brakes harder at every decision; its memory is the number of decisions."""

    name, knows = "wavering", "own sensors"

    def begin(self, alert: State, body: int) -> Any:
        return np.zeros(alert.n)

    def act(self, state: State, memory: Any, body: int) -> Any:
        return -np.minimum(memory / 60.0, 1.0) * state.car[:, BRAKING, body], memory + 1.0


@pytest.mark.parametrize("outside", [False, True])
def test_an_agent_that_remembers_is_asked_once_at_every_decision(outside: bool) -> None:
    scenario, game = open_game("paper-random")
    game = game._replace(shield=StepShield({2: Wavering()}))
    state = game.reset(scenario.sample(4, 7))
    for k in range(5):
        state, _ = game.step(state, np.full((4, 1), -0.5) if outside else None)
        assert (state.memories["shield"].agents[2] == k + 1.0).all()
    if not outside:
        np.testing.assert_allclose(state.memories["shield"].proposed, -4 / 60)


def test_agents_propose_where_nobody_else_does() -> None:
    scenario, game = open_game(LINES["pair"]())
    game = game._replace(shield=StepShield(dict.fromkeys([3, 2], Held("full_brake"))))
    state = game.reset(scenario.sample(2, 7))
    state, _ = game.step(state, np.array([[NAN, 0.25], [0.5, NAN]]))
    assert state.memories["shield"].proposed.tolist() == [[-1.0, 0.25], [0.5, -1.0]]


# ------------------------------------------------------------------------------------------------ scripts and seams


def test_a_script_that_reacts_is_asked_in_every_play() -> None:
    """The harm of its first plan is not that of the same plan beside a script that holds its first command."""
    game, state = opened("follower", 40)
    state = game._replace(shield=None).reset(LINES["follower"]().sample(40, 7))
    plan = np.full((40, 90, 1), -1.0)
    deaf, _ = follow_plans(game._replace(scripts={}), state, plan, HONEST)
    heard, harm = follow_plans(game, state, plan, HONEST)
    assert (heard.harm() == harm).all() and (deaf.harm() != harm).any()


def test_with_such_a_script_the_best_constant_actions_are_tried_whatever_their_estimate() -> None:
    game, state = opened("follower", 40)
    shield, plans = game.shield, state.memories["shield"].plan
    tried, estimate = constant(shield, game, state, plans, np.zeros(40), np.full(40, np.inf))
    again, unknown = constant(shield, game, state, plans, np.zeros(40), np.full(40, -1.0))
    assert (again == tried).all() and not estimate.any() and not unknown.any()


@pytest.mark.parametrize("name", ["paper", "all"])
def test_constant_actions_have_the_least_harm_of_all_candidates(name: str) -> None:
    game, state = opened(name, 30)
    learners, rng, unbounded = game.settings.learners, np.random.default_rng(3), np.full(30, np.inf)
    plans, L = rng.uniform(-1.0, 0.2, (30, 4, len(learners))), len(learners)
    state, _ = game.follow(state, plans[:, 0])
    planned = plans[:, [1]]
    candidates = [np.clip(planned + change, -1.0, 0.0) for change in CHANGES]
    for c in range(L if L > 1 else 0):
        for action in SINGLE_ACTIONS:
            candidates.append(planned.copy())
            candidates[-1][:, 0, c] = action
    commands = np.concatenate(candidates, axis=1) * state.braking_capacity_mps2[:, np.newaxis, learners - 1]
    harm = hold(state, state.wanted, learners, commands, state.clock[:, END], HONEST)[0]
    actions, least = best_constant(game, state, plans, HONEST, unbounded)
    assert least.tolist() == harm.min(axis=1).tolist()
    assert (actions == np.stack(candidates)[harm.argmin(axis=1), np.arange(30)]).all()


# ------------------------------------------------------------------------------------------------ refusals

BAD = [
    ({"harm_count": "both"}, "harm_count = 'both'"),
    ({"allowance": -1.0}, "allowance = -1.0"),
    ({"cap": "own"}, "cap = 'own'"),
    ({"drivers": {2: Held("coast"), 3: 4}}, "policy of vehicle_3 = 4"),
]


@pytest.mark.parametrize(("options", "text"), BAD, ids=str)
def test_bad_settings(options: Any, text: str) -> None:
    with pytest.raises(InvalidInput, match=f"^shield: {text}"):
        StepShield(**options)


PROPOSALS = [
    (None, "has no agents"),
    (np.ones((4, 1)), r"shape \(5, 1\)"),
    (np.array([[0.0], [1.1], [0], [0], [0]]), "action of vehicle_2 = 1.1"),
    (np.array([[0.0], [NAN], [0], [0], [-np.inf]]), "action of vehicle_2 = -inf"),
]


@pytest.mark.parametrize(("proposed", "text"), PROPOSALS, ids=range(len(PROPOSALS)))
def test_bad_proposals(proposed: Any, text: str) -> None:
    game, state = opened("paper", 5)
    before = state.memories["shield"].plan.copy()
    with pytest.raises(InvalidInput, match=text):
        game.step(state, proposed, donate=True)
    np.testing.assert_array_equal(state.memories["shield"].plan, before)
    assert not state.steps.any()


def test_agents_for_other_vehicles() -> None:
    scenario, game = open_game("paper-random")
    game = game._replace(shield=StepShield({1: Held("coast")}))
    with pytest.raises(InvalidInput, match="has agents for vehicle_1; must have one for each learner, vehicle_2"):
        game.reset(scenario.sample(2, 7))


def test_the_callers_array_stays_the_callers() -> None:
    game, state = opened("paper", 2)
    proposed = np.array([[0.5], [-0.5]])
    state, _ = game.step(state, proposed)
    proposed[:] = 0.0
    assert state.memories["shield"].proposed.tolist() == [[0.5], [-0.5]]
