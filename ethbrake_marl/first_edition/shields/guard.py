"""The guard of mode ``step``: a ``StepShield`` decides, and each step is compared with the shield's prediction."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from enum import IntEnum
from typing import Any

import numpy as np

from ethbrake_marl.errors import InvalidInput, UncertifiedStep, count_of
from ethbrake_marl.first_edition.agents.protocol import Agent
from ethbrake_marl.first_edition.engine.engine import Engine, Ruling
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.shields.comparison import difference, seen_columns
from ethbrake_marl.first_edition.shields.contract import Guarded, ShieldGuard, ShieldMode, why
from ethbrake_marl.first_edition.shields.step import StepShield


class MovingAtHorizon(UserWarning):
    """Warning: a vehicle may still be moving at the horizon; the bound does not cover the time after the horizon."""


class StepGuard(ShieldGuard):
    """Guard of mode ``step``, which certifies or replaces every proposed action.

    Args:
        engine: the engine that gets this guard.
        policies: vehicle index -> policy that is simulated from each alert, and that proposes an action if the caller
            gives no action for the vehicle.
        shield: the shield for the engine's learners, before any episode.
        mode: mode of the shield; the infos report its number.
        where: name with which error messages begin: the function or class that the user called.
        shares: whether the infos contain the harm that each vehicle bears; with a cap, they always contain this harm.
        later_rollouts: whether a rollout of the policy that starts after the alert may certify an action.
        assumed: the worlds at the alert, as the shield assumes them; None: the shield knows the true worlds. Policies
            always observe the true worlds.
        warns: whether to warn once with ``MovingAtHorizon`` if a vehicle would still move at the horizon under the
            first plan.

    """

    def __init__(
        self,
        engine: Engine,
        policies: Mapping[int, Agent],
        shield: StepShield,
        *,
        mode: IntEnum = ShieldMode.STEP,
        where: str = "shield",
        shares: bool = False,
        later_rollouts: bool = True,
        assumed: Worlds | None = None,
        warns: bool = False,
    ) -> None:
        super().__init__(engine, policies, shield, mode=mode, where=where)
        self._several = isinstance(shield.vehicle, tuple)
        self._shares = shares or shield.cap is not None
        self._later_rollouts, self._assumed, self._to_warn = later_rollouts, assumed, warns

    def _started(self, shield: StepShield, alert: Worlds, rows: Ints) -> StepShield:
        if self._assumed is not None and not (rows < self._assumed.n).all():
            raise InvalidInput(
                f"shield: assumed has {count_of(self._assumed.n, 'world')}, but the environment has a row {rows.max()};"
                " assumed must have one world for every row of the environment"
            )
        shield.begin(alert if self._assumed is None else self._assumed.take(rows), rows, self._policies or None)
        moving = int((~shield.memory.settles[rows]).sum())
        if moving and self._to_warn:
            self._to_warn = False
            warnings.warn(
                f"shield: in {moving} of {len(rows)} worlds a vehicle still moves at the horizon"
                f" ({shield.scenario.horizon_s:g} s) under the first plan; the bound does not cover the time after the"
                " horizon; a longer horizon_s gives all vehicles time to come to rest",
                MovingAtHorizon,
                stacklevel=2,
            )
        return shield

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """Let the shield certify or replace the proposals in all worlds whose episodes still run."""
        shield: StepShield = memory.shield
        goes_on, finished = ~running.ended, shield.memory.running.finished  # type: ignore[union-attr]  # it has begun
        worlds = running.worlds if self._policies or self._assumed is not None else None  # computed at each access
        proposed, memories = self._asked(worlds, memory.policies, proposed)
        seen = seen_columns(running.packed)
        after = copy.copy(shield)
        decision = after.decide(
            proposed if self._several else proposed[:, 0],
            seen=seen if self._assumed is None else seen[:, : (3 * seen.shape[1] + 2) // 5],  # without harm
            only=goes_on,
            proposer=self._proposer(memories, worlds) if self._later_rollouts else None,
        )
        applied = decision.applied.reshape(proposed.shape)
        stepped_in: Bools = np.any(decision.intervened.reshape(proposed.shape), axis=1)
        return Ruling(proposed, applied, stepped_in, goes_on & ~finished, decision, Guarded(after, memories))

    def check(self, ruling: Ruling, after: Engine) -> Guarded:
        """Compare the worlds after the step with the shield's prediction; return the guard's memory.

        Raises ``UncertifiedStep`` if a world differs from the prediction. If the shield has assumed worlds, which may
        be wrong, no error is raised, and a world that differs from the prediction becomes distrusted. Worlds in which
        the physics failed are not compared with the prediction.
        """
        memory: Guarded = ruling.memory
        shield: StepShield = memory.shield
        running, distrusted = shield.memory.running, shield.memory.distrusted
        assert running is not None
        wanted = ruling.asked & ~distrusted
        wanted[list(after.roster.failed)] = False
        if (wrong := np.flatnonzero(wanted & (after.steps != running.steps))).size:
            k = int(wrong[0])
            raise UncertifiedStep(
                f"shield: world {k} is at step {after.steps[k]} of its episode, but the shield predicted step"
                f" {running.steps[k]}"
            )
        seen = shield.as_seen(seen_columns(after.packed))
        surprising = wanted & ~shield.expects(seen)
        if not surprising.any():
            return memory
        if self._assumed is None:
            k = int(np.argmax(surprising))
            raise UncertifiedStep(
                f"shield: after this step of world {k}, {difference(running.nominal().states[k], seen[k])}"
            )
        shield = copy.copy(shield)
        shield.memory = shield.memory._replace(distrusted=distrusted | surprising)
        return memory._replace(shield=shield)

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos of a step by name: actions, reason, margin, bound, trusted, settles.

        If the guard reports shares, the infos also contain the harm that each vehicle bears. Each value is a single
        number, or an array with one number per world [n], learner [n, L] or vehicle [n, N].
        """
        shield: StepShield = memory.shield
        infos = self._of_step(ruling) | why(ruling)
        infos |= {"bound_harm": shield.bound, "trusted": ~shield.memory.distrusted, "settles": shield.memory.settles}
        if self._shares:
            infos |= {"own_harm": shield.shares(), "baseline_own_harm": shield.memory.baseline_shares}
        return infos
