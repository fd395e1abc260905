"""The guards that stand in an engine: a shield in each of its modes, and its options.

There is one way from a proposal to a step, whatever the interface and whatever stands between it and the engine
(``engine.Guard``):

1. *Decide.* ``Engine.step`` asks the guard what is applied. That changes nothing: the memory to come is in the ruling.
2. *Check.* The engine makes the step on a copy of its worlds and shows it to the guard. What is not the certified step,
   in its place in the episode, or the state and harm that it leads to, is refused: ``UncertifiedStep``.
3. *Commit.* The engine puts the new worlds, the guard's new memory and the ruling in place together.

So the shield is where the engine is, always: a refused call, an exception, or an interrupt at any line leaves both as
they were, or moves both.
"""

from __future__ import annotations

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import command_to_action
from ethbrake_marl.agents import (
    EV2XBM,
    Agent,
    AgentAround,
    AgentSettings,
    Believing,
    Driver,
    Episodes,
    Knowledge,
    LearnedAgent,
    LearnedPolicy,
    Source,
    Team,
    check_agent,
    drive,
)
from ethbrake_marl.engine import (
    Engine,
    Guard,
    Memory,
    Ruling,
    Script,
    ask_script,
    begin_script,
    renew_memory,
    take_memory,
)
from ethbrake_marl.errors import InvalidInput, UncertifiedStep, check_one_learner, count_of, renumbered, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.physics import Bools, Floats, Ints, Vehicles, Worlds
from ethbrake_marl.registry import Part
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.shield.enclosure import CORNERS, INTERIOR, checked_robust
from ethbrake_marl.shield.step_shield import (
    BelievedShield,
    Cap,
    Proposer,
    ShieldReason,
    StepShield,
    difference,
    proposed_actions,
    seen_columns,
)
from ethbrake_marl.shield.uncertainty import (
    UNCERTAINTY_EXAMPLE,
    Uncertainty,
    check_amount,
    check_scenario,
    parse_uncertainty,
)

# The options of a shield around an interface, and their checks, the same for every interface.


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


# The paper's hybrid (Algorithm 1): at the alert, choose between policy and baseline for the whole episode.
#
# The policy is rolled out in the engine from the alert on; its harm (each impact summed once) is compared with the
# baseline's ``H*`` and the lower one drives the episode. With ``H*`` coupled (realised in the same engine) the hybrid
# is never worse than the baseline, in any world, as long as the policy drives as it did in that rollout; one that draws
# its actions does not, and needs the step shield. With the paper's pairwise ``H*``, which treats the two pairs as
# independent, that does not hold: the pairwise figure is about half of what the same deceleration realises.

Bound = Literal["coupled", "pairwise"]


class HybridAgent(AgentAround):
    """Drives by ``policy`` in the worlds where its rolled-out harm is at most ``H*``, else by E-V2X-BM.

    ``bound`` says which ``H*`` and ``a*``; ``harm_count`` which harm counts. Its memory holds ``chosen_policy`` [n],
    who drives; ``policy_harm`` [n] and ``bound_harm`` [n] were compared, ``predicted_harm`` [n] is the lower one.
    Raises ``InvalidInput`` for an unknown ``bound`` or ``harm_count``, and for what is not an agent.
    """

    adds = Source.MODEL  # in which both are compared

    def __init__(
        self, policy: Agent, scenario: Scenario, *, bound: Bound = "coupled", harm_count: HarmCount = "first"
    ) -> None:
        check_agent(policy, "hybrid")
        check_scenario(scenario, "hybrid")
        super().__init__(policy, f"{policy.name}+episode{'' if bound == 'coupled' else ':pairwise'}")
        self.backup = EV2XBM(bound, harm_count=harm_count, horizon_s=scenario.horizon_s)
        self.scenario = scenario
        self.bound: Bound = bound
        self.harm_count: HarmCount = harm_count

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        """Choose in these worlds."""
        policy = begin_script(self.policy, alert, vehicle, scripts)
        backup = begin_script(self.backup, alert, vehicle, scripts)
        policy_harm = self._harm(alert, self.policy, vehicle)
        bound = backup["predicted_harm"]
        if self.bound == "coupled":
            bound = self._harm(alert, FixedCommand(-backup["deceleration_mps2"]), vehicle)
        return {
            "policy": policy, "backup": backup, "policy_harm": policy_harm, "bound_harm": bound,
            "predicted_harm": np.minimum(policy_harm, bound), "chosen_policy": policy_harm <= bound,
        }  # fmt: skip

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        """Wanted signed acceleration of the chosen strategy, [n] m/s2."""
        command, policy = ask_script(self.policy, worlds, memory["policy"], vehicle)
        constant, _ = self.backup.act(worlds, memory["backup"], vehicle)
        return np.where(memory["chosen_policy"], command, constant), {**memory, "policy": policy}

    def _harm(self, worlds: Worlds, agent: Agent, vehicle: int) -> Floats:
        return drive(worlds, agent, self.scenario, vehicle).ledger.world_harm(self.harm_count)


