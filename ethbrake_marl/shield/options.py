"""The options of a shield around an interface, and their checks, the same for every interface."""

from __future__ import annotations

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import IntEnum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.learned import LearnedAgent, LearnedPolicy
from ethbrake_marl.agents.protocol import Agent, Team
from ethbrake_marl.engine.engine import Engine, Ruling
from ethbrake_marl.engine.memory import Memory, begin_script, renew_memory, take_memory
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, UncertifiedStep, count_of, unknown_name
from ethbrake_marl.extensions.certified.enclosure import CORNERS, INTERIOR, checked_robust
from ethbrake_marl.extensions.certified.estimated_shield import BelievedShield
from ethbrake_marl.extensions.certified.uncertainty import UNCERTAINTY_EXAMPLE, Uncertainty, parse_uncertainty
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.game.observations import ObservationSpec
from ethbrake_marl.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.checks import check_amount
from ethbrake_marl.shield.comparison import difference, seen_columns
from ethbrake_marl.shield.members import ShieldReason
from ethbrake_marl.shield.rollouts import Proposer, proposed_actions
from ethbrake_marl.shield.step import Cap, StepShield


class ShieldMode(IntEnum):
    """The mode of a shield: the code ``shield_mode`` of the infos.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldMode(1).name
    'STEP'

    """

    EPISODE = 0
    STEP = 1
    ROBUST = 2


MODES = tuple(each.name.lower() for each in ShieldMode)


def checked_uncertainty(given: object) -> Uncertainty | None:
    """An ``Uncertainty``, given as such or in its written form; None stays None. Raises ``InvalidInput`` otherwise."""
    if given is None or isinstance(given, Uncertainty):
        return given
    if isinstance(given, str):
        return parse_uncertainty(given)
    raise InvalidInput(f"uncertainty = {given!r}: must be an Uncertainty or text, for instance {UNCERTAINTY_EXAMPLE!r}")


def mode_uncertainty(mode: str, given: object, where: str) -> Uncertainty | None:
    """The uncertainty that goes with a mode: needed by ``robust``, refused by every other one with ``InvalidInput``."""
    uncertainty = checked_uncertainty(given)
    if (mode == "robust") != (uncertainty is not None):
        what = "needs an uncertainty" if uncertainty is None else "takes no uncertainty; robust does"
        raise InvalidInput(f"{where}: mode {mode} {what}, for instance {UNCERTAINTY_EXAMPLE}")
    return uncertainty


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
            if mode == "episode":
                raise InvalidInput(f"{self.where}: believed = True: mode episode takes none; step and robust do")
            without = {"uncertainty": None, "allowance": 0.0, "cap": None, "logging": False, "shares": False}
            for name, value in without.items():
                if getattr(self, name) != value:
                    raise InvalidInput(
                        f"{self.where}: {name} = {getattr(self, name)!r}: not together with believed = True, which"
                        " certifies against what was not received"
                    )
        uncertainty = None if self.believed else mode_uncertainty(mode, self.uncertainty, self.where)
        given = [name for name in ("allowance", "logging", "shares") if getattr(self, name)]
        if mode == "episode" and given:
            name = given[0]
            raise InvalidInput(
                f"{self.where}: {name} = {getattr(self, name)!r}: mode episode takes none; step and robust do"
            )
        if mode != "episode" and self.bound != "coupled":
            raise InvalidInput(f"{self.where}: bound = {self.bound!r}: mode {mode} takes none; episode does")
        caps = get_args(Cap)
        if self.cap is not None and (mode != "step" or self.cap not in caps):
            allowed = "mode step alone takes one" if self.cap in caps else f"must be {', '.join(caps)} or None"
            raise InvalidInput(f"{self.where}: cap = {self.cap!r}: {allowed}")
        if checked_robust(self.robust, self.where) == INTERIOR and mode != "robust":
            raise InvalidInput(f"{self.where}: robust = {self.robust!r}: mode {mode} takes none; robust does")
        check_amount("intervention_penalty", self.intervention_penalty, self.where)
        object.__setattr__(self, "mode", mode)
        object.__setattr__(self, "uncertainty", uncertainty)

    def step_shield(
        self, scenario: Scenario, vehicle: int | tuple[int, ...], others: Mapping[int, Script] | None = None
    ) -> StepShield:
        """The shield of these settings, where all is known or declared uncertain."""
        return StepShield(
            scenario, vehicle, harm_count=self.harm_count, allowance=self.allowance, others=others, cap=self.cap,
            uncertainty=checked_uncertainty(self.uncertainty), robust=self.robust, logging=self.logging,
        )  # fmt: skip

    def believed_shield(
        self, scenario: Scenario, vehicle: int, others: Mapping[int, Script] | None = None
    ) -> BelievedShield:
        """... and on what was received."""
        robust = self.robust if self.mode == "robust" else None
        return BelievedShield(scenario, vehicle, harm_count=self.harm_count, robust=robust, others=others)


