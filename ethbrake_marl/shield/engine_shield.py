"""Shields attached to a running engine: what every wrapped interface shares.

There is one way from a proposal to a step, whatever the interface and whatever stands between it and the engine:

1. *Certify.* The interface asks what may be applied. That changes nothing.
2. *Step.* The engine makes the step on a copy of its worlds and shows it to the shield. What is not the certified step,
   in its command, its place in the episode, or the state and harm that it leads to, is refused: ``UncertifiedStep``.
3. *Commit.* The engine puts the new worlds and the shield's new memory in place together (``engine.Watcher``).

So the shield is where the engine is, always: a refused call, an exception, or an interrupt at any line leaves both as
they were, or moves both.
"""

from __future__ import annotations

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import commands_of
from ethbrake_marl.agents.learned import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.team import Team
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.stream import begin_script, is_state_free
from ethbrake_marl.errors import InvalidInput, UncertifiedStep
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.rows import params_at
from ethbrake_marl.shield.certify import REASONS, Decision
from ethbrake_marl.shield.comparison import difference, seen_columns
from ethbrake_marl.shield.interior import expects
from ethbrake_marl.shield.options import ShieldOptions
from ethbrake_marl.shield.rollouts import Proposer, proposed_actions
from ethbrake_marl.shield.settings import proposing_agents, shielded_vehicles
from ethbrake_marl.shield.step_shield import Certified, StepShield
from ethbrake_marl.shield.told import SharesTold, by_vehicle, columns_of, told_before
from ethbrake_marl.shield.uncertainty import checked_uncertainty

ADVICE = (
    "what stands between the shield and the environment must pass each action on unchanged, exactly once; put wrappers"
    " that skip frames, change actions or step by themselves around the shield, not inside it"
)


Proposing = Agent | LearnedPolicy | Team | Mapping[str, Agent | LearnedPolicy]
"""Who proposes: one for every shielded vehicle, a team, or one for each by its vehicle's name."""


class MovingAtHorizon(UserWarning):
    """A shield's bound ends at the horizon, and something may still be moving then."""


class Sent(NamedTuple):
    """What was certified and handed to the environment, and is not carried out yet."""

    memory: object  # of the watcher, when it was certified
    steps_made: int  # by the engine until then
    applied: Floats  # [n] actions
    asked: Bools  # [n] worlds whose episode runs
    certified: Certified | None  # None: episode mode, and a believed world
    after: object = None  # the memory to come, of a shield over a believed world


