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
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import MESSAGES, Observer
from ethbrake_marl.episode.plans import COMMANDS, PHASES, PLAN_NUMBERS, PLANS_KEY, PlanMemory, no_plans
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
from ethbrake_marl.motion.layout import FORCE, SPEED, Floats, Ints
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

    def check(self, game: Game, body: int) -> None:
        """Raise ``InvalidInput`` in a game with another time step, in which phases would not end at decisions."""
        if game.settings.time_step_s != self.time_step_s:
            raise InvalidInput(
                f"agent {self.name!r}: was made for decisions every {self.time_step_s:g} s, but scenario {game.name!r}"
                f" has one every {game.settings.time_step_s:g} s; make the agent with this scenario"
            )

    def begin(self, alert: State, body: int) -> PlanMemory:
        return PlanMemory(np.full((alert.n, PLAN_NUMBERS), np.nan), np.full(alert.n, np.inf))

    def act(self, state: State, memory: PlanMemory, body: int) -> tuple[Floats, PlanMemory]:
        force, begun_s, last = state.line[:, FORCE, body], memory.begun_s, no_plans(state)
        begun_s = np.where(np.isinf(begun_s) & (force < -BRAKES_MPS2), state.time_s, begun_s)
        last[:, :, body] = memory.plan
        plans, _ = make_plans(
            state, foresee(self.predictable(state, body), body), last, begun_s, np.array([body]),
            time_step_s=self.time_step_s, phases=self.phases, reaction_s=self.reaction_s, count=self.harm_count,
            candidates=self.candidates,
        )  # fmt: skip
        return plans[:, COMMANDS.start, body].copy(), PlanMemory(plans[:, :, body], begun_s)


def writable(*arrays: Floats) -> list[Floats]:
    """The arrays as kernels need them, which are compiled again for others."""
    return [np.require(array, requirements=("C", "W")) for array in arrays]


def foresee(seen: State, body: int) -> Forecast:
    """The line that a vehicle can predict from what it has ``seen``."""
    require(seen, "a plan", SHOWN)
    forecast, plans = empty_forecast(seen.n, 1, seen.vehicles + 1), seen.memories.get(PLANS_KEY, no_plans(seen))
    line, car, clock, know, plans = writable(seen.line, seen.car, seen.clock, seen.know, plans)
    foresee_worlds(line, car, clock, know, plans, body, forecast)
    return forecast


def make_plans(
    state: State,
    forecast: Forecast,
    last: Floats,
    begun_s: Floats,
    team: Ints,
    *,
    time_step_s: float,
    phases: int,
    reaction_s: float,
    count: HarmCount,
    candidates: int,
) -> tuple[Floats, Floats]:
    """New plans, [n, PLAN_NUMBERS, N + 1], and their costs (``plan_worlds``); ``last``: the last plans.

    ``team``: the vehicle that plans, then others for which it plans, too.

    Raises ``PhysicsError`` if a forecast fails.
    """
    plans, costs, body = last.copy(), np.zeros((state.n, COSTS)), int(team[0])
    (car, clock), moving = writable(state.car, state.clock), state.line[:, SPEED, body] != 0.0
    settings = body, phases, team, time_step_s, reaction_s
    memory, arrays = working_memory(state.vehicles + 1, phases, len(team))
    failed = plan_worlds(
        car,
        clock,
        moving,
        plans,
        begun_s.copy(),
        forecast,
        settings,
        candidates,
        count.weight_array,
        memory,
        arrays,
        costs,
    )
    if failed >= 0:
        raise PhysicsError({failed: f"the forecast of a plan failed before the end of its {FORECAST_S:g} s"})
    return plans, costs


def make_planner(argument: str | None, settings: Any) -> Planner:
    match = ARGUMENT.fullmatch(argument or str(PHASES))
    reaction_s = 0.0 if match is None else float(match["reaction"] or 0.0)
    if match is None or not (match["phases"] or 0.0 < reaction_s <= LONGEST_REACTION_S):
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
