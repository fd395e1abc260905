"""Terms of the reward that the compiled step does not know: they need the motion, the future or an objective."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ethbrake_marl.engine.running import Running
from ethbrake_marl.engine.step import Step
from ethbrake_marl.objectives import objective_harm
from ethbrake_marl.physics import Bools, Floats, Worlds
from ethbrake_marl.physics.rows import TIME, command_at, gap_at, params_at, previous_at, speed_at
from ethbrake_marl.rewards import (
    Reward,
    StepOutcome,
    further_terms,
    moving_terms_of,
    own_terms,
    potential,
    registered_terms_of,
    resolved_objective,
    reward_params,
    weighted_sum,
)
from ethbrake_marl.scenario import Scenario


class Terms:
    """The reward of a batch, resolved: what is added to every step beside the terms that all vehicles share.

    Args:
        reward: a name, a mapping of settings, or ``RewardParams``.
        scenario: whose objective holds where the reward names none.
        learners: indices of the vehicles (0 = front) that learn.

    """

    def __init__(self, reward: Reward, scenario: Scenario, learners: Sequence[int]) -> None:
        self.params, self._objectives = resolved_objective(reward_params(reward), scenario.objective, scenario.vehicles)
        self._learners, self._learner_index = tuple(learners), np.array(learners, np.int64)
        self._moving, self._own = moving_terms_of(self.params), registered_terms_of(self.params)
        self._moves_reward = bool(self._moving or self._own)
        self.by_objective = bool(self._objectives)  # each vehicle's harm by an objective
        self.are_foreign = bool(self._own)  # one is code that somebody registered, and so may fail
        self.add_something = self._moves_reward or self.params.shaping > 0.0 or self.by_objective

    @property
    def shared_harm(self) -> float:
        """Weight of the harm of the whole line, which the compiled step counts: 0 where each has its objective."""
        return 0.0 if self._objectives else self.params.harm

    def objective_harm(self, running: Running) -> Floats:
        """What the objective of each vehicle makes of the harm so far, [n, N]; only where there are objectives."""
        return objective_harm(running.ledger, self.params.harm_count, self._objectives)

    def add(self, step: Step, running: Running, before: Floats | None) -> None:
        """Add what a step has brought to its reward; nothing for rows that stood still.

        ``before``: ``objective_harm`` before the step, None without objectives.
        """
        if before is not None and self.params.harm > 0.0:
            step.further["harm"] = before - self.objective_harm(running)
        standing = running.ended & ~step.ended
        if self._moves_reward:
            outcome = self._outcome(step, running)
            step.further.update(further_terms(self._moving, self.params, outcome))
            if self._own:
                counts = ~standing & (step.failed == 0)
                step.further.update(own_terms(self._own, outcome, counts, running.steps))
        if self.params.shaping > 0.0:
            step.further["shaping"] = self._shaping(running, step.terminated)
        extra = weighted_sum(self.params, step.further, step.reward.shape)
        extra[standing] = 0.0
        step.reward[:] += extra

    def _outcome(self, step: Step, running: Running) -> StepOutcome:
        """What terms are computed from: views of the running rows."""
        vehicles, state, params = running.scenario.vehicles, running._state, running._params
        gaps = gap_at(vehicles)
        braking, driving, latency, mass = (
            params[:, params_at(k, vehicles) : params_at(k + 1, vehicles)] for k in range(4)
        )
        return StepOutcome(
            step.first_impact_harm,
            step.total_harm,
            step.safe_end,
            state[:, gaps : gaps + vehicles - 1],
            state[:, speed_at(vehicles) : command_at(vehicles)],
            state[:, command_at(vehicles) : previous_at(vehicles)],
            state[:, previous_at(vehicles) : gaps],
            running.scenario.time_step_s,
            state[:, TIME],
            braking,
            driving,
            latency,
            mass,
            self._learner_index.view(),
        )

    def _shaping(self, running: Running, terminated: Bools) -> Floats:
        """The shaping term [n, N] of this step; keeps the new potentials, which are 0 where an episode terminated."""
        before = running._potential
        running._potential = self.potentials(running.worlds, running.scenario)
        running._potential[terminated] = 0.0
        shaping: Floats = self.params.shaping_discount * running._potential - before
        return shaping

    def potentials(self, worlds: Worlds, scenario: Scenario) -> Floats:
        """Potential of every learner, 0 for other vehicles, [n, N]."""
        potentials = np.zeros(worlds.speeds_mps.shape)
        shared = potential(self.params, worlds, self._learners, scenario.horizon_s)
        potentials[:, self._learner_index] = shared[:, np.newaxis]
        return potentials