class Attached(ABC):
    """A shield that follows an engine, and lets it do nothing but what was certified.

    Every learner is shielded: one, or in mode ``step`` several. Raises ``InvalidInput`` for another number.
    """

    policies: Mapping[int, Agent] | None = None  # who proposes where nobody else does

    def __init__(self, engine: Engine, options: ShieldOptions, memory: object) -> None:
        self.engine = engine
        self.options = options
        self.vehicle = shielded_vehicles(engine, options.where, options.mode)
        self.vehicles = (self.vehicle,) if isinstance(self.vehicle, int) else self.vehicle
        self.sent: Sent | None = None
        policies = (self.policies or {}).values()
        self.remembering = any(getattr(policy, "remembers", not is_state_free(policy)) for policy in policies)
        self._own: tuple[object, Floats] | None = None  # the memory then, and what the policies would do
        self._left = memory
        self.closed = False
        engine.watch(self, memory)

    @property
    def memory(self) -> Any:
        """What this shield knows now; once detached, what it knew last."""
        return self.engine.memory(self) if self in self.engine.watchers else self._left

    @property
    @abstractmethod
    def stepped_in(self) -> Bools:
        """Where something else than the proposal is applied in the step that was certified last, [n]; for pictures."""

    def confirm(self) -> None:
        """Raise ``UncertifiedStep`` unless the engine made the step that was handed to the environment last."""
        assert self.sent is not None
        if self.engine.steps_made != self.sent.steps_made + 1:
            raise UncertifiedStep(
                f"shield: the environment returned from step, but its engine made"
                f" {self.engine.steps_made - self.sent.steps_made} steps instead of 1; {ADVICE}"
            )

    def detach(self) -> None:
        """Let go of the engine: this shield no longer follows it."""
        self._left = self.memory
        self.engine.unwatch(self)
        self.closed = True

    def check_open(self) -> None:
        """Raise ``InvalidInput`` once this shield was closed: it follows nothing any more, and bounds nothing."""
        if self.closed:
            raise InvalidInput(f"{self.options.where}: this shield was closed; put a new one around the environment")

    def stepped(self, memory: Any, before: Engine, after: Engine) -> Any:
        """The memory once the engine made the certified step. Raises ``UncertifiedStep`` for any other one."""
        sent = self.sent
        if sent is None or sent.memory is not memory:
            raise UncertifiedStep(
                f"shield: the engine was to make a step that nothing was certified for (a second one in one call, or"
                f" one past the shield); step through the shield, or close() it first; {ADVICE}"
            )
        for c, vehicle in enumerate(self.vehicles):
            wanted = after.wanted_mps2[:, vehicle]
            certified = self._commands(by_vehicle(sent.applied, self.vehicles)[:, c], vehicle)
            wrong = np.flatnonzero(sent.asked & ~(wanted == certified))
            if wrong.size:
                k = int(wrong[0])
                raise UncertifiedStep(
                    f"shield: in world {k} the applied command, {wanted[k]:g} m/s2, is not the certified one,"
                    f" {certified[k]:g} m/s2; {ADVICE}"
                )
        return self._carried_out(memory, sent, after)

    def _commands(self, actions: Floats, vehicle: int) -> Floats:
        """Wanted signed accelerations of a shielded vehicle for its actions, to the bits of the engine, [n] m/s2."""
        params, vehicles = self.engine.packed.params, self.engine.scenario.vehicles
        braking, driving = (params[:, params_at(group, vehicles) + vehicle] for group in range(2))
        return commands_of(np.ascontiguousarray(actions), braking, driving)

    def infos(self, proposed: Floats) -> dict[str, NDArray[Any]]:
        """``info`` of every world, one array per key."""
        return columns_of([self.info(k, float(proposed[k])) for k in range(len(proposed))])

    def start_infos(self) -> dict[str, NDArray[Any]]:
        """``start_info`` of every world, one array per key."""
        return columns_of([self.start_info(k) for k in range(self.engine.n)])

    @property
    @abstractmethod
    def running(self) -> bool:
        """Whether any episode has begun."""

    def ask_policies(self) -> Floats | None:
        """What the policies themselves would do now, as actions, [n] of one vehicle or [n, K]; None without any.

        Each is asked once per decision; one that remembers is asked whoever proposes.
        """
        if self.policies is not None and (self._own is None or self._own[0] is not self.memory):
            single = isinstance(self.vehicle, int)
            self._own = self.memory, proposed_actions(self.policies, self.engine.worlds, single)
        return None if self._own is None else self._own[1]

    def proposal(self) -> Floats:
        """What stands for a proposal where nobody makes one, as actions [n]; NaN where none is needed."""
        own = self.ask_policies()
        if own is None:
            raise InvalidInput("shield: no action was given, and there is no policy that could propose one")
        return own

    @abstractmethod
    def decide(self, proposed: Floats) -> Floats:
        """The actions [n] to apply instead of those proposed. Nothing changes until the engine applies them."""

    @abstractmethod
    def info(self, k: int, proposed: float, c: int = 0) -> dict[str, Any]:
        """What the shield decided in world ``k`` for its vehicle number ``c``, for ``infos[agent]["shield"]``."""

    @abstractmethod
    def start_info(self, k: int, c: int = 0) -> dict[str, Any]:
        """The same keys before the first decision of world ``k``; 0 for what was not proposed or chosen yet."""

    @abstractmethod
    def begun(self, memory: Any, alert: Worlds, rows: Ints) -> Any:
        """The memory once episodes start in these rows."""

    @abstractmethod
    def _carried_out(self, memory: Any, sent: Sent, after: Engine) -> Any:
        """The memory after the certified command was applied."""


