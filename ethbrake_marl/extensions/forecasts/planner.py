"""The agent ``plan``, which follows the plan of ``phases`` and plans anew at every decision.

Its objective, the least impact energy of a line, is that of coordinated brake control with constant commands (Lu, Wang,
Li and Zheng, Mathematical Problems in Engineering 2014, article 192175; Wang, Li, Zheng and Lu, Integrated
Computer-Aided Engineering 22, 2015, pages 171-185), which is ``plan:1``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from ethbrake_marl.episode.counts import HONEST, HarmCount
from ethbrake_marl.episode.departures import SHOWN
from ethbrake_marl.episode.layer import MESSAGES, Observer
from ethbrake_marl.episode.plans import COMMANDS, PHASES, PLAN_NUMBERS, PLANS_KEY, PlanMemory
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.errors import InvalidInput, PhysicsError
from ethbrake_marl.extensions.forecasts.contacts import FORECAST_S
from ethbrake_marl.extensions.forecasts.phases import (
    BRAKES_MPS2,
    COSTS,
    Forecast,
    empty_forecast,
    foresee_worlds,
    plan_worlds,
    working_memory,
)
from ethbrake_marl.motion.layout import FORCE, SPEED, Floats
from ethbrake_marl.registry import Part

CANDIDATES = 500  # of a decision
LONGEST_REACTION_S = 10.0
ARGUMENT = re.compile(r"(?P<phases>[1-3])|reaction=(?P<reaction>\d+(\.\d+)?)", re.ASCII)


@dataclass(frozen=True, kw_only=True)
class Planner(Observer):
    """Brakes as the best plan for what its vehicle can predict; fully if it can predict nobody."""

    time_step_s: float
    phases: int = PHASES
    reaction_s: float = 0.0  # the vehicle behind is foreseen to brake this long after this one; 0: to brake now
    harm_count: HarmCount = HONEST
    candidates: int = CANDIDATES
    name: str = "plan"
    knows: str = MESSAGES

    def begin(self, alert: State, body: int) -> PlanMemory:
        return PlanMemory(np.full((alert.n, PLAN_NUMBERS), np.nan), np.full(alert.n, np.inf))

    def act(self, state: State, memory: PlanMemory, body: int) -> tuple[Floats, PlanMemory]:
        force, begun_s = state.line[:, FORCE, body], memory.begun_s
        begun_s = np.where(np.isinf(begun_s) & (force < -BRAKES_MPS2), state.time_s, begun_s)
        plan, _ = self.plan(state, self.foresee(state, body), memory.plan, begun_s, body)
        return plan[:, COMMANDS.start].copy(), PlanMemory(plan, begun_s)

    def foresee(self, state: State, body: int) -> Forecast:
        seen = self.predictable(state, body)
        require(seen, "a plan", SHOWN)
        forecast = empty_forecast(state.n, 1, state.vehicles + 1)
        plans = seen.memories.get(PLANS_KEY)
        if plans is None:
            plans = np.full((state.n, PLAN_NUMBERS, state.vehicles + 1), np.nan)
        foresee_worlds(seen.line.copy(), seen.car.copy(), seen.clock.copy(), seen.know.copy(), plans, body, forecast)
        return forecast

    def plan(self, state: State, forecast: Forecast, last: Floats, begun_s: Floats, body: int) -> tuple[Floats, Floats]:
        """New plans [n, PLAN_NUMBERS] and their ``costs`` (``plan_worlds``); ``last``: the last plans.

        Raises ``PhysicsError`` if a forecast fails.
        """
        bodies, team = state.vehicles + 1, np.array([body])
        plans, costs = np.full((state.n, PLAN_NUMBERS, bodies), np.nan), np.zeros((state.n, COSTS))
        plans[:, :, body] = last
        settings = body, self.phases, team, self.time_step_s, self.reaction_s
        memory, arrays = working_memory(bodies, self.phases, len(team))
        failed = plan_worlds(
            state.car.copy(), state.clock.copy(), state.line[:, SPEED, body] != 0.0, plans, begun_s, forecast, settings,
            self.candidates, self.harm_count.weights, memory, arrays, costs,
        )  # fmt: skip
        if failed >= 0:
            raise PhysicsError({failed: f"the forecast of a plan failed before the end of its {FORECAST_S:g} s"})
        return plans[:, :, body], costs


def make_planner(argument: str | None, settings: Any) -> Planner:
    match = ARGUMENT.fullmatch(argument or str(PHASES))
    reaction_s = 0.0 if match is None else float(match["reaction"] or 0.0)
    if match is None or reaction_s > LONGEST_REACTION_S:
        raise InvalidInput(
            f"agent {settings.spec!r}: must be plan, plan:1 or plan:2 for fewer phases, or plan:reaction=SECONDS with"
            f" the time, above 0 and at most {LONGEST_REACTION_S:g} s, after which the vehicle behind reacts"
        )
    return Planner(
        time_step_s=settings.needed_scenario().time_step_s,
        phases=int(match["phases"] or PHASES),
        reaction_s=reaction_s,
        harm_count=settings.harm_count,
        name=settings.spec,
    )


AGENT = Part(
    make_planner,
    form="plan[:PHASES]",
    about="at every decision, the plan of up to three phases of constant braking with the least forecast cost",
    knows=MESSAGES,
)
