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
@pytest.mark.parametrize("outside", [False, True])
@pytest.mark.parametrize(("mode", "learners"), [("step", (2,)), ("step", (1, 2)), ("robust:gaps_m.pair_2=0.2", (2,))])
def test_cost_under_a_shield_whose_agents_tell_plans__is_at_most_the_bound(
    channel: str, outside: bool, mode: str, learners: tuple[int, ...]
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