class FixedCommand:
    """One given command per world, for all of its episode."""

    name = "fixed"

    def __init__(self, command_mps2: Floats) -> None:
        self.command_mps2 = command_mps2

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of each world, [n] m/s2."""
        return self.command_mps2


ROUNDING = 1e-6  # of an action in 32 bits


class EpisodeGuard(ShieldGuard):
    """Mode ``episode``: ``HybridAgent`` chooses who drives at each alert, whatever is proposed.

    A proposal counts as replaced where it differs by more than the rounding of its 32 bits.
    """

    def _make(self) -> None:
        (policy,) = self._policies.values()
        self._hybrid = HybridAgent(policy, self.scenario, bound=self.options.bound, harm_count=self.options.harm_count)
        self._policies = {}  # the hybrid asks

    def _started(self, shield: Memory, alert: Worlds, rows: Ints) -> Memory:
        begun = begin_script(self._hybrid, alert, self.vehicles[0], self.scripts)
        return begun if shield is None else renew_memory(shield, rows, begun)

    def decide(self, running: Engine, memory: Guarded, proposed: Floats) -> Ruling:
        """What the chosen agent does."""
        worlds = running.worlds
        command, hybrid = ask_script(self._hybrid, worlds, memory.shield, self.vehicles[0])
        applied = command_to_action(command, worlds.vehicles, self.vehicles[0])[:, np.newaxis]
        memory = memory._replace(shield=hybrid)
        return Ruling(proposed, applied, ~hybrid["chosen_policy"], ~running.ended, None, memory)

    def intervened(self, ruling: Ruling) -> Bools:
        """Where something else was applied than what was proposed, [n, L]."""
        return np.asarray(abs(ruling.applied - ruling.proposed) > ROUNDING, np.bool_)

    def tell(self, memory: Guarded, ruling: Ruling | None) -> dict[str, Any]:
        """Who drives, and what was compared; ``proposed_action`` is NaN where nothing was proposed."""
        compared = {name: memory.shield[name] for name in ("chosen_policy", "policy_harm", "bound_harm")}
        return self._of_step(ruling) | compared


def guard_of(engine: Engine, policy: Proposing | None, options: ShieldOptions) -> ShieldGuard:
    """The guard of the options' mode for all learners of an engine, who proposes among them.

    Raises ``InvalidInput`` where nobody learns, for several learners in another mode than ``step``, and for what is no
    policy.
    """
    where, mode, scenario, vehicles = options.where, options.mode, engine.scenario, engine.learners
    if not vehicles:
        raise InvalidInput(
            f"{where}: no vehicle of scenario {scenario.name!r} learns, so there is nobody to shield; pass"
            " learners=['vehicle_2'] to the environment"
        )
    if mode != "step":
        check_one_learner(
            scenario.name,
            [scenario.vehicle_names[i] for i in vehicles],
            f"{where} needs exactly one learner in mode {mode}: what it certifies is known only if every other vehicle"
            " follows a script; mode step shields several together; or pass learners=['vehicle_2'] to the environment",
        )
    if mode == "episode":
        return EpisodeGuard(engine, {vehicles[0]: proposing_agent(policy, where)}, options)
    policies = {} if policy is None else proposing_agents(policy, vehicles, where)
    if options.believed:
        return BelievedGuard(engine, policies, options)
    return StepGuard(engine, policies, options, warns=True)


class Attached:
    """A guard in the engine of an environment, for the wrapper that put it there.

    Raises ``InvalidInput`` for what is not one of this package's environments, or is shielded already.
    """

    def __init__(
        self, env: object, interface: type, maker: str, policy: Proposing | None, where: str, options: Mapping[str, Any]
    ) -> None:
        self.options, self._env = read_options(where, options), env
        engine = self._reached()
        if isinstance(engine, Engine) and isinstance(engine.guard, ShieldGuard):
            first = engine.guard.options
            raise InvalidInput(
                f"{where}: a {first.where} (mode {first.mode}) shields this environment already, and its bound"
                " holds for one shield alone; give that one other options, or close() it first"
            )
        if isinstance(getattr(env, "attached", None), Attached):
            raise InvalidInput(f"{where}: {env} is a shield that was closed; put this one around what that is around")
        if not (isinstance(env, interface) and isinstance(engine, Engine)):
            raise InvalidInput(
                f"{where}: goes around {maker}, not {env}; eb.shield(env) chooses the one for an environment of ours"
            )
        self.engine, self._left = engine, Guarded(None, {})
        self.guard = guard_of(engine, policy, self.options)
        engine.protect(self.guard)

    @property
    def memory(self) -> Guarded:
        """What the guard remembers now, or, once it was closed, remembered last."""
        memory: Guarded | None = self.engine.guarded if self.engine.guard is self.guard else self._left
        return Guarded(None, {}) if memory is None else memory

    @property
    def shield(self) -> Any:
        """As it is now, to be read; None before a reset.

        A ``StepShield`` or ``BelievedShield``; in mode ``episode`` what the ``HybridAgent`` remembers.
        """
        return self.memory.shield

    def _reached(self) -> Any:
        """The engine of the environment inside, as it is now."""
        return getattr(getattr(self._env, "unwrapped", self._env), "engine", None)

    def check_open(self) -> None:
        """Raise ``InvalidInput`` where this shield bounds nothing: it was closed, or another environment is inside."""
        if self._reached() is not self.engine:
            raise InvalidInput(
                f"{self.options.where}: another environment is inside than the one that is shielded; put a shield"
                " around that one"
            )
        if self.engine.guard is not self.guard:
            raise InvalidInput(f"{self.options.where}: this shield was closed; put a new one around the environment")

    def close(self) -> None:
        """Let go of the engine."""
        if self.engine.guard is self.guard:
            self._left = self.memory
            self.engine.protect(None)

    def penalty(self) -> Floats:
        """What the interventions of the last step take off the rewards, [n, L]."""
        self.check_open()
        ruling = self.engine.ruling
        if ruling is None:
            return np.zeros((self.engine.n, len(self.engine.learners)))
        return self.options.intervention_penalty * (self.guard.intervened(ruling) & ruling.asked[:, np.newaxis])


# Drivers behind a shield, in evaluations: what they did, and what the shield did to them, world by world.


class ShieldedDriver:
    """An agent, or a team, behind a shield in mode ``step`` or ``robust``: it proposes, a guard in the engine decides.

    Where an agent harms no more than the coupled optimum, rolled out at the alert, it drives unhindered, and its harm
    is the bound. Elsewhere each action must be certified: by the rest of the plan, by a constant, or by the policy,
    rolled out from the state after the action. Of a team all proposals are known before any is applied.

    Args:
        policy: who proposes.
        scenario: in which actions are certified.
        later_rollouts: whether the policy itself may certify an action.
        told: worlds at the alert as the shield takes them to be; None: as they are, which is what the policy sees.
        options: keywords of ``ShieldOptions``.

    Raises ``InvalidInput`` for what is no agent and what does not fit, and for a learner that a team does not drive.

    >>> import ethbrake_marl as eb
    >>> eb.make_agent("coast+step", scenario=eb.load_scenario("paper-random")).on([1]).name
    'coast+step'

    """

    def __init__(
        self,
        policy: Driver,
        scenario: Scenario,
        *,
        later_rollouts: bool = True,
        told: Worlds | None = None,
        **options: Any,
    ) -> None:
        self.options = ShieldOptions(**options)
        if self.options.mode == "episode":
            raise InvalidInput("shield: mode = 'episode': HybridAgent is that of mode episode")
        check_agent(policy, str(self.options.mode), alone=not isinstance(policy, Team))
        check_scenario(scenario, str(self.options.mode))
        if not (told is None or isinstance(told, Worlds)):
            raise InvalidInput(f"step: told = {told!r}: must be worlds at the alert, or None")
        if isinstance(policy, Team) and (
            undriven := [scenario.vehicle_names[i] for i in scenario.learners if i not in policy.drivers]
        ):
            raise InvalidInput(
                f"team {policy.name!r}: does not drive {', '.join(undriven)}; beside a shielded vehicle every other one"
                " is shielded too, or follows a script"
            )
        self.policy, self.scenario = policy, scenario
        self._guard: dict[str, Any] = {} if self.options.believed else {"later_rollouts": later_rollouts, "told": told}
        robust = "" if self.options.robust == CORNERS else f":{self.options.robust}"
        self.name = f"{policy.name}+{self.options.mode}{robust}{':believed' if self.options.believed else ''}"
        one = scenario.learners[0] if len(scenario.learners) == 1 else None
        if self.options.believed:  # refuses bad settings at once; without one learner nobody knows whose scripts count
            self.options.believed_shield(scenario, one or 0, {} if one is None else None)
        elif not isinstance(policy, Team):
            self.options.step_shield(scenario, one or 0)

    @property
    def adds(self) -> Source:
        """What it knows beside what the policy knows: that in which actions are certified."""
        return Source.BELIEFS if self.options.believed else Source.MODEL

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, and what the shield adds."""
        return Knowledge.of(self.policy, also=self.adds)

    @classmethod
    def around(cls, driver: Driver, task: Task, **settings: Any) -> Team:
        """A copy of the ``driver`` behind one shield, on the task's vehicles; settings as of the class."""
        if isinstance(driver, Team) and len(task.vehicles) == 1:
            driver = Team.of(driver, task.vehicles).drivers[task.vehicle]
        elif isinstance(driver, Agent) and len(task.vehicles) > 1:
            driver = Team.of(driver, task.vehicles)
        return cls(driver, task.scenario, harm_count=task.harm_count, **settings).on(task.vehicles)

    def on(self, vehicles: Collection[int]) -> Team:
        """The team that drives these vehicles behind one shield, each by its own copy."""
        return Team(Team.of(self.policy, vehicles).drivers, self.name, shield=self)

    def guard(self, engine: Engine, policies: Mapping[int, Agent]) -> Guard:
        """What stands in the engine in which they drive."""
        if self.options.believed:
            return BelievedGuard(engine, policies, self.options)
        return StepGuard(engine, policies, self.options, several=isinstance(self.policy, Team), **self._guard)