def proposing_agent(policy: object, where: str) -> Agent:
    """An agent as it is, a loaded policy as an agent. Raises ``InvalidInput`` for anything else."""
    if not isinstance(policy, type):
        if isinstance(policy, Agent):
            return policy
        if callable(policy) and isinstance(getattr(policy, "observation", None), ObservationSpec):
            return LearnedAgent(policy)  # type: ignore[arg-type]  # it is callable, and says what it observes
    raise InvalidInput(
        f"{where}: policy = {policy!r}: must be an agent or a policy (eb.load_policy), which says what it observes"
    )


def proposing_agents(
    policy: Agent | LearnedPolicy | Team | Mapping[str, Agent | LearnedPolicy], vehicles: Sequence[int], where: str
) -> dict[int, Agent]:
    """Who proposes for each shielded vehicle: a team, policies by name of vehicle, or one for all.

    Raises ``InvalidInput`` for what is none of these, and a team of other vehicles.
    """
    if isinstance(policy, Team):
        given: dict[int, Agent] = policy.drivers
    elif isinstance(policy, Mapping):
        by_name = {f"vehicle_{i + 1}": i for i in vehicles}
        given = {by_name.get(name, -1): proposing_agent(each, where) for name, each in policy.items()}
    else:
        agent = proposing_agent(policy, where)
        return dict.fromkeys(vehicles, agent)
    if set(given) != set(vehicles):
        names = ", ".join(f"vehicle_{i + 1}" for i in vehicles)
        raise InvalidInput(f"{where}: policy: one for each of {names} is needed, and for nobody else")
    return {i: given[i] for i in vehicles}


def read_options(where: str, given: Mapping[str, Any]) -> ShieldOptions:
    """The options of an interface's keywords; raises ``UnknownName`` for one that is none."""
    known = {each.name for each in fields(ShieldOptions)} - {"where"}
    for name in given:
        if name not in known:
            raise unknown_name(f"{where} option", name, known)
    return ShieldOptions(**given, where=where)


Proposing = Agent | LearnedPolicy | Team | Mapping[str, Agent | LearnedPolicy]
"""Who proposes: one for every shielded vehicle, a team, or one for each by its vehicle's name."""


class MovingAtHorizon(UserWarning):
    """A shield's bound ends at the horizon, and something may still be moving then."""


class Guarded(NamedTuple):
    """What a guard remembers: its shield, and what those do who propose; neither is changed in place."""

    shield: Any  # StepShield, BelievedShield, or in mode ``episode`` the memory of the HybridAgent
    policies: dict[int, Memory]  # by shielded vehicle, front to rear; none where nobody is known to propose

    def take(self, rows: Ints) -> Guarded:
        """Of some rows of the engine, or of one several times."""
        is_tree = isinstance(self.shield, Mapping)
        shield = take_memory(self.shield, rows) if is_tree else self.shield.take(rows)
        return Guarded(shield, take_memory(self.policies, rows))

    @property
    def told(self) -> dict[str, Any]:
        """What it says of each world, as the memory of an agent would."""
        return {what: getattr(self.shield, what, None) for what in ("predicted_harm", "chosen_policy")}


