"""The feature groups ``plan`` and ``forecast``: the plan that the agent ``plan`` would make if it had none yet."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.commands import actions_of
from ethbrake_marl.episode.counts import HONEST
from ethbrake_marl.episode.features import Feature
from ethbrake_marl.episode.plans import CHANGES, COMMANDS, PHASES, no_plans
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.forecasts.phases import HIGH_TIE, LOW_TIE, OF_BRAKING, OF_CONSTANT, OF_PLAN
from ethbrake_marl.extensions.forecasts.planner import foresee, make_plans
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.registry import Part

CANDIDATES = 9  # without a last plan, six times as many (``phases.FIRST_PLAN``)
LONGEST_S = 4.0  # time to a change of phase that a feature shows
COSTS = {OF_PLAN: "the plan", OF_BRAKING: "full braking", OF_CONSTANT: "the best constant braking"}
SLACK = {LOW_TIE: "strongest", HIGH_TIE: "weakest"}
COST_NAMES = {OF_PLAN: "plan_speed", OF_BRAKING: "brake_speed", OF_CONSTANT: "constant_speed"}

PLAN = (
    Feature("action", "1", 1.0, -1.0, 0.0, "action of the plan now; -1 is full braking"),
    *(
        Feature(f"action_{p + 1}", "1", 1.0, -1.0, 0.0, f"action in phase {p + 1} of the plan")
        for p in range(1, PHASES)
    ),
    *(
        Feature(f"change_{p + 1}", "s", 1.0, 0.0, LONGEST_S, f"time until the end of its phase {p + 1}")
        for p in range(PHASES - 1)
    ),
    *(
        Feature(COST_NAMES[column], "m/s", 10.0, 0.0, 6.0, f"forecast for {held}: square root of the honest cost")
        for column, held in COSTS.items()
    ),
    *(
        Feature(f"{which}_action", "1", 1.0, -1.0, 0.0, f"{which} constant action of least forecast cost")
        for which in SLACK.values()
    ),
)
FORECAST = (Feature("known", "1", 1.0, 0.0, 1.0, "0 if a neighbour of which this vehicle knows cannot be predicted"),)


def _plans(state: State, observers: Ints, time_step_s: float) -> Floats:
    """Features ``plan`` and ``forecast`` before scaling, [n, observers, F].

    Raises ``PhysicsError`` if a forecast fails.
    """
    out = np.empty((state.n, len(observers), len(PLAN + FORECAST)))
    for o, body in enumerate(observers.tolist()):
        plans, costs = make_plans(
            state, foresee(state, body), no_plans(state), np.full(state.n, np.inf), np.array([body]),
            time_step_s=time_step_s, phases=PHASES, reaction_s=0.0, count=HONEST, candidates=CANDIDATES,
        )  # fmt: skip
        plan = np.where(np.isnan(plans[:, :, body]), 0.0, plans[:, :, body])  # an episode has ended
        actions = [actions_of(state, body, command) for command in plan[:, COMMANDS].T]
        changes = np.clip(plan[:, CHANGES] - state.time_s[:, np.newaxis], 0.0, LONGEST_S)
        speeds = np.sqrt(costs[:, list(COSTS)])
        known = np.isfinite(state.know[:, body, body])
        out[:, o] = np.column_stack([*actions, changes, speeds, costs[:, list(SLACK)], known])
    return out


GROUP = Part(PLAN, _plans, slice(0, len(PLAN)))
FORECAST_GROUP = Part(FORECAST, _plans, slice(len(PLAN), None))
