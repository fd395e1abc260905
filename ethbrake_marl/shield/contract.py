"""The contract of every shield.

An engine asks its guard inside ``Engine.step``, once for all n worlds and L learners:

    decide(state, memory, proposed) -> (applied, memory, info)

``state``     the engine with its running episodes; a guard reads it, and changes nothing.
``memory``    what the guard remembers of these episodes: a value, never changed in place.
``proposed``  actions [n, L] in [-1, 1]; NaN is no number, a column of NaN is no proposal at all.
``applied``   actions [n, L]: the engine makes its step with these.
``memory``    what the guard will remember once the step is made.
``info``      what there is to say about the decision: it stands in the infos as ``shield_...``.

The answer is a ``Ruling`` (``engine.engine``), which holds all three. After the step, ``check`` compares the new state
with the promised one. ``UncertifiedStep`` undoes the step: the engine keeps its worlds and the old memory.

``begin`` starts episodes in some rows, and ``report`` gives the infos. ``ShieldGuard`` does what is the same in every
mode: it asks the policies that propose, keeps their memories, and lays out the infos by vehicle. A mode adds its
decision: ``paper_hybrid.EpisodeGuard`` and ``guard.StepGuard``. ``step`` says what step mode promises, and proves it.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.engine.engine import Engine, Ruling
from ethbrake_marl.engine.memory import Memory, begin_script, renew_memory, take_memory
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.shield.reasons import ShieldReason
from ethbrake_marl.shield.rollouts import Proposer, proposed_actions


class ShieldMode(IntEnum):
    """The mode of a shield: the code ``shield_mode`` of the infos. Modes of extensions have codes of their own.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldMode(1).name
    'STEP'

    """

    EPISODE = 0
    STEP = 1


class Guarded(NamedTuple):
    """The memory of a guard: its shield, and the memories of the policies that propose."""

    shield: Any  # the shield of the mode, a value with ``take(rows)``; in mode ``episode`` the HybridAgent's memory
    policies: dict[int, Memory]  # by shielded vehicle, front to rear; empty where no policy proposes

    def take(self, rows: Ints) -> Guarded:
        """The memory of some rows; a row may be named several times."""
        is_tree = isinstance(self.shield, Mapping)
        shield = take_memory(self.shield, rows) if is_tree else self.shield.take(rows)
        return Guarded(shield, take_memory(self.policies, rows))

    @property
    def told(self) -> dict[str, Any]:
        """What the shield says of each world, under the names that an agent's memory uses."""
        return {what: getattr(self.shield, what, None) for what in ("predicted_harm", "chosen_policy")}