class ShieldGuard(ABC):
    """A shield of one mode in an engine; every learner is shielded, by its vehicle's place in ``vehicles``.

    ``policies`` propose where nobody else does. One that remembers its episode is asked in every decision.
    """

    def __init__(self, engine: Engine, policies: Mapping[int, Agent] | None, options: ShieldOptions) -> None:
        self.options, self.scenario, self.scripts = options, engine.scenario, engine.scripts
        self.vehicles = tuple(engine.learners)  # front to rear
        self._policies = dict(policies or {})
        self._fresh = self._make()

    @abstractmethod
    def _make(self) -> Any:
        """The shield before any episode."""

    @abstractmethod
    def _started(self, shield: Any, alert: Worlds, rows: Ints) -> Any:
        """The shield once episodes start in these rows; the one that is given may be changed."""

    @abstractmethod
    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """What is applied instead of the actions [n, L]."""

    @abstractmethod
    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """What infos say after a ruling, or, without one, before the first decision: the same keys.

        Of a world: a number or [n]. Of vehicles: [n, L] of the learners, or [n, N].
        """

    def report(self, running: Engine) -> dict[str, NDArray[Any]]:
        """What infos say of each vehicle, [n, N]: of the last step, or of the alert in rows that made none since.

        Where a row has begun anew since the last step, that step was of the episode before.
        """
        memory: Any = running.guarded
        ruling, begun = running.ruling, running.steps == 0
        if ruling is None or begun.all():
            return self._of_vehicles(self.tell(memory, None), running)
        told = self._of_vehicles(self.tell(ruling.memory, ruling), running)
        if begun.any():
            alert = self._of_vehicles(self.tell(memory, None), running)
            told = {name: np.where(begun[:, np.newaxis], alert[name], each) for name, each in told.items()}
        return told

    def _of_vehicles(self, told: Mapping[str, Any], running: Engine) -> dict[str, NDArray[Any]]:
        """The same of every vehicle, [n, N]; for one that is not shielded nothing was decided."""
        shape, found = running.wanted_mps2.shape, dict[str, NDArray[Any]]()
        for name, given in told.items():
            each = np.asarray(given)
            if each.ndim == 2 and each.shape != shape:
                found[name] = np.full(shape, ShieldReason.NO_DECISION if name == "reason" else 0, each.dtype)
                found[name][:, list(self.vehicles)] = each
            else:
                found[name] = np.broadcast_to(each[:, np.newaxis] if each.ndim == 1 else each, shape)
        return found

    def _of_step(self, ruling: Ruling | None) -> dict[str, Any]:
        """The mode, what was proposed and what was applied; 0 where there was no step."""
        told: dict[str, Any] = {"mode": ShieldMode[str(self.options.mode).upper()]}
        if ruling is None:
            return told | {"proposed_action": 0.0, "applied_action": 0.0, "intervened": False}
        intervened = self.intervened(ruling)
        return told | {"proposed_action": ruling.proposed, "applied_action": ruling.applied, "intervened": intervened}

    def intervened(self, ruling: Ruling) -> Bools:
        """Where something else was applied than what was proposed, [n, L]."""
        decided: Bools = ruling.decision.intervened
        return decided.reshape(ruling.applied.shape)

    def begin(self, memory: Guarded | None, alert: Worlds, rows: Ints) -> Guarded:
        """The shield and the policies once episodes start in these rows."""
        shield, policies = memory or Guarded(self._fresh, {})
        begun = {i: begin_script(policy, alert, i, self.scripts) for i, policy in self._policies.items()}
        policies = renew_memory(policies, rows, begun) if policies else begun
        return Guarded(self._started(copy.copy(shield), alert, rows), policies)

    def check(self, ruling: Ruling, after: Engine) -> Guarded:
        """The memory as the ruling says: only step mode compares what a step led to."""
        memory: Guarded = ruling.memory
        return memory

    def _asked(
        self, worlds: Worlds | None, memories: dict[int, Memory], proposed: Floats
    ) -> tuple[Floats, dict[int, Memory]]:
        """All proposals [n, L], those of the policies where nobody else makes one, and what they remember then."""
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
        """Who may be rolled out; None where nobody proposes."""
        return Proposer(self._policies, memories, worlds) if self._policies and worlds is not None else None


def why(ruling: Ruling | None) -> dict[str, Any]:
    """Reason and margin of a certified decision, [n, L]."""
    if ruling is None:
        return {"reason": ShieldReason.NO_DECISION, "margin": 0.0}
    return {name: getattr(ruling.decision, name).reshape(ruling.applied.shape) for name in ("reason", "margin")}


