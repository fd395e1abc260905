"""``Terms``: reward terms that the compiled step cannot compute, such as measures, shaping and objectives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ethbrake_marl.first_edition.engine.compiled_step import Step
from ethbrake_marl.first_edition.engine.state import State
from ethbrake_marl.first_edition.game.definition import Game
from ethbrake_marl.first_edition.game.harm import Ledger
from ethbrake_marl.first_edition.game.impacts import EpisodeImpacts
from ethbrake_marl.first_edition.game.measures import BUILT_IN, MEASURES
from ethbrake_marl.first_edition.game.objectives import added_harm
from ethbrake_marl.first_edition.game.reward_vector import RewardVector, components_of, vector_of
from ethbrake_marl.first_edition.game.rewards import Reward, reward_params
from ethbrake_marl.first_edition.game.step_outcome import StepOutcome
from ethbrake_marl.first_edition.physics.state import Floats, Worlds


class Terms:
    """The reward terms that the compiled step cannot compute; ``add`` adds them to the reward of a step.

    An *objective* says whose harm a vehicle's reward includes. If neither the reward nor the scenario has an objective,
    each vehicle's reward includes the harm of the whole line. *Shaping* adds to the reward the change of the vehicle's
    *potential*, a function of the state.

    Args:
        reward: ``harm``, ``total-harm``, ``paper``, a mapping of settings, or ``RewardParams``.
        scenario: scenario whose objective is used if the reward has none.
        learners: indices of the vehicles (0 = front) that learn or, in an evaluation, that the evaluated agent drives.
        vector: components of the vector reward (``game.reward_vector``); None: there is no vector reward.

    In the methods, ``before`` is the harm of each pair from the alert to the beginning of the step, and ``state`` is
    the state after the step.

    """

    def __init__(
        self, reward: Reward, scenario: Game, learners: Sequence[int], vector: RewardVector | None = None
    ) -> None:
        self.params, self._objectives = reward_params(reward).settled(scenario.objective, scenario.vehicles)
        self.components = () if vector is None else components_of(vector, self.params, scenario.vehicles)
        self._learners, self._learner_index = tuple(learners), np.array(learners, np.int64)
        self._built_in = [
            BUILT_IN[name] for name in self.params.counted if name in BUILT_IN and BUILT_IN[name].function
        ]
        registered = [MEASURES[name] for name in self.params.terms]
        self._by_step = [measure for measure in registered if measure.by == "step"]
        self._by_impacts = [measure for measure in registered if measure.by == "impacts"]
        self.count_impacts = bool(self._by_impacts)  # whether a measure of single impacts has a weight
        self.by_objective = bool(self._objectives)  # whether each vehicle has an objective of its own
        self.are_foreign = bool(registered)  # whether some measure was registered by a user, and so may fail
        self.add_something = bool(self._built_in or registered) or self.params.shaping > 0.0 or self.by_objective

    @property
    def shared_harm(self) -> float:
        """Weight of the whole line's harm in the reward that the compiled step computes; 0 if there are objectives."""
        return 0.0 if self._objectives else self.params.harm

    def vector(self, step: Step, before: Ledger, state: State) -> Floats:
        """Return the vector reward of a step, [n, N, K] for K components; 0 if the episode had ended before."""
        vector = vector_of(self.components, state.ledger.since(before), self.params.harm_count, step.terms)
        vector[state.ended & ~step.ended] = 0.0
        return vector

    def add(
        self,
        step: Step,
        state: State,
        scenario: Game,
        before: Ledger | None,
        impacts_before: EpisodeImpacts | None,
        worlds: Worlds | None,
    ) -> State:
        """Add the reward terms of this class to the reward of a step; return the state with the present potentials.

        Episodes that had ended before the step get the reward 0. The fields ``further`` and ``reward`` of ``step``
        change in place. ``before`` is None if there are no objectives. ``impacts_before`` are the impacts from the
        alert to the beginning of the step; None if no reward term is computed from single impacts. ``worlds`` are the
        worlds after the step; None if the reward is not shaped.
        """
        if before is not None and self.params.harm > 0.0:
            step.further["harm"] = -added_harm(before, state.ledger, self.params.harm_count, self._objectives)
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
        """Return the shaping potential of each vehicle, [n, N]; it is 0 for vehicles that do not learn."""
        potentials = np.zeros(worlds.speeds_mps.shape)
        shared = self.params.potential(worlds, self._learners, scenario.horizon_s)
        potentials[:, self._learner_index] = shared[:, np.newaxis]
        return potentials