CHUNK = 500  # worlds advanced together: bounds memory, changes no result


class Shielded(NamedTuple):
    """Episodes behind a step shield: n worlds (any axes before), N vehicles, K of them shielded."""

    harm: Floats  # [n] of the count that is guarded (m2/s2)
    vehicle_harm: Floats  # [n, N] what each vehicle bears of it
    bound: Floats  # [n] that was told at the alert, with the allowance
    baseline: Floats  # [n, N] what each vehicle bears under the baseline plan
    replaced: Ints  # [n, K] decisions of each shielded vehicle that were replaced
    decisions: Ints  # [n] of each of them
    moving: Bools  # [n] the horizon cut the episode off

    @staticmethod
    def of(episodes: Episodes, task: Task) -> Shielded:
        """What a step shield did in these episodes."""
        shield: StepShield = episodes.guarded.shield
        assert shield.running is not None
        return Shielded(
            episodes.ledger.world_harm(task.harm_count),
            episodes.ledger.vehicle_harm(task.harm_count),
            shield.predicted_harm,
            shield.baseline_shares,
            shield.replaced.reshape(len(shield.replaced), -1),
            shield.running.steps.copy(),
            ~episodes.at_rest,
        )

    @staticmethod
    def driven(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
        """A copy of the ``driver`` drives every world behind a step shield, ``CHUNK`` at a time; as ``around``."""
        parts = []
        for first in range(0, worlds.n, CHUNK):
            rows = np.arange(first, min(first + CHUNK, worlds.n))
            with renumbered(rows):
                episodes = drive(worlds.take(rows), ShieldedDriver.around(driver, task, **settings), task.scenario)
            parts.append(Shielded.of(episodes, task))
        return Shielded.join(parts)

    @staticmethod
    def join(parts: Sequence[Shielded]) -> Shielded:
        """Consecutive worlds as one."""
        return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))

    @staticmethod
    def stack(parts: Sequence[Shielded]) -> Shielded:
        """Several drivers in the same worlds, on an axis in front."""
        return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))


