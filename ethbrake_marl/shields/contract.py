"""The contract of every shield: the interface between an engine and its guard.

A *guard* is the object in an engine that decides which actions are applied. The engine calls its guard inside
``Engine.step``, once for all n worlds and L learners:

    decide(state, memory, proposed) -> (applied, memory, info)

``state``     the engine with its running episodes; the guard reads it and changes nothing.
``memory``    what the guard remembers of these episodes: a value, never changed in place.
``proposed``  actions [n, L] in [-1, 1]; NaN is an invalid action, a column of NaN means that no action was given.
``applied``   actions [n, L] with which the engine makes its step.
``memory``    the guard's memory after the step.
``info``      details of the decision, shown in the infos as ``shield_...``.

``decide`` returns all three in a ``Ruling`` (``engine.engine``). After the step, ``check`` compares the new state with
the prediction. If ``check`` raises ``UncertifiedStep``, the engine undoes the step and keeps its old memory.

``begin`` starts episodes in some rows, and ``report`` returns the infos. ``ShieldGuard`` implements what all modes
share: it queries the proposing policies, keeps their memories, and arranges the infos by vehicle. Each mode adds its
own decision: ``paper_hybrid.EpisodeGuard`` and ``guard.StepGuard``. The module ``step`` states and proves the promise
of step mode.
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
from ethbrake_marl.shields.reasons import ShieldReason
from ethbrake_marl.shields.rollouts import Proposer, proposed_actions


class ShieldMode(IntEnum):
    """Mode of a shield, as the code ``shield_mode`` in the infos. Modes of extensions define codes of their own.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldMode(1).name
    'STEP'

    """

    EPISODE = 0
    STEP = 1


class Guarded(NamedTuple):
    """Memory of a guard (the part of an engine that certifies or replaces actions) for n episodes."""

    shield: Any  # the mode's shield, a value with ``take(rows)``; in mode ``episode`` the memory of the HybridAgent
    policies: dict[int, Memory]  # index of a shielded vehicle -> memory of its policy; empty without policies

    def take(self, rows: Ints) -> Guarded:
        """Return the memory of the episodes in the rows with the indices ``rows``, which may be repeated."""
        is_tree = isinstance(self.shield, Mapping)
        shield = take_memory(self.shield, rows) if is_tree else self.shield.take(rows)
        return Guarded(shield, take_memory(self.policies, rows))

    @property
    def told(self) -> dict[str, Any]:
        """``{"predicted_harm": [n], "chosen_policy": [n]}``: the shield's values, None for a value that it lacks.

        These are the harm predicted at the alert (m2/s2), and whether the policy drives.
        """
        return {what: getattr(self.shield, what, None) for what in ("predicted_harm", "chosen_policy")}


class ShieldGuard(ABC):
    """Base class of the guards of all modes: the part of an engine that certifies or replaces the learners' actions.

    A subclass implements ``decide`` (which actions are applied), ``_started`` (the shield after episodes have begun)
    and ``tell`` (the infos). It may override ``check``, which compares a step with the prediction, and ``intervened``.

    Args:
        engine: the engine that the guard will protect. All its learners are shielded, front to rear.
        policies: vehicle index -> policy that proposes if the caller gives no action. A policy with a memory is called
            at every decision, so that its memory stays up to date.
        shield: the shield before any episode has begun, in the mode's own form.
        mode: code of the mode in the infos.
        where: name of the interface, for error messages.

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
        """Return the actions to apply in the next step, with the details of the decision.

        Args:
            running: the engine before the step.
            memory: memory of the guard.
            proposed: [n, L] proposed actions. A column of NaN: the caller gave that learner no action, so its policy
                proposes. A single NaN: an invalid action, which is never applied.

        """

    @abstractmethod
    def _started(self, shield: Any, alert: Worlds, rows: Ints) -> Any:
        """Return the mode's shield after episodes have started in the rows with the indices ``rows``.

        ``alert`` holds only the worlds of these rows, at t = 0. ``shield`` is a copy and may be changed.
        """

    @abstractmethod
    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Return the infos after a decision: name (without ``shield_``) -> value.

        Each value is a single number, or an array by world [n], by learner [n, L] or by vehicle [n, N].

        Args:
            memory: memory of the guard.
            ruling: the decision; None before the first one, when the names are the same.

        """

    def begin(self, memory: Guarded | None, alert: Worlds, rows: Ints) -> Guarded:
        """Return the guard's memory after episodes have started in the rows with the indices ``rows``.

        ``alert`` holds only the worlds of these rows, at t = 0. ``memory`` is None before the first episode.
        """
        shield, policies = memory or Guarded(self._fresh, {})
        memories = {i: begin_script(policy, alert, i, self.scripts) for i, policy in self._policies.items()}
        policies = renew_memory(policies, rows, memories) if policies else memories
        return Guarded(self._started(copy.copy(shield), alert, rows), policies)

    def check(self, ruling: Ruling, after: Engine) -> Guarded:
        """Return the memory to keep after the step.

        ``ruling`` is the decision before the step, ``after`` the engine after it. This base class accepts every step,
        and returns the ruling's memory.
        """
        memory: Guarded = ruling.memory
        return memory

    def intervened(self, ruling: Ruling) -> Bools:
        """Return whether the applied action differs from the proposed one, [n, L], for the decision ``ruling``."""
        decided: Bools = ruling.decision.intervened
        return decided.reshape(ruling.applied.shape)

    def report(self, running: Engine) -> dict[str, NDArray[Any]]:
        """Return the infos of every vehicle: name (without ``shield_``) -> values [n, N].

        They describe the last step of the engine ``running``. In a row whose episode has started since, they describe
        the alert of the new episode.
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
        """Return the ``infos`` (name -> value) with every value expanded to all vehicles, [n, N].

        ``running`` is the engine. A vehicle without a shield gets reason ``NO_DECISION``, and 0 in all other entries
        that have a column per learner.
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
        """Return the infos that all modes have: mode, proposed and applied action, and whether they differ.

        ``ruling`` is the decision in the last step; None before the first step, when the actions are 0.
        """
        infos: dict[str, Any] = {"mode": self.mode}
        if ruling is None:
            return infos | {"proposed_action": 0.0, "applied_action": 0.0, "intervened": False}
        intervened = self.intervened(ruling)
        return infos | {"proposed_action": ruling.proposed, "applied_action": ruling.applied, "intervened": intervened}

    def _asked(
        self, worlds: Worlds | None, memories: dict[int, Memory], proposed: Floats
    ) -> tuple[Floats, dict[int, Memory]]:
        """Return the proposals [n, L], completed by the policies, and the policies' new memories.

        Args:
            worlds: the n worlds as the policies see them; None only if no policy is called.
            memories: vehicle index -> memory of its policy.
            proposed: [n, L] the caller's actions; a column of NaN is filled in by that learner's policy.

        """
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
        """Return the policies with their ``memories`` and the current ``worlds``, for rollouts.

        None if there are no policies, or if ``worlds`` is None.
        """
        return Proposer(self._policies, memories, worlds) if self._policies and worlds is not None else None


def why(ruling: Ruling | None) -> dict[str, Any]:
    """Return the infos ``reason`` and ``margin`` of a decision of mode ``step``, each [n, L].

    ``reason`` is a code of ``ShieldReason``; ``margin`` is the accepted harm minus the least harm found after the
    proposal, m2/s2. Before the first decision (``ruling`` None) they are ``NO_DECISION`` and 0.
    """
    if ruling is None:
        return {"reason": ShieldReason.NO_DECISION, "margin": 0.0}
    return {name: getattr(ruling.decision, name).reshape(ruling.applied.shape) for name in ("reason", "margin")}
