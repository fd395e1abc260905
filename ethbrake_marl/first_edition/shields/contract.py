"""The contract of every shield: the interface between an engine and its guard.

A *guard* is the object in an engine that decides which actions are applied. The engine calls its guard once per
``Engine.step``, for all n worlds and L learners together:

    decide(state, memory, proposed) -> (applied, memory, info)

- ``state``: the engine with its running episodes, before the step. The guard reads the engine and does not change it.

- ``memory``: the guard's memory of the running episodes. The guard never changes its memory in place: ``decide``
  returns a new memory.

- ``proposed``: proposed actions, [n, L] in [-1, 1]. A column of NaN means that the caller gave no action for the
  learner of this column; the learner's policy then proposes an action. A single NaN is an invalid action and is never
  applied.

- ``applied``: actions that the engine applies in this step, [n, L].

- ``info``: details of the decision, which environments report in their infos as ``shield_...``.

``decide`` returns ``applied``, ``memory`` and ``info`` in one ``Ruling`` (``engine.engine``). After the step, ``check``
compares the new state with the state that the guard predicted. If ``check`` raises ``UncertifiedStep``, the engine
undoes the step and keeps its old memory.

``begin`` starts episodes in some rows of the batch, and ``report`` returns the infos. ``ShieldGuard`` implements what
all modes share: it asks the policies for proposals, stores their memories, and arranges the infos by vehicle. The
subclasses ``paper_hybrid.EpisodeGuard`` and ``guard.StepGuard`` implement ``decide`` for their mode. The module
``step`` states and proves the guarantee of mode ``step``.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Mapping
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.protocol import Agent
from ethbrake_marl.first_edition.engine.engine import Engine, Ruling
from ethbrake_marl.first_edition.engine.memory import Memory, begin_script, renew_memory, take_memory
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.shields.reasons import ShieldReason
from ethbrake_marl.first_edition.shields.rollouts import Proposer, proposed_actions


class ShieldMode(IntEnum):
    """Mode of a shield. The infos report the mode's number as ``shield_mode``. Modes of extensions have other numbers.

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.ShieldMode(1).name
    'STEP'

    """

    EPISODE = 0
    STEP = 1


class Guarded(NamedTuple):
    """Memory of a guard for n episodes."""

    shield: Any  # the shield of the mode, with a method ``take(rows)``; in mode ``episode`` the HybridAgent's memory
    policies: dict[int, Memory]  # index of a shielded vehicle -> memory of its policy; empty without policies

    def take(self, rows: Ints) -> Guarded:
        """Return the memory of the episodes in the rows ``rows``; an index may occur several times."""
        is_tree = isinstance(self.shield, Mapping)
        shield = take_memory(self.shield, rows) if is_tree else self.shield.take(rows)
        return Guarded(shield, take_memory(self.policies, rows))

    @property
    def results(self) -> dict[str, Any]:
        """The shield's values ``predicted_harm`` [n] and ``chosen_policy`` [n], by name; None for a missing value.

        ``predicted_harm`` is the harm predicted at the alert (m2/s2). ``chosen_policy`` is True in the worlds where the
        policy drives.
        """
        return {what: getattr(self.shield, what, None) for what in ("predicted_harm", "chosen_policy")}


class ShieldGuard(ABC):
    """Base class of all guards.

    A subclass implements ``decide`` (choose the applied actions), ``_started`` (start episodes) and ``tell`` (compute
    the infos). A subclass may also override ``check`` (compare the world after the step with the prediction) and
    ``intervened`` (say which proposals were replaced). In every method ``ruling`` is the decision in the last step,
    None before the first decision.

    Args:
        engine: the engine that gets this guard. All learners of the engine are shielded.
        policies: vehicle index -> policy that proposes an action if the caller gives no action for the vehicle. A
            policy with a memory is called at every decision, even if its proposal is not needed, to update its memory.
        shield: initial state of the shield, before any episode; its type depends on the mode.
        mode: mode of the shield; the infos report its number.
        where: name with which error messages begin: the function or class that the user called.

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
        """Return the actions to apply in the next step, with the details of the decision (see the module docstring).

        ``running`` is the engine before the step.
        """

    @abstractmethod
    def _started(self, shield: Any, alert: Worlds, rows: Ints) -> Any:
        """Start episodes in the rows with the indices ``rows``; return the shield's new state.

        ``alert`` contains the new worlds at the alert, one for each index in ``rows``. ``shield`` is a copy of the
        shield's old state, which this method may change.
        """

    @abstractmethod
    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos after a decision: dictionary from name (without ``shield_``) to value.

        A value is a single number, or an array with one number per world [n], learner [n, L] or vehicle [n, N]. The
        infos must have the same names before the first decision as after it.
        """

    def begin(self, memory: Guarded | None, alert: Worlds, rows: Ints) -> Guarded:
        """Start episodes in the rows with the indices ``rows``; return the guard's new memory.

        ``alert`` contains the new worlds at the alert, one for each index in ``rows``. ``memory`` is None before the
        first episode.
        """
        shield, policies = memory or Guarded(self._fresh, {})
        memories = {i: begin_script(policy, alert, i, self.scripts) for i, policy in self._policies.items()}
        policies = renew_memory(policies, rows, memories) if policies else memories
        return Guarded(self._started(copy.copy(shield), alert, rows), policies)

    def check(self, ruling: Ruling, after: Engine) -> Guarded:
        """Return the guard's memory after the step; this base class accepts every step.

        ``after`` is the engine after the step.
        """
        memory: Guarded = ruling.memory
        return memory

    def intervened(self, ruling: Ruling) -> Bools:
        """Return, for each learner, whether the decision ``ruling`` replaced the learner's proposed action, [n, L]."""
        decided: Bools = ruling.decision.intervened
        return decided.reshape(ruling.applied.shape)

    def report(self, running: Engine) -> dict[str, NDArray[Any]]:
        """Return the infos of every vehicle: dictionary from name (without ``shield_``) to values [n, N].

        The infos describe the last step of the engine ``running``. In a row where a new episode has just started, the
        infos describe the alert of the new episode instead.
        """
        memory: Any = running.guarded
        ruling, first = running.ruling, running.steps == 0
        if ruling is None or first.all():
            return self._of_vehicles(self.tell(memory, None), running)
        last = self._of_vehicles(self.tell(ruling.memory, ruling), running)
        if first.any():
            alert = self._of_vehicles(self.tell(memory, None), running)
            last = {name: np.where(first[:, np.newaxis], alert[name], each) for name, each in last.items()}
        return last

    def _of_vehicles(self, infos: Mapping[str, Any], running: Engine) -> dict[str, NDArray[Any]]:
        """Return ``infos`` with every value expanded to an array with one number per vehicle, [n, N].

        If a value has one column per learner, the columns of all other vehicles are 0 (in the info ``reason``:
        ``NO_DECISION``).
        """
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
        """Return the infos of all modes: mode, proposed action, applied action, and whether the action was replaced.

        Before the first step the infos report 0 as the proposed and the applied action.
        """
        infos: dict[str, Any] = {"mode": self.mode}
        if ruling is None:
            return infos | {"proposed_action": 0.0, "applied_action": 0.0, "intervened": False}
        intervened = self.intervened(ruling)
        return infos | {"proposed_action": ruling.proposed, "applied_action": ruling.applied, "intervened": intervened}

    def _asked(
        self, worlds: Worlds | None, memories: dict[int, Memory], proposed: Floats
    ) -> tuple[Floats, dict[int, Memory]]:
        """Let policies propose for learners without an action; return all proposals [n, L] and the policies' memories.

        ``worlds`` are the n worlds that the policies observe; they may be None if no policy is called. ``memories``
        maps a vehicle index to the memory of the vehicle's policy.
        """
        left_out = np.isnan(proposed).all(axis=0)
        if left_out.any() and not self._policies:
            raise InvalidInput(
                "shield: the action of a vehicle is missing, and the shield has no policy that could propose it; pass"
                " the action, or make the shield with policy=..."
            )
        remember = (i for i, agent in self._policies.items() if getattr(agent, "remembers", memories[i] is not None))
        if left_out.any() or any(True for _ in remember):
            assert worlds is not None
            own, memories = proposed_actions(self._policies, memories, worlds)
            proposed = np.where(left_out, own, proposed)
        return proposed, memories

    def _proposer(self, memories: dict[int, Memory], worlds: Worlds | None) -> Proposer | None:
        """Return the policies with their ``memories`` and the present ``worlds``, from which a rollout can start.

        Returns None if the guard has no policies, or if ``worlds`` is None.
        """
        return Proposer(self._policies, memories, worlds) if self._policies and worlds is not None else None


def why(ruling: Ruling | None) -> dict[str, Any]:
    """Return the infos ``reason`` and ``margin`` of a decision of mode ``step``, each [n, L].

    ``reason`` is a code of ``ShieldReason``; ``margin`` is in m2/s2. Before the first decision ``ruling`` is None, and
    the infos report the reason ``NO_DECISION`` and the margin 0.
    """
    if ruling is None:
        return {"reason": ShieldReason.NO_DECISION, "margin": 0.0}
    return {name: getattr(ruling.decision, name).reshape(ruling.applied.shape) for name in ("reason", "margin")}
