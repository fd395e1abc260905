"""Told plans: what scripts hear of a shielded vehicle belongs to the course whose price the shield reports."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import AgentSettings, wrap_team
from ethbrake_marl.episode.counts import HONEST
from ethbrake_marl.episode.plans import COMMANDS, PLAN_NUMBERS, PLANS_KEY, PlanMemory
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import AgentFailed
from ethbrake_marl.motion.layout import BRAKING

SHARES = (1.0, 0.0, 0.6, 0.2)  # of its brakes that a teller uses, one decision after the other
CHANNELS = {"first": {}, "periodic": {"preset": "nominal", "persistence": "periodic"}}


class Teller:
    """Brakes with one share of its brakes after the other, and tells that it will hold the next share."""

    name, knows = "telling", "own sensors"

    def begin(self, alert: State, body: int) -> PlanMemory:
        return PlanMemory(np.full((alert.n, PLAN_NUMBERS), np.nan), np.zeros(alert.n))

    def act(self, state: State, memory: PlanMemory, body: int) -> Any:
        now, later = (np.take(SHARES, state.steps + body + k, mode="wrap") for k in (0, 1))
        plan = np.full((state.n, PLAN_NUMBERS), np.inf)
        plan[:, COMMANDS] = (-later * state.car[:, BRAKING, body])[:, np.newaxis]
        return -now * state.car[:, BRAKING, body], memory._replace(plan=plan)


class Listener:
    """A script that brakes as the vehicle ahead has told that it will, or with three quarters of its brakes."""

    name, knows = "listening", "messages"

    def begin(self, alert: State, body: int) -> None:
        """Remember nothing."""

    def act(self, state: State, memory: None, body: int) -> Any:
        heard, capacity = state.memories[PLANS_KEY][:, COMMANDS.start, body - 1], state.car[:, BRAKING, body]
        return np.maximum(np.where(np.isnan(heard), -0.75 * capacity, heard), -capacity), None


def make_listener(argument: str | None, settings: AgentSettings) -> Listener:
    return Listener()


def line(*learners: int, channel: str = "first") -> eb.Scenario:
    """The line of ``cooperation-4-plans`` with a listener at its rear."""
    eb.register_agent("listening", make_listener)
    roles = {1: "full_brake", 2: "full_brake", 3: "listening"} | dict.fromkeys(learners, "learner")
    scenario = eb.load_scenario("cooperation-4-plans")
    return scenario.replace(
        roles={f"vehicle_{body}": role for body, role in roles.items()}, early_impacts="keep", time_step_s=0.2,
        horizon_s=4.0, v2x={**scenario.v2x.model_dump(exclude_unset=True), **CHANNELS[channel]},
    )  # fmt: skip


def shielded(scenario: eb.Scenario, agent: Any, mode: str) -> eb.Team:
    team = eb.Team("mine", dict.fromkeys(scenario.learners, agent))
    return wrap_team(team, mode, AgentSettings(mode, None, scenario, HONEST))


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize(
    ("mode", "learners", "outside"),
    [("step", (2,), False), ("step", (1, 2), True), ("robust:gaps_m.pair_2=0.2", (2,), False)],
)
def test_cost_under_a_shield_whose_agents_tell_plans__is_at_most_the_bound(
    channel: str, mode: str, learners: tuple[int, ...], outside: bool
) -> None:
    scenario, game = eb.open_game(line(*learners, channel=channel))
    game, rng = shielded(scenario, Teller(), mode).game(game), np.random.default_rng(3)
    state = game.reset(scenario.sample(20, 7))
    first = bound = state.memories["shield"].price.copy()
    while not state.ended.all():
        state, _ = game.step(state, rng.uniform(-1.0, 0.3, (20, len(learners))) if outside else None)
        assert (state.memories["shield"].price <= bound).all()
        bound = state.memories["shield"].price.copy()
    assert (state.harm() <= bound).all() and (bound <= first).all()


@pytest.mark.parametrize("channel", CHANNELS)
def test_policy_that_the_hybrid_chooses__costs_what_the_hybrid_predicted(channel: str) -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")
    scenario, game = eb.open_game(line(2, channel=channel))
    agent = replace(eb.make_agent("plan", scenario=scenario), candidates=50)
    *_, (_, last) = eb.play(game, scenario.sample(40, 7), shielded(scenario, agent, "episode"))
    memory = last.memories["shield"]
    assert memory.chosen.any() and not memory.chosen.all()
    assert (last.harm() == np.minimum(memory.policy_harm, memory.bound_harm)).all()


def test_agents_of_one_shield__hear_each_others_plans() -> None:
    pytest.importorskip("ethbrake_marl.extensions.forecasts")
    scenario, game = eb.open_game("cooperation-4-plans")
    agent, worlds = replace(eb.make_agent("plan", scenario=scenario), candidates=50), scenario.sample(20, 7)
    *_, (_, alone) = eb.play(game, worlds, eb.Team("alone", dict.fromkeys((1, 2, 3), agent)))
    *_, (_, last) = eb.play(game, worlds, shielded(scenario, agent, "step"))
    better = alone.harm() <= last.memories["shield"].first
    assert better.mean() > 0.8 and (last.memories["shield"].replaced[better] == 0).all()
    np.testing.assert_allclose(last.harm()[better], alone.harm()[better], atol=1e-6)


class Says(Teller):
    """Tells one plan from its second decision on, whatever it does."""

    name = "says"

    def __init__(self, plan: list[float]) -> None:
        self.plan = plan

    def act(self, state: State, memory: PlanMemory, body: int) -> Any:
        command, memory = super().act(state, memory, body)
        return command, memory._replace(plan=np.tile(self.plan, (state.n, 1)))


@pytest.mark.parametrize(
    ("kind", "plan"),
    [*((kind, [1.0, 2.0, np.inf, 0.0, 0.0]) for kind in ("agent", "shielded", "script", "function")),
     *(("agent", plan) for plan in (
        [1.0, 2.0, -1.0, np.nan, 0.0], [np.nan, 2.0, -1.0, 0.0, 0.0], [np.nan] * 4 + [0.0], [2.0, 1.0, 0.0, 0.0, 0.0],
        [-np.inf, 1.0, 0.0, 0.0, 0.0], [np.inf, 1.0, 0.0, 0.0, 0.0], [1.0, 2.0, 0.0], ["brake"] * 5))],
    ids=str,
)  # fmt: skip
def test_plan_that_is_none__is_the_fault_of_who_tells_it(kind: str, plan: list[Any]) -> None:
    teller: Any = Says(plan)
    if kind == "function":
        memory = PlanMemory(np.full((4, len(plan)), np.nan), np.zeros(4))
        teller = eb.policy_agent(
            lambda seen, before: (np.zeros(len(seen)), before._replace(plan=np.tile(plan, (len(seen), 1)))),
            name="says", observation=["own"], initial_state=lambda n: memory,
        )  # fmt: skip
    scenario = line(1, 2)
    team = eb.Team("mine", {1: teller, 2: eb.make_agent("coast")})
    if kind == "script":
        eb.register_agent("says", lambda argument, settings: teller)
        scenario = line(2).replace(roles={"vehicle_1": "says", "vehicle_2": "learner", "vehicle_3": "listening"})
        team = eb.Team("mine", {2: eb.make_agent("coast")})
    scenario, game = eb.open_game(scenario)
    with pytest.raises(
        AgentFailed, match=r"says.*vehicle_1: tells the plan .* must be 2 times in order, then 3 finite"
    ):
        list(eb.play(game, scenario.sample(4, 7), eb.shield(team) if kind == "shielded" else team))


def test_told_command__is_clipped_to_the_capacity_of_who_tells_it() -> None:
    features = [f"front_1.plan_command_{phase}" for phase in (1, 2, 3)]
    scenario, game = eb.open_game(line(1, 2), observation=features)
    team = eb.Team("mine", {1: Says([1.0, 2.0, 1e9, -1e9, -1.0]), 2: eb.make_agent("coast")})
    _, state = list(eb.play(game, scenario.sample(4, 7), team))[6]
    shown = 10.0 * game.observe(state, np.array([2]))[0]
    capacities = state.driving_capacity_mps2[:, 0], state.braking_capacity_mps2[:, 0]
    np.testing.assert_allclose(shown, np.stack([capacities[0], -capacities[1], np.full(4, -1.0)], axis=1), rtol=1e-6)