def shielded(driver: Driver, scenario: Scenario, mode: str, **options: Any) -> Driver:
    """An agent or a team behind a shield; an agent whose scenario has several learners drives each by a copy."""
    if mode == "episode":
        settings = ShieldOptions(mode, **options)
        return HybridAgent(driver, scenario, bound=settings.bound, harm_count=settings.harm_count)  # type: ignore[arg-type]  # which refuses a team
    if isinstance(driver, Agent) and len(scenario.learners) > 1:
        driver = Team.of(driver, scenario.learners)
    around = ShieldedDriver(driver, scenario, mode=mode, **options)
    return around.on(driver.drivers) if isinstance(driver, Team) else around


# Factories of what the registry puts around an agent: the shields, with and without ``:believed``.


class BelievingHybrid(Believing):
    """Algorithm 1 on what was received: at the first decision policy and E-V2X-BM are compared as is believed."""

    policy: HybridAgent

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, which drives by what it observes, and what the comparison adds."""
        return Knowledge.of(self.policy.policy, also=Source.BELIEFS)

    def _shown_at_first(self, believed: Worlds) -> Worlds:
        """The comparison is a rollout, which begins at t = 0 without impacts: the same line, its clock put back."""
        v, n = believed.vehicles, believed.n
        latency = np.maximum(v.latency_s - believed.time_s[:, np.newaxis], 0.0)
        vehicles = Vehicles.at_once(
            v.braking_capacity_mps2, v.driving_capacity_mps2, latency, v.mass_t, v.speed_limit_mps, v.restitution,
            v.brake_rate_mps3, v.release_rate_mps3,
        )  # fmt: skip
        return replace(
            believed, vehicles=vehicles, time_s=np.zeros(n), pair_hit=np.zeros_like(believed.pair_hit),
            obstacle_hit=np.zeros(n, np.bool_),
        )  # fmt: skip


def shield_episodes(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+episode`` or ``+episode:pairwise`` around an agent, with ``:believed`` behind on what was received."""
    bound: Bound = "coupled" if argument is None else "pairwise"
    scenario = settings.needed_scenario()
    hybrid = HybridAgent(policy, scenario, bound=bound, harm_count=settings.harm_count)
    if settings.believes and isinstance(policy, Believing):
        raise InvalidInput(f"agent {settings.spec!r}: {policy.name} decides on what was received itself; take +step")
    return BelievingHybrid(hybrid, scenario) if settings.believes else hybrid