class AttachedShield(Attached):
    """A ``StepShield`` that begins with the engine's episodes and sees the engine's worlds.

    ``policy`` (an agent, a loaded policy, or None) is rolled out at each alert, and proposes where nobody else does.
    Warns with ``MovingAtHorizon``, once, where the plan held at an alert leaves something moving at the horizon.
    """

    def __init__(
        self,
        engine: Engine,
        policy: Proposing | None,
        options: ShieldOptions,
    ) -> None:
        vehicle = shielded_vehicles(engine, options.where, options.mode)
        shield = StepShield(
            engine.scenario, vehicle, harm_count=options.harm_count, allowance=options.allowance, others=engine.scripts,
            uncertainty=checked_uncertainty(options.uncertainty), cap=options.cap, robust=options.robust,
            logging=options.logging,
        )  # fmt: skip
        self.policies = None if policy is None else proposing_agents(policy, shield.vehicles, options.where)
        self._warned, self._shares = False, SharesTold()
        super().__init__(engine, options, shield)

    @property
    def shield(self) -> StepShield:
        """The shield as it is now: to be read; the next step puts another one in its place."""
        shield: StepShield = self.memory
        return shield

    @property
    def running(self) -> bool:
        """Whether any episode has begun."""
        return self.shield.running is not None

    @property
    def stepped_in(self) -> Bools:
        """Where a proposal was replaced, [n]."""
        decision = self.decision
        if decision is None:
            return np.zeros(self.engine.n, np.bool_)
        return np.asarray(by_vehicle(decision.intervened, self.vehicles).any(axis=1), np.bool_)

    @property
    def decision(self) -> Decision | None:
        """What was decided last."""
        return None if self.sent is None or self.sent.certified is None else self.sent.certified.decision

    def decide(self, proposed: Floats) -> Floats:
        """The actions to apply instead of those proposed, [n] of one vehicle or [n, K]; the engine applies them."""
        engine, shield = self.engine, self.shield
        if self.remembering:
            self.ask_policies()
        proposer = None if self.policies is None else Proposer(self.policies, engine.worlds)
        certified = shield.propose(proposed, seen=seen_columns(engine.packed), only=~engine.ended, proposer=proposer)
        applied = certified.decision.applied
        self.sent = Sent(shield, engine.steps_made, applied, certified.asked, certified)
        return applied

    def info(self, k: int, proposed: float, c: int = 0) -> dict[str, Any]:
        """What the shield decided in world ``k`` for its vehicle number ``c``, for ``infos[agent]["shield"]``."""
        assert self.sent is not None and self.sent.certified is not None
        decision, after = self.sent.certified.decision, self.sent.certified.after
        at = k if isinstance(self.vehicle, int) else (k, c)
        return told_before(after, k) | {
            "proposed_action": proposed,
            "chosen_action": float(decision.applied[at]),
            "intervened": bool(decision.intervened[at]),
            "reason": REASONS[int(decision.reason[at])],
            "bound_harm": float(decision.bound[k]),
            "margin": float(decision.margin[at]),
            **self._shares_of(after, k, c),
        }

    def start_info(self, k: int, c: int = 0) -> dict[str, Any]:
        """The bound that was told at the alert of world ``k``, before anything was decided."""
        return told_before(self.shield, k) | self._shares_of(self.shield, k, c)

    def _shares_of(self, shield: StepShield, k: int, c: int) -> dict[str, Any]:
        """What the shield's vehicle number ``c`` bears, where that is asked for."""
        wanted = self.options.shares or self.options.cap is not None
        return self._shares.told(shield, k, self.vehicles[c]) if wanted else {}

    def begun(self, memory: StepShield, alert: Worlds, rows: Ints) -> StepShield:
        """The shield once episodes start in these rows."""
        for vehicle, policy in (self.policies or {}).items():
            begin_script(policy, alert, vehicle, rows)
        shield = copy.copy(memory)
        shield.begin(alert, rows, self.policies)
        moving = int((~shield.settles[rows]).sum())
        if moving and not self._warned:
            self._warned = True
            warnings.warn(
                f"shield: in {moving} of {len(rows)} worlds something still moves at the horizon,"
                f" {shield.scenario.horizon_s:g} s, under the plan that gives the bound; the bound says nothing of what"
                " comes after; a longer horizon_s lets them come to rest",
                MovingAtHorizon,
                stacklevel=2,
            )
        return shield

    def _carried_out(self, memory: StepShield, sent: Sent, after: Engine) -> StepShield:
        assert sent.certified is not None
        shield = sent.certified.after
        running, wanted = shield.running, sent.asked & ~shield.distrusted
        assert running is not None
        if (wrong := np.flatnonzero(wanted & (after.steps != running.steps))).size:
            k = int(wrong[0])
            raise UncertifiedStep(
                f"shield: world {k} is at step {after.steps[k]} of its episode, certified was step"
                f" {running.steps[k]}; {ADVICE}"
            )
        seen = seen_columns(after.packed)
        if (wrong := np.flatnonzero(wanted & ~expects(sent.certified.after.boxes, running, seen))).size:
            k = int(wrong[0])
            told = difference(running.nominal().states[k], seen[k])
            raise UncertifiedStep(f"shield: after this step {told} (world {k}); {ADVICE}")
        return sent.certified.carried_out()
