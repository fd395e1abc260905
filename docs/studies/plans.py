"""What parts of a plan are worth: phases, candidates, told plans, a joint plan, possible lines, and a network on top.

    python docs/studies/plans.py
    python docs/studies/plans.py --policy runs/on-top
    python docs/studies/plans.py --time

Prints mean honest costs, and paired differences with 95 % intervals over worlds. A joint plan is one for all learners,
of which each learner applies its own part. ``--policy`` compares a trained policy, too. ``--time`` prints the processor
time of a decision instead.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.agent_names import make_teams
from ethbrake_marl.agents.team import Team, play_to_end
from ethbrake_marl.episode.plans import COMMANDS, no_plans
from ethbrake_marl.errors import EthBrakeError
from ethbrake_marl.extensions.forecasts.planner import Planner, foresee, make_plans

ONE = ("paper-random", "paper-random-obstacle", "realistic-truck", "benchmark-truck", "stress-wide")
SEVERAL = (
    "cooperation-4-all",
    "cooperation-4-five",
    "cooperation-3-pair",
    "benchmark-blocked",
    "cooperation-4-congested",
)
HIDDEN = ("cooperation-1-front", "cooperation-2-blocked", "benchmark-noisy", "benchmark-blocked")
PIECES = ("place", "speed", "acceleration", "braking_capacity", "latency", "mass")
WORLDS, SEED = 300, 111
CANDIDATES = (20, 50, 150, 500)
BATCHES = {1: 40, 200: 200}  # worlds together -> worlds in which decisions are timed


@dataclass(frozen=True, kw_only=True)
class JointPlanner(Planner):
    """Plans for its own vehicle and all other learners. Its memory is the plans of all, [n, PLAN_NUMBERS, N + 1]."""

    learners: tuple[int, ...] = ()

    def begin(self, alert: eb.State, body: int) -> Any:
        return no_plans(alert)

    def act(self, state: eb.State, memory: Any, body: int) -> tuple[Any, Any]:
        team = np.array([body, *(other for other in self.learners if other != body)])
        plans, _ = make_plans(
            state, foresee(self.predictable(state, body), body), memory, np.full(state.n, np.inf), team,
            time_step_s=self.time_step_s, phases=self.phases, reaction_s=0.0, count=self.harm_count,
            candidates=self.candidates,
        )  # fmt: skip
        return plans[:, COMMANDS.start, body].copy(), plans


@dataclass(frozen=True, kw_only=True)
class TimedPlanner(Planner):
    """Notes the processor time of a decision, mean over worlds (s)."""

    spent_s: list[float] = field(default_factory=list)

    def act(self, state: eb.State, memory: Any, body: int) -> tuple[Any, Any]:
        begin = time.process_time()
        acted = super().act(state, memory, body)
        self.spent_s.append((time.process_time() - begin) / state.n)
        return acted


def time_of_decisions() -> None:
    scenario, game = eb.open_game("paper-random")
    for candidates in CANDIDATES:
        for together, number in BATCHES.items():
            planner = TimedPlanner(time_step_s=scenario.time_step_s, candidates=candidates)
            worlds = scenario.sample(number, SEED)
            for first in range(0, number, together):
                play_to_end(game, worlds.take(slice(first, first + together)), Team("plan", {2: planner}))
            mean, median = (1e6 * function(planner.spent_s) for function in (np.mean, np.median))
            print(f"{candidates} candidates, {together} worlds together: mean {mean:.0f} us, median {median:.0f} us")


def costs(scenario: eb.Scenario, worlds: eb.State, agent: Any) -> np.ndarray:
    _, game = eb.open_game(scenario)
    team = (
        make_teams(agent, scenario)[agent]
        if isinstance(agent, str)
        else Team("team", dict.fromkeys(scenario.learners, agent))
    )
    return np.asarray(play_to_end(game, worlds, team).harm("honest"))


def telling(scenario: eb.Scenario) -> eb.Scenario:
    channel = scenario.v2x.model_dump(exclude_none=True)
    return scenario.replace(v2x={**channel, "tells": [*PIECES, "plan"]})


def show(name: str, known: dict[str, np.ndarray], base: str) -> None:
    for label, values in known.items():
        text = f"{name:24} {label:28} {values.mean():8.3f}"
        if label != base:
            difference = values - known[base]
            half = 1.96 * difference.std(ddof=1) / np.sqrt(len(difference))
            low, high = difference.mean() - half, difference.mean() + half
            text += f"   minus {base}: {difference.mean():+.3f} [{low:+.3f}, {high:+.3f}]"
        print(text, flush=True)


def one_learner(policy: str | None) -> None:
    for name in ONE:
        scenario = eb.load_scenario(name)
        worlds, plan = scenario.sample(WORLDS, SEED), eb.make_agent("plan", scenario=scenario)
        known = {
            agent: costs(scenario, worlds, agent) for agent in ("full_brake", "e_v2x_bm", "plan:1", "plan:2", "plan")
        }
        for candidates in (20, 50, 150):
            known[f"plan, {candidates} candidates"] = costs(scenario, worlds, replace(plan, candidates=candidates))
        if policy is not None:
            known["a network on top"] = costs(scenario, worlds, f"policy@{policy}")
        show(name, known, "plan")


def several_learners() -> None:
    for name in SEVERAL:
        scenario = eb.load_scenario(name)
        worlds, plan = scenario.sample(WORLDS, SEED), eb.make_agent("plan", scenario=scenario)
        told = telling(scenario)
        joint = JointPlanner(time_step_s=scenario.time_step_s, learners=tuple(scenario.learners))
        known = {
            "e_v2x_bm": costs(scenario, worlds, "e_v2x_bm"), "plan": costs(scenario, worlds, "plan"),
            "plan:1, told": costs(told, told.sample(WORLDS, SEED), "plan:1"),
            "plan, told": costs(told, told.sample(WORLDS, SEED), replace(plan, name="told")),
            "joint plan": costs(scenario, worlds, joint),
        }  # fmt: skip
        show(name, known, "plan")


def hidden_values() -> None:
    paper = eb.load_scenario("cooperation-2-paper")
    alone = {"no mass told": paper.replace(v2x={"preset": "nominal", "tells": PIECES[:-1]})}
    alone["alert only"] = paper.replace(v2x={"preset": "nominal", "senses": "front", "tells": []})
    for name, scenario in {**{name: eb.load_scenario(name) for name in HIDDEN}, **alone}.items():
        worlds = scenario.sample(WORLDS, SEED)
        show(
            name, {agent: costs(scenario, worlds, agent) for agent in ("full_brake", "plan", "plan:estimated")}, "plan"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", help="run of a network on top of the plan")
    parser.add_argument("--time", action="store_true", help="print the processor time of a decision instead")
    given = parser.parse_args()
    if given.time:
        time_of_decisions()
        parser.exit()
    try:
        one_learner(given.policy)
        several_learners()
        hidden_values()
    except (EthBrakeError, OSError) as error:
        parser.exit(2, f"{parser.prog}: error: {error}\n")