def shield_steps(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """``+step`` around an agent or a team, where several vehicles learn around a copy for each; ``+step:believed``."""
    scenario, believes = settings.needed_scenario(), settings.believes
    several = isinstance(policy, Team) or len(scenario.learners) > 1
    if several and believes:
        raise InvalidInput(f"agent {settings.spec!r}: :believed shields one learner, not several; take +step")
    return shielded(policy, scenario, "step", harm_count=settings.harm_count, believed=believes)


def shield_steps_robustly(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """``+robust`` or ``+robust:interior``, against the uncertainty of the settings.

    With ``:believed`` behind, against all that was not received, without one.
    """
    where = f"agent {settings.spec!r}"
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count, believed=settings.believes,
        where=where, robust=checked_robust(argument or CORNERS, where),
        uncertainty=None if settings.believes else mode_uncertainty("robust", settings.uncertainty, where),
    )  # fmt: skip


# What this package's entry points name (pyproject.toml).


EPISODE = Part(
    shield_episodes,
    form="+episode[:pairwise][:believed]",
    about="behind Algorithm 1: it or E-V2X-BM drives the episode, whichever harms less; believed: as far as is"
    " received",
    knows=Source.MODEL,
)
STEP = Part(
    shield_steps,
    form="+step[:believed]",
    about="every action certified, or replaced; of a team together; believed: certified in the world that is believed",
    knows=Source.MODEL,
    teams=True,
)
ROBUST = Part(
    shield_steps_robustly,
    form="+robust[:interior][:believed]",
    about="as +step where not everything is known: in the corners of an uncertainty, interior: in all of it;"
    " believed: against all that was not received",
    knows=Source.MODEL,
)