class StepGuard(ShieldGuard):
    """Modes ``step`` and ``robust``: a ``StepShield`` that sees the engine's worlds.

    Args:
        engine: in which it will stand.
        policies: are rolled out at each alert, and propose where nobody else does.
        options: what it is set to.
        later_rollouts: whether a policy itself may certify an action.
        told: worlds at the alert as the shield takes them to be; None: as they are, which is what the policies see.
        warns: with ``MovingAtHorizon``, once, where the plan held at an alert leaves something moving at the horizon.
        several: several vehicles may be shielded: also one alone is treated as a team.

    """

    def __init__(
        self,
        engine: Engine,
        policies: Mapping[int, Agent] | None,
        options: ShieldOptions,
        *,
        later_rollouts: bool = True,
        told: Worlds | None = None,
        warns: bool = False,
        several: bool = False,
    ) -> None:
        self._several = several or len(engine.learners) > 1
        super().__init__(engine, policies, options)
        self._later_rollouts, self._told, self._to_warn = later_rollouts, told, warns

    def _make(self) -> StepShield:
        return self.options.step_shield(
            self.scenario, self.vehicles if self._several else self.vehicles[0], self.scripts
        )

    def _started(self, shield: StepShield, alert: Worlds, rows: Ints) -> StepShield:
        if self._told is not None and not (rows < self._told.n).all():
            raise InvalidInput(f"shield: told of {count_of(self._told.n, 'world')}, but row {rows.max()} begins")
        shield.begin(alert if self._told is None else self._told.take(rows), rows, self._policies or None)
        moving = int((~shield.settles[rows]).sum())
        if moving and self._to_warn:
            self._to_warn = False
            warnings.warn(
                f"shield: in {moving} of {len(rows)} worlds something still moves at the horizon,"
                f" {shield.scenario.horizon_s:g} s, under the plan that gives the bound; the bound says nothing of what"
                " comes after; a longer horizon_s lets them come to rest",
                MovingAtHorizon,
                stacklevel=2,
            )
        return shield

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """What is certified."""
        shield: StepShield = memory.shield
        goes_on, finished = ~running.ended, shield.running.finished  # type: ignore[union-attr]  # it has begun
        worlds = running.worlds if self._policies or self._told is not None else None  # made anew each time
        proposed, memories = self._asked(worlds, memory.policies, proposed)
        seen = seen_columns(running.packed)
        after = copy.copy(shield)
        decision = after.decide(
            proposed if self._several else proposed[:, 0],
            seen=seen if self._told is None else seen[:, : (3 * seen.shape[1] + 2) // 5],  # without harm
            only=goes_on,
            proposer=self._proposer(memories, worlds) if self._later_rollouts else None,
        )
        applied = decision.applied.reshape(proposed.shape)
        stepped_in: Bools = np.any(decision.intervened.reshape(proposed.shape), axis=1)
        return Ruling(proposed, applied, stepped_in, goes_on & ~finished, decision, Guarded(after, memories))

    def check(self, ruling: Ruling, after: Engine) -> Guarded:
        """Compare what the step led to with what was certified, the last step included.

        Where something else was ``told`` than is, a difference makes the world distrusted. Worlds that the physics
        could not advance are cut off, and not compared.
        """
        memory: Guarded = ruling.memory
        shield: StepShield = memory.shield
        running, wanted = shield.running, ruling.asked & ~shield.distrusted
        assert running is not None
        wanted[list(after.roster.failed)] = False
        if (wrong := np.flatnonzero(wanted & (after.steps != running.steps))).size:
            k = int(wrong[0])
            raise UncertifiedStep(
                f"shield: world {k} is at step {after.steps[k]} of its episode, certified was step {running.steps[k]}"
            )
        seen = shield.as_seen(seen_columns(after.packed))
        surprising = wanted & ~shield.expects(seen)
        if not surprising.any():
            return memory
        if self._told is None:
            k = int(np.argmax(surprising))
            raise UncertifiedStep(
                f"shield: after this step {difference(running.nominal().states[k], seen[k])} (world {k})"
            )
        shield = copy.copy(shield)
        shield.distrusted = shield.distrusted | surprising
        return memory._replace(shield=shield)

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Of a certified step."""
        shield: StepShield = memory.shield
        assert shield.running is not None
        told = self._of_step(ruling) | why(ruling)
        told |= {"bound_harm": shield.bound, "trusted": ~shield.distrusted, "settles": shield.settles}
        if self.options.mode == "robust":
            told["members"] = shield.running.members
        if self.options.shares or self.options.cap is not None:
            told |= {"own_harm": shield.shares(), "baseline_own_harm": shield.baseline_shares}
        return told


class BelievedGuard(ShieldGuard):
    """Modes ``step`` and ``robust`` on what was received: a ``BelievedShield`` that is shown the engine's worlds.

    Its bound is told once the first decision was made, and is that of the belief: what happens is not compared with
    what was foretold, as that may be wrong without anybody's fault.
    """

    def _make(self) -> BelievedShield:
        if len(self.vehicles) > 1:
            raise InvalidInput(
                f"{self.options.where}: believed = True: shields one learner, not several; pass learners=['vehicle_2']"
                " to the environment"
            )
        return self.options.believed_shield(self.scenario, self.vehicles[0], self.scripts)

    def _started(self, shield: BelievedShield, alert: Worlds, rows: Ints) -> BelievedShield:
        shield.begin(alert, rows)
        return shield

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """What is certified in the believed worlds."""
        worlds = running.worlds
        proposed, memories = self._asked(worlds, memory.policies, proposed)
        after = copy.copy(memory.shield)
        before, proposer = after.interventions, self._proposer(memories, worlds)
        applied = after.decide(worlds, proposed[:, 0], proposer, only=~running.ended)[:, np.newaxis]
        stepped_in = after.interventions > before
        return Ruling(proposed, applied, stepped_in, ~running.ended, after.decision, Guarded(after, memories))

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Of a step that is certified in the believed worlds; ``trusted``: something is promised of the real one."""
        believed: BelievedShield = memory.shield
        robust, shield = believed.robust is not None, believed.shield
        told = self._of_step(ruling) | why(ruling)
        told |= {"bound_harm": np.inf, "settles": False, "believed": True, "trusted": robust}
        if ruling is not None:
            told["bound_harm"] = np.where(np.isfinite(believed.predicted_harm), shield.bound, np.inf)
            told["settles"] = shield.settles
        if robust:
            told["members"] = believed.members
        return told


Bound = Literal["coupled", "pairwise"]
