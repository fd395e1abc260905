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
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import command_to_action, commands_of
from ethbrake_marl.agents.policy import LearnedPolicy
from ethbrake_marl.agents.protocol import Agent, Team
from ethbrake_marl.agents.rollout import set_others
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.stream import begin_script, is_state_free
from ethbrake_marl.errors import InvalidInput, UncertifiedStep, unknown_name
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.advance import params_at
from ethbrake_marl.shield.agents import Bound, HybridAgent
from ethbrake_marl.shield.believed import BelievedShield
from ethbrake_marl.shield.certify import REASONS, Decision, Proposer, difference, proposed_actions, seen_columns
from ethbrake_marl.shield.enclosure import CORNERS, INTERIOR, checked_robust, expects
from ethbrake_marl.shield.step_shield import (
    CAPS,
    Cap,
    Certified,
    SharesTold,
    StepShield,
    by_vehicle,
    columns_of,
    told_before,
)
from ethbrake_marl.shield.uncertainty import (
    Uncertainty,
    check_amount,
    checked_uncertainty,
    mode_uncertainty,
    proposing_agent,
    proposing_agents,
    shielded_vehicles,
)

# The options of a shield around an interface, and their checks, the same for every interface.

MODES = ("episode", "step", "robust")


@dataclass(frozen=True, slots=True)
class ShieldOptions:
    """The settings of ``HybridShield``, ``ShieldedEnv``, ``ShieldedVectorEnv`` and ``ShieldedVecEnv``: their keywords.

    Args:
        mode: ``episode`` (Algorithm 1: policy or E-V2X-BM for a whole episode), ``step`` (each action is certified or
            replaced) or ``robust`` (``step`` against an uncertainty). None: ``robust`` with an uncertainty, else
            ``step``.
        bound: the ``H*`` of mode ``episode``, ``coupled`` or the paper's ``pairwise``.
        harm_count: the harm that is guaranteed, ``first`` or ``total``.
        allowance: how far above the bound is allowed, m2/s2; not in mode ``episode``.
        uncertainty: what mode ``robust`` does not know, such as ``"gaps_m=0.5"``.
        cap: ``baseline``: no vehicle ever bears more harm than it would under the constants of least harm, whose sum is
            the bound at the alert. None: the sum alone is bounded. Mode ``step`` alone.
        robust: what mode ``robust`` certifies of an uncertainty: its ``corners`` (fast), or its whole ``interior``.
        believed: certify on what the vehicle received, mode ``robust`` against all that it did not. Modes ``step`` and
            ``robust`` of one learner, without ``uncertainty``, ``allowance``, ``cap``, ``logging`` and ``shares``.
        intervention_penalty: taken off the reward of a step in which something else than the proposal was applied.
        logging: keep every intervention in ``shield.log``; not in mode ``episode``.
        shares: tell in ``infos`` what each vehicle itself bears under the plan held now, and under the baseline plan;
            with a ``cap`` it is told always. Costs a few percent of a step; not in mode ``episode``.
        where: who is given them, for messages.

    Raises ``InvalidInput`` naming the setting that does not fit, ``UnknownName`` for a mode.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldOptions(uncertainty="gaps_m=0.5").mode
    'robust'

    """

    mode: str | None = None
    bound: Bound = "coupled"
    harm_count: HarmCount = "first"
    allowance: float = 0.0
    uncertainty: Uncertainty | str | None = None
    cap: Cap | None = None
    robust: str = CORNERS
    believed: bool = False
    intervention_penalty: float = 0.0
    logging: bool = False
    shares: bool = False
    where: str = field(default="shield", compare=False)

    def __post_init__(self) -> None:
        mode = self.mode if self.mode is not None else "step" if self.uncertainty is None else "robust"
        if mode not in MODES:
            raise unknown_name("shield mode", mode, MODES)
        for name in ("believed", "logging", "shares"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidInput(f"{self.where}: {name} = {getattr(self, name)!r}: must be True or False")
        if self.believed:
            self._check_believed(mode)
        uncertainty = None if self.believed else mode_uncertainty(mode, self.uncertainty, self.where)
        given = [name for name in ("allowance", "logging", "shares") if getattr(self, name)]
        if mode == "episode" and given:
            name = given[0]
            raise InvalidInput(
                f"{self.where}: {name} = {getattr(self, name)!r}: mode episode takes none; step and robust do"
            )
        if mode != "episode" and self.bound != "coupled":
            raise InvalidInput(f"{self.where}: bound = {self.bound!r}: mode {mode} takes none; episode does")
        if self.cap is not None and (mode != "step" or self.cap not in CAPS):
            allowed = "mode step alone takes one" if self.cap in CAPS else f"must be {', '.join(CAPS)} or None"
            raise InvalidInput(f"{self.where}: cap = {self.cap!r}: {allowed}")
        if checked_robust(self.robust, self.where) == INTERIOR and mode != "robust":
            raise InvalidInput(f"{self.where}: robust = {self.robust!r}: mode {mode} takes none; robust does")
        check_amount("intervention_penalty", self.intervention_penalty, self.where)
        object.__setattr__(self, "mode", mode)
        object.__setattr__(self, "uncertainty", uncertainty)

    def _check_believed(self, mode: str) -> None:
        """Raise ``InvalidInput`` for what a shield on what was received does not take."""
        if mode == "episode":
            raise InvalidInput(f"{self.where}: believed = True: mode episode takes none; step and robust do")
        without = {"uncertainty": None, "allowance": 0.0, "cap": None, "logging": False, "shares": False}
        for name, value in without.items():
            if getattr(self, name) != value:
                raise InvalidInput(
                    f"{self.where}: {name} = {getattr(self, name)!r}: not together with believed = True, which"
                    " certifies against what was not received"
                )


def read_options(where: str, given: Mapping[str, Any]) -> ShieldOptions:
    """The options of an interface's keywords; raises ``UnknownName`` for one that is none."""
    known = {each.name for each in fields(ShieldOptions)} - {"where"}
    for name in given:
        if name not in known:
            raise unknown_name(f"{where} option", name, known)
    return ShieldOptions(**given, where=where)


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


# Step and robust mode on a running engine, certified on what was really received: ``believed=True`` of a wrapper.


class AttachedBelieved(Attached):
    """A ``BelievedShield`` that begins with the engine's episodes, and is shown the engine's worlds.

    Its bound is told once the first decision was made, and is that of the belief: what happens is not compared with
    what was foretold, as that may be wrong without anybody's fault.
    """

    vehicle: int

    def __init__(self, engine: Engine, policy: Proposing | None, options: ShieldOptions) -> None:
        vehicle = shielded_vehicles(engine, options.where, options.mode)
        if not isinstance(vehicle, int):
            raise InvalidInput(
                f"{options.where}: believed = True: shields one learner, not several; pass learners=['vehicle_2'] to"
                " the environment"
            )
        robust = options.robust if options.mode == "robust" else None
        shield = BelievedShield(engine.scenario, harm_count=options.harm_count, robust=robust, others=engine.scripts)
        self.policies = None if policy is None else proposing_agents(policy, (vehicle,), options.where)
        super().__init__(engine, options, shield)

    @property
    def believed(self) -> BelievedShield:
        """The shield as it is now: to be read; the next step puts another one in its place."""
        believed: BelievedShield = self.memory
        return believed

    @property
    def running(self) -> bool:
        """Whether any episode has begun."""
        return self.believed.predicted_harm.size > 0

    @property
    def stepped_in(self) -> Bools:
        """Where a proposal was replaced, [n]."""
        decision = None if self.sent is None else self.believed.decision
        return np.zeros(self.engine.n, np.bool_) if decision is None else decision.intervened

    def decide(self, proposed: Floats) -> Floats:
        """The actions [n] to apply instead of those proposed; the engine applies them."""
        memory, engine = self.believed, self.engine
        if self.remembering:
            self.ask_policies()
        after, worlds = memory.branch(), engine.worlds
        command = after.decide(worlds, self.vehicle, lambda: np.asarray(proposed, np.float64), self.policies)
        applied = command_to_action(command, worlds.vehicles, self.vehicle)
        self.sent = Sent(memory, engine.steps_made, applied, ~engine.ended, None, after)
        return applied

    def info(self, k: int, proposed: float, c: int = 0) -> dict[str, Any]:
        """What the shield decided in world ``k``; ``trusted``: the mode promises something of the world as it is."""
        assert self.sent is not None and isinstance(self.sent.after, BelievedShield)
        after = self.sent.after
        decision, shield = after.decision, after.shield
        assert decision is not None and shield is not None
        return told_before(shield, k) | {
            "proposed_action": proposed,
            "chosen_action": float(self.sent.applied[k]),
            "intervened": bool(decision.intervened[k]),
            "reason": REASONS[int(decision.reason[k])],
            "margin": float(decision.margin[k]),
            "bound_harm": float(shield.bound[k]) if np.isfinite(after.predicted_harm[k]) else np.inf,
            **self._marks(),
        }

    def start_info(self, k: int, c: int = 0) -> dict[str, Any]:
        """The same keys before the first decision of world ``k``: nothing was certified, and the bound is infinite."""
        told = {"mode": self.options.mode, "proposed_action": 0.0, "chosen_action": 0.0, "intervened": False}
        told |= {"reason": "", "bound_harm": np.inf, "margin": 0.0, "settles": False, **self._marks()}
        return told | ({} if self.believed.robust is None else {"members": self.believed.members})

    def _marks(self) -> dict[str, bool]:
        return {"believed": True, "trusted": self.believed.robust is not None}

    def begun(self, memory: BelievedShield, alert: Worlds, rows: Ints) -> BelievedShield:
        """The shield once episodes start in these rows."""
        for vehicle, policy in (self.policies or {}).items():
            set_others(policy, vehicle, self.engine.scripts)
            begin_script(policy, alert, vehicle, rows)
        shield = memory.branch()
        shield.begin(alert, self.vehicle, rows)
        return shield

    def _carried_out(self, memory: BelievedShield, sent: Sent, after: Engine) -> object:
        return sent.after


# Episode mode on a running engine, and the shield of each mode.

ROUNDING = 1e-6  # of an action in 32 bits


class EpisodeChoice(NamedTuple):
    """What episode mode remembers: who drives, and that nothing was asked of it yet at this decision."""

    hybrid: HybridAgent


class AttachedHybrid(Attached):
    """Episode mode on a running engine: ``HybridAgent`` chooses at each alert, and its action alone may be applied."""

    vehicle: int

    def __init__(self, engine: Engine, policy: Proposing | None, options: ShieldOptions) -> None:
        shielded_vehicles(engine, options.where, options.mode)
        agent = proposing_agent(policy, options.where)
        hybrid = HybridAgent(agent, engine.scenario, bound=options.bound, harm_count=options.harm_count)
        super().__init__(engine, options, EpisodeChoice(hybrid))

    @property
    def hybrid(self) -> HybridAgent:
        """The agent that drives, as it is now."""
        choice: EpisodeChoice = self.memory
        return choice.hybrid

    @property
    def running(self) -> bool:
        """Whether any episode has begun."""
        return self.hybrid.policy_harm.size > 0

    @property
    def stepped_in(self) -> Bools:
        """Where E-V2X-BM drives the episode instead of the policy, [n]."""
        replaced: Bools = ~self.hybrid.chosen_policy
        return replaced

    def proposal(self) -> Floats:
        """NaN: the agent that was chosen drives, whatever is proposed."""
        return np.full(self.engine.n, np.nan)

    def decide(self, proposed: Floats) -> Floats:
        """The actions [n] to apply. Asked again before they were applied, the agent is not asked again."""
        memory, engine = self.memory, self.engine
        if self.sent is None or self.sent.memory is not memory:
            worlds = engine.worlds
            applied = command_to_action(memory.hybrid.act(worlds, self.vehicle), worlds.vehicles, self.vehicle)
            self.sent = Sent(memory, engine.steps_made, applied, ~engine.ended, None)
        return self.sent.applied

    def begun(self, memory: EpisodeChoice, alert: Worlds, rows: Ints) -> EpisodeChoice:
        """Who drives the episodes that start in these rows."""
        hybrid = copy.copy(memory.hybrid)
        hybrid.backup = copy.copy(hybrid.backup)
        hybrid.begin(alert, self.vehicle, rows)
        return EpisodeChoice(hybrid)

    def info(self, k: int, proposed: float, c: int = 0) -> dict[str, Any]:
        """Who drives the episode of world ``k``; ``proposed_action`` is NaN when nothing was proposed.

        A proposal counts as replaced where it differs by more than the rounding of its 32 bits.
        """
        assert self.sent is not None and isinstance(self.sent.memory, EpisodeChoice)
        applied, hybrid = float(self.sent.applied[k]), self.sent.memory.hybrid  # now the next episode may have begun
        return {
            "mode": "episode",
            "proposed_action": proposed,
            "chosen_action": applied,
            "intervened": abs(applied - proposed) > ROUNDING,
            "chosen_policy": bool(hybrid.chosen_policy[k]),
            "policy_harm": float(hybrid.policy_harm[k]),
            "bound_harm": float(hybrid.bound_harm[k]),
        }

    def start_info(self, k: int, c: int = 0) -> dict[str, Any]:
        """Who will drive the episode of world ``k``, before the first decision."""
        return {
            "mode": "episode",
            "proposed_action": 0.0,
            "chosen_action": 0.0,
            "intervened": False,
            "chosen_policy": bool(self.hybrid.chosen_policy[k]),
            "policy_harm": float(self.hybrid.policy_harm[k]),
            "bound_harm": float(self.hybrid.bound_harm[k]),
        }

    def _carried_out(self, memory: EpisodeChoice, sent: Sent, after: Engine) -> EpisodeChoice:
        return EpisodeChoice(memory.hybrid)  # another one: the next decision is another one, too


def attach(engine: Engine, policy: Proposing | None, options: ShieldOptions) -> Attached:
    """The shield of the options' mode on a running engine."""
    if options.mode == "episode":
        return AttachedHybrid(engine, policy, options)
    if options.believed:
        return AttachedBelieved(engine, policy, options)
    return AttachedShield(engine, policy, options)
