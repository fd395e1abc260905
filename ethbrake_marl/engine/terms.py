"""``Terms``: reward terms that the compiled step does not know, such as measures, shaping and harm by an objective."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ethbrake_marl.engine.compiled_step import Step
from ethbrake_marl.engine.state import State
from ethbrake_marl.game.definition import Game
from ethbrake_marl.game.impacts import EpisodeImpacts
from ethbrake_marl.game.measures import BUILT_IN, MEASURES
from ethbrake_marl.game.objectives import objective_harm
from ethbrake_marl.game.rewards import Reward, reward_params
from ethbrake_marl.game.step_outcome import StepOutcome
from ethbrake_marl.physics.state import Floats, Worlds


class Terms:
    """The reward of a batch, resolved: what is added to every step beside the terms that all vehicles share.

    Args:
        reward: a name, a mapping of settings, or ``RewardParams``.
        scenario: whose objective holds where the reward names none.
        learners: indices of the vehicles (0 = front) that learn, or that an evaluated agent controls.

    """

    def __init__(self, reward: Reward, scenario: Game, learners: Sequence[int]) -> None:
        self.params, self._objectives = reward_params(reward).settled(scenario.objective, scenario.vehicles)
        self._learners, self._learner_index = tuple(learners), np.array(learners, np.int64)
        self._built_in = [
            BUILT_IN[name] for name in self.params.counted if name in BUILT_IN and BUILT_IN[name].function
        ]
        registered = [MEASURES[name] for name in self.params.terms]
        self._by_step = [measure for measure in registered if measure.by == "step"]
        self._by_impacts = [measure for measure in registered if measure.by == "impacts"]
        self.count_impacts = bool(self._by_impacts)  # a measure of them has a weight
        self.by_objective = bool(self._objectives)  # each vehicle's harm by an objective
        self.are_foreign = bool(registered)  # one is code that somebody registered, and so may fail
        self.add_something = bool(self._built_in or registered) or self.params.shaping > 0.0 or self.by_objective

    @property
    def shared_harm(self) -> float:
        """Weight of the harm of the whole line, which the compiled step counts: 0 where each has its objective."""
        return 0.0 if self._objectives else self.params.harm

    def objective_harm(self, state: State) -> Floats:
        """What the objective of each vehicle makes of the harm so far, [n, N]; only where there are objectives."""
        return objective_harm(state.ledger, self.params.harm_count, self._objectives)

    def add(
        self,
        step: Step,
        state: State,
        scenario: Game,
        before: Floats | None,
        impacts_before: EpisodeImpacts | None,
        worlds: Worlds | None,
    ) -> State:
        """Add what a step has brought to its reward; nothing for rows that stood still. Returns the state after it.

        ``before`` is ``objective_harm`` before the step, None without objectives; ``impacts_before`` are the state's
        before the step; ``worlds`` are those of the state where the reward is shaped, else None.
        """
        if before is not None and self.params.harm > 0.0:
            step.further["harm"] = before - self.objective_harm(state)
        standing = state.ended & ~step.ended
        if self._built_in or self._by_step:
            outcome = self._outcome(step, state, scenario.time_step_s)
            step.further.update({each.name: each.built_in(outcome, self.params) for each in self._built_in})
            counts = ~standing & (step.failed == 0) if self._by_step else None
            step.further.update({each.name: each.of(outcome, counts, state.steps) for each in self._by_step})
        if impacts_before is not None and state.impacts is not None:
            for measure in self._by_impacts:
                step.further[measure.name] = measure.change(impacts_before, state.impacts, state.steps)
        if worlds is not None:  # potentials are 0 where an episode terminated
            old, new = state.potential, self.potentials(worlds, scenario)
            new[step.terminated] = 0.0
            step.further["shaping"] = self.params.shaping_discount * new - old
            state = state._replace(potential=new)
        extra = self.params.weighted_sum(step.further, step.reward.shape)
        extra[standing] = 0.0
        step.reward[:] += extra
        return state

    def _outcome(self, step: Step, state: State, time_step_s: float) -> StepOutcome:
        """What measures by step are computed from."""
        motion, params, column = state.motion, state.params, state.packed.column
        return StepOutcome(
            step.first_impact_harm,
            step.total_harm,
            step.safe_end,
            motion[:, column.gap : column.hit],
            motion[:, column.speed : column.command],
            motion[:, column.command : column.previous],
            motion[:, column.previous : column.gap],
            time_step_s,
            motion[:, column.time],
            params[:, column.braking : column.driving],
            params[:, column.driving : column.latency],
            params[:, column.latency : column.mass],
            params[:, column.mass : column.limit],
            self._learner_index.view(),
        )

    def potentials(self, worlds: Worlds, scenario: Game) -> Floats:
        """Potential of every learner, 0 for other vehicles, [n, N]."""
        potentials = np.zeros(worlds.speeds_mps.shape)
        shared = self.params.potential(worlds, self._learners, scenario.horizon_s)
        potentials[:, self._learner_index] = shared[:, np.newaxis]
        return potentials