class ShieldGuard(ABC):
    """What is the same in every mode. All learners are shielded, each by its place in ``vehicles``.

    Args:
        engine: in which the guard will stand.
        policies: propose where the caller does not, by vehicle. One that remembers its episode is asked at every
            decision, so that its memory stays right.
        shield: before any episode.
        mode: the code of the infos.
        where: the interface that the guard was made for, for messages.

    """

    def __init__(
        self, engine: Engine, policies: Mapping[int, Agent], shield: Any, *, mode: IntEnum, where: str = "shield"
    ) -> None:
        self.mode, self.where = mode, where
        self.scripts = engine.scripts
        self.vehicles = tuple(engine.learners)  # front to rear
        self._policies = dict(policies)
        self._fresh = shield

    @abstractmethod
    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """Say what is applied instead of the proposed actions [n, L]."""

    @abstractmethod
    def _started(self, shield: Any, alert: Worlds, rows: Ints) -> Any:
        """The shield once episodes start in these rows. The given one is a copy, and may be changed."""

    @abstractmethod
    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """What the infos say after a ruling. None: before the first decision, under the same keys.

        A value is one number, one for each world [n], each learner [n, L], or each vehicle [n, N].
        """

    def begin(self, memory: Guarded | None, alert: Worlds, rows: Ints) -> Guarded:
        """The memory once episodes start in these rows."""
        shield, policies = memory or Guarded(self._fresh, {})
        begun = {i: begin_script(policy, alert, i, self.scripts) for i, policy in self._policies.items()}
        policies = renew_memory(policies, rows, begun) if policies else begun
        return Guarded(self._started(copy.copy(shield), alert, rows), policies)

    def check(self, ruling: Ruling, after: Engine) -> Guarded:
        """The memory to keep: by default what the ruling says, whatever the step led to."""
        memory: Guarded = ruling.memory
        return memory

    def intervened(self, ruling: Ruling) -> Bools:
        """Where the applied action differs from the proposed one, [n, L]."""
        decided: Bools = ruling.decision.intervened
        return decided.reshape(ruling.applied.shape)

    def report(self, running: Engine) -> dict[str, NDArray[Any]]:
        """The infos of each vehicle, [n, N]: of the last step, or of the alert in rows that have just begun.

        In a row that has begun anew since the last step, that step belongs to the episode before.
        """
        memory: Any = running.guarded
        ruling, begun = running.ruling, running.steps == 0
        if ruling is None or begun.all():
            return self._of_vehicles(self.tell(memory, None), running)
        last = self._of_vehicles(self.tell(ruling.memory, ruling), running)
        if begun.any():
            alert = self._of_vehicles(self.tell(memory, None), running)
            last = {name: np.where(begun[:, np.newaxis], alert[name], each) for name, each in last.items()}
        return last

    def _of_vehicles(self, infos: Mapping[str, Any], running: Engine) -> dict[str, NDArray[Any]]:
        """The infos spread over all vehicles, [n, N]. A vehicle without a shield has reason ``NO_DECISION``, and 0."""
        shape, spread = running.wanted_mps2.shape, dict[str, NDArray[Any]]()
        for name, value in infos.items():
            each = np.asarray(value)
            if each.ndim == 2 and each.shape != shape:
                spread[name] = np.full(shape, ShieldReason.NO_DECISION if name == "reason" else 0, each.dtype)
                spread[name][:, list(self.vehicles)] = each
            else:
                spread[name] = np.broadcast_to(each[:, np.newaxis] if each.ndim == 1 else each, shape)
        return spread

    def _of_step(self, ruling: Ruling | None) -> dict[str, Any]:
        """Mode, proposed and applied action; before the first step the actions are 0."""
        infos: dict[str, Any] = {"mode": self.mode}
        if ruling is None:
            return infos | {"proposed_action": 0.0, "applied_action": 0.0, "intervened": False}
        intervened = self.intervened(ruling)
        return infos | {"proposed_action": ruling.proposed, "applied_action": ruling.applied, "intervened": intervened}

    def _asked(
        self, worlds: Worlds | None, memories: dict[int, Memory], proposed: Floats
    ) -> tuple[Floats, dict[int, Memory]]:
        """All proposals [n, L], the policies' where the caller made none, and the memories of the policies."""
        left_out = np.isnan(proposed).all(axis=0)
        if left_out.any() and not self._policies:
            raise InvalidInput("shield: no action was given, and there is no policy that could propose one")
        remember = (i for i, agent in self._policies.items() if getattr(agent, "remembers", memories[i] is not None))
        if left_out.any() or any(True for _ in remember):
            assert worlds is not None
            own, memories = proposed_actions(self._policies, memories, worlds)
            proposed = np.where(left_out, own, proposed)
        return proposed, memories

    def _proposer(self, memories: dict[int, Memory], worlds: Worlds | None) -> Proposer | None:
        """The policies with what they see now, for rollouts; None without policies."""
        return Proposer(self._policies, memories, worlds) if self._policies and worlds is not None else None


def why(ruling: Ruling | None) -> dict[str, Any]:
    """Reason and margin of a certified decision, [n, L]."""
    if ruling is None:
        return {"reason": ShieldReason.NO_DECISION, "margin": 0.0}
    return {name: getattr(ruling.decision, name).reshape(ruling.applied.shape) for name in ("reason", "margin")}
