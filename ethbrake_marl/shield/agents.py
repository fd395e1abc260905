"""The paper's hybrid (Algorithm 1): at the alert, choose between policy and baseline for the whole episode.

The policy is rolled out in the engine from the alert on; its harm (each impact summed once) is compared with the
baseline's ``H*`` and the lower one drives the episode. With ``H*`` coupled (realised in the same engine) the hybrid
is never worse than the baseline, in any world, as long as the policy drives as it did in that rollout; one that draws
its actions does not, and needs the step shield. With the paper's pairwise ``H*``, which treats the two pairs as
independent, that does not hold: the pairwise figure is about half of what the same deceleration realises.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.actions import action_to_command
from ethbrake_marl.agents.believed import Believing, split_believed
from ethbrake_marl.agents.e_v2x_bm import EV2XBM
from ethbrake_marl.agents.protocol import (
    Agent,
    AgentAround,
    Driver,
    Knowledge,
    Source,
    Team,
    check_agent,
    combine,
    place,
    recall,
    team_of,
)
from ethbrake_marl.agents.refined import Refined
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.agents.rollout import drive, script_agents, set_others
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.engine.stream import ask_script, begin_script
from ethbrake_marl.errors import InvalidInput, UncertifiedStep, count_of, renumbered
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.advance import TIME, Packed
from ethbrake_marl.physics.kernel import decision_s, first_decision_s
from ethbrake_marl.physics.worlds import vehicles_at_once
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.search import state_columns
from ethbrake_marl.shield.believed import BelievedShieldAgent
from ethbrake_marl.shield.certify import Proposer, difference, proposed_actions, seen_columns
from ethbrake_marl.shield.enclosure import CORNERS, checked_robust, expects
from ethbrake_marl.shield.step_shield import Cap, Certified, StepShield, by_vehicle
from ethbrake_marl.shield.uncertainty import Uncertainty, check_scenario, checked_uncertainty, mode_uncertainty

Bound = Literal["coupled", "pairwise"]
CLOCK = 1e-6  # of a time step: rounding of the clock of whoever asks


class HybridAgent(AgentAround):
    """Drives by ``policy`` in the worlds where its rolled-out harm is at most ``H*``, else by E-V2X-BM.

    ``bound`` says which ``H*`` and ``a*``; ``harm_count`` which harm counts. After ``begin``, ``chosen_policy`` [n]
    says who drives; ``policy_harm`` [n] and ``bound_harm`` [n] were compared, ``predicted_harm`` [n] is the lower one.
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
        self.policy_harm: Floats = np.zeros(0)
        self.bound_harm: Floats = np.zeros(0)
        self._stage = copy.deepcopy(policy)  # predicting must not disturb the policy's memory of running episodes

    @property
    def chosen_policy(self) -> Bools:
        """Where the policy drives, [n]."""
        chosen: Bools = self.policy_harm <= self.bound_harm
        return chosen

    @property
    def predicted_harm(self) -> Floats:
        """Harm expected at the alert, [n] m2/s2."""
        return np.minimum(self.policy_harm, self.bound_harm)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Choose for these rows; ``worlds`` holds those rows only, at the alert."""
        scripts = script_agents(self.scenario, except_for=vehicle)
        for agent in (self.policy, self.backup):
            set_others(agent, vehicle, scripts)
            begin_script(agent, worlds, vehicle, rows)
        if isinstance(self.policy, Refined):  # was rolled out just now
            policy_harm = self.policy.predicted_harm[rows]
        else:
            policy_harm = self._harm(worlds, self._stage, vehicle)
        bound = self.backup.predicted_harm[rows]
        if self.bound == "coupled":
            bound = self._harm(worlds, FixedCommand(-self.backup.deceleration_mps2[rows]), vehicle)
        self.bound_harm = place(self.bound_harm, rows, bound)
        self.policy_harm = place(self.policy_harm, rows, policy_harm)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Wanted signed acceleration of the chosen strategy, [n] m/s2."""
        self.policy_harm = recall(self.policy_harm, worlds.n, self.name)  # of this batch; an earlier one may be larger
        self.bound_harm = recall(self.bound_harm, worlds.n, self.name)
        return np.where(self.chosen_policy, ask_script(self.policy, worlds, vehicle), self.backup.act(worlds, vehicle))

    def _harm(self, worlds: Worlds, agent: Agent, vehicle: int) -> Floats:
        return drive(worlds, agent, self.scenario, vehicle).ledger.world_harm(self.harm_count)


class FixedCommand:
    """One given command per world, for all of its episode."""

    name = "fixed"

    def __init__(self, command_mps2: Floats) -> None:
        self.command_mps2 = command_mps2

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Nothing to prepare."""

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The command of each world, [n] m/s2."""
        return self.command_mps2


class _Asked(NamedTuple):
    """What was decided when the agent was asked last, and is not known to be carried out."""

    time_s: Floats  # [n] of the worlds then
    certified: Certified
    wanted: Floats  # [n] m/s2


class StepShieldAgent(AgentAround):
    """Drives by ``policy``, any agent, as far as ``StepShield`` certifies it in the ``scenario``.

    At the alert the policy is rolled out once: where it harms no more than the coupled optimum, it drives unhindered,
    and its harm is the bound. Elsewhere each action must be certified: by the rest of the plan, by a constant, or by
    the policy, rolled out from the state after the action. After ``begin``, ``predicted_harm`` [n] is the bound. Raises
    ``InvalidInput`` for what is not an agent, and what ``StepShield`` raises.

    Args:
        harm_count, allowance, logging, cap, robust: as ``ShieldOptions``.
        later_rollouts: whether the policy itself may certify an action.
        uncertainty: robust mode: what is certified must hold in every member.
        believed: worlds at the alert as the shield takes them to be; None: as they are, which is what the policy sees.

    """

    adds = Source.MODEL  # in which actions are certified

    def __init__(
        self,
        policy: Agent,
        scenario: Scenario,
        *,
        harm_count: HarmCount = "first",
        allowance: float = 0.0,
        logging: bool = False,
        later_rollouts: bool = True,
        uncertainty: Uncertainty | str | None = None,
        cap: Cap | None = None,
        robust: str = "corners",
        believed: Worlds | None = None,
    ) -> None:
        check_agent(policy, "step")
        check_scenario(scenario, "step")
        if not (believed is None or isinstance(believed, Worlds)):
            raise InvalidInput(f"step: believed = {believed!r}: must be worlds at the alert, or None")
        uncertainty = checked_uncertainty(uncertainty)
        mode = "step" if uncertainty is None else "robust" if robust == "corners" else f"robust:{robust}"
        super().__init__(policy, f"{policy.name}+{mode}")
        self.scenario = scenario
        self.shield: StepShield | None = None
        self.predicted_harm: Floats = np.zeros(0)
        self._believed = believed
        self._settings = {
            "harm_count": harm_count, "allowance": allowance, "uncertainty": uncertainty, "cap": cap, "robust": robust,
            "logging": logging,
        }  # fmt: skip
        self._later_rollouts = later_rollouts
        self._wanted: Floats = np.zeros(0)
        self._first_s: Floats = np.zeros(0)  # [n] time of the first decision
        self._asked: _Asked | None = None
        self._make(scenario.learners[0] if len(scenario.learners) == 1 else 0)  # refuses bad settings at once

    @property
    def chosen_policy(self) -> Bools:
        """Where everything proposed was applied so far, [n]."""
        assert self.shield is not None
        untouched: Bools = self.shield.interventions == 0
        return untouched

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Find the bound of these rows; ``worlds`` holds those rows only, at the alert."""
        self.begin_all(worlds, vehicle, {vehicle: self.policy}, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The certified command, [n] m/s2. Asked again at the same moment, it says the same.

        In a world whose episode is over as far as the shield foretold, it is full braking.

        Raises ``UncertifiedStep`` where a decision was left out.
        """
        return self.act_all(worlds, vehicle, {vehicle: self.policy})

    def begin_all(
        self, worlds: Worlds, vehicle: int | tuple[int, ...], policies: Mapping[int, Agent], rows: Ints
    ) -> None:
        """``begin`` for one vehicle or several, each with the policy that proposes for it."""
        if self._believed is not None and not (rows < self._believed.n).all():
            raise InvalidInput(
                f"step: believed holds {count_of(self._believed.n, 'world')}, but row {rows.max()} begins"
            )
        if self.shield is None or self.shield.vehicle != vehicle:
            self.shield, self._asked = self._make(vehicle), None
        if self._asked is not None and len(rows) < len(self._wanted):
            self._commit(self._asked)  # some episodes of a batch are renewed: that step was made
        scripts = script_agents(self.scenario, except_for=list(policies))
        for i, policy in policies.items():
            set_others(policy, i, scripts)
            begin_script(policy, worlds, i, rows)
        self.shield.begin(worlds if self._believed is None else self._believed.take(rows), rows, policies)
        bound = self.shield.first_bound[rows] + self.shield.allowance
        self.predicted_harm = place(self.predicted_harm, rows, bound)
        self._wanted = place(self._wanted, rows, np.zeros((worlds.n, *self.shield.backup.plan.shape[2:])))
        self._first_s = place(self._first_s, rows, first_decision_s(worlds, list(policies)))
        self._asked = None

    def act_all(self, worlds: Worlds, vehicle: int | tuple[int, ...], policies: Mapping[int, Agent]) -> Floats:
        """``act`` for one vehicle, [n], or several, [n, K] m/s2."""
        shield = self.shield
        if shield is None or shield.running is None or len(self._wanted) < worlds.n:
            raise InvalidInput(
                f"agent {self.name!r}: act on {count_of(worlds.n, 'world')}, but begin was not called for each"
            )
        if len(self._wanted) > worlds.n:  # a smaller batch has begun
            shield.keep(worlds.n)
            self.predicted_harm, self._wanted, self._first_s = (
                values[: worlds.n] for values in (self.predicted_harm, self._wanted, self._first_s)
            )
        self._follow(self._on_grid(worlds.time_s))
        if self._asked is None:
            if (worlds.time_s != (time_s := self._on_grid(worlds.time_s))).any():
                worlds = replace(worlds, time_s=time_s)
            finished = shield.running.finished
            due = self._due(worlds) & ~finished
            proposed = proposed_actions(policies, worlds, isinstance(vehicle, int))
            proposer = Proposer(policies, worlds) if self._later_rollouts else None
            certified = shield.propose(proposed, seen=state_columns(worlds), only=due, proposer=proposer)
            applied = by_vehicle(certified.decision.applied, shield.vehicles)
            columns = [action_to_command(applied[:, c], worlds.vehicles, i) for c, i in enumerate(shield.vehicles)]
            command = columns[0] if isinstance(vehicle, int) else np.stack(columns, axis=1)
            wanted = self._wanted.copy()
            wanted[due] = command[due]
            for c, i in enumerate(shield.vehicles):  # nothing is certified after its own end: it holds the brakes
                by_vehicle(wanted, shield.vehicles)[finished, c] = -worlds.vehicles.braking_capacity_mps2[finished, i]
            self._asked = _Asked(worlds.time_s, certified, wanted)
        return self._asked.wanted.copy()

    def after_step(self, packed: Packed) -> None:
        """Follow the engine over a step, the last one included, and compare what came of it with what was certified.

        Where nothing else was ``believed`` than what was told, a difference raises ``UncertifiedStep``: another command
        was applied. Else the world is distrusted.
        """
        asked, shield, time_s = self._asked, self.shield, packed.state[:, TIME]
        self._follow(time_s)
        if asked is None or shield is None or self._asked is asked:
            return
        assert shield.running is not None
        seen = seen_columns(packed)
        compared = asked.certified.asked & (time_s > asked.time_s) & ~shield.distrusted
        wrong = compared & ~expects(shield.boxes, shield.running, seen)
        if self._believed is None and wrong.any():
            k = int(np.argmax(wrong))
            told = difference(shield.running.nominal().states[k], seen[k])
            raise UncertifiedStep(
                f"agent {self.name!r}: after this step {told} (world {k}); what drives by this agent must pass its"
                " commands on unchanged, and ask it at every decision"
            )
        shield.distrusted = shield.distrusted | wrong

    def _on_grid(self, time_s: Floats) -> Floats:
        """The times [n] without the last rounding of whoever keeps the clock: 6 x 0.1 s is the decision at 0.6 s."""
        assert self.shield is not None and self.shield.running is not None
        due_s = decision_s(self._first_s, self.scenario.time_step_s, self.shield.running.steps)
        return np.where(np.abs(time_s - due_s) <= CLOCK * self.scenario.time_step_s, due_s, time_s)

    def _due(self, worlds: Worlds) -> Bools:
        """Where a decision is due now, [n]. Raises ``UncertifiedStep`` where one was due, and nobody asked."""
        assert self.shield is not None and self.shield.running is not None
        running, step_s = self.shield.running, self.scenario.time_step_s
        due_s = decision_s(self._first_s, step_s, running.steps)
        late = ~running.finished & (worlds.time_s > due_s + step_s / 2)
        if late.any():
            k = int(np.argmax(late))
            raise UncertifiedStep(
                f"agent {self.name!r}: asked at {worlds.time_s[k]:g} s in world {k}, but a decision was due at"
                f" {due_s[k]:g} s; what drives by this agent must ask it at every decision, and once"
            )
        due: Bools = worlds.time_s == due_s
        return due

    def _follow(self, time_s: Floats) -> None:
        """Commit what was decided if the worlds have moved since: that step was made. Else it stays to be made."""
        asked = self._asked
        if asked is not None and (time_s > asked.time_s).any():
            self._commit(asked)

    def _commit(self, asked: _Asked) -> None:
        assert self.shield is not None
        if asked.certified.before is self.shield.running:  # else an interrupt came between the next two lines
            self.shield.commit(asked.certified)
        self.__dict__.update(_wanted=asked.wanted, _asked=None)

    def _make(self, vehicle: int | tuple[int, ...]) -> StepShield:
        return StepShield(self.scenario, vehicle, **self._settings)  # type: ignore[arg-type]


# A team behind one step shield: every proposal is known before any action is applied.


class ShieldedTeam(Team):
    """Every driver of a ``team`` proposes, and one ``StepShield`` certifies or replaces what they do together.

    The settings are those of ``StepShieldAgent``. After ``begin``, ``predicted_harm`` [n] is the bound.
    Raises ``InvalidInput`` for a learner of the scenario that the team does not drive, and what ``StepShield`` raises.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("cooperation-3-pair")
    >>> team = eb.make_agent("full_brake+step", scenario=scenario)
    >>> sorted(team.drivers), team.name
    ([1, 2], 'full_brake+step')

    """

    def __init__(self, team: Team, scenario: Scenario, **settings: Any) -> None:
        if undriven := [scenario.vehicle_names[i] for i in scenario.learners if i not in team.drivers]:
            raise InvalidInput(
                f"team {team.name!r}: does not drive {', '.join(undriven)}; beside a shielded vehicle every other one"
                " is shielded too, or follows a script"
            )
        self.together = _Together(copy.deepcopy(team), scenario, settings)
        super().__init__({i: _Member(self.together, i) for i in team.drivers}, f"{team.name}+step")

    @property
    def policy(self) -> Team:
        """Who proposes: the team as it is without a shield."""
        return Team(self.together.policies, self.name.removesuffix("+step"))

    @property
    def shield(self) -> StepShield | None:
        """The shield as it is now; None before an episode began."""
        return self.together.shield

    @property
    def predicted_harm(self) -> Floats:
        """The bound at the alert, [n] m2/s2."""
        return self.together.predicted_harm

    @property
    def chosen_policy(self) -> Bools:
        """Where everything proposed was applied so far, [n]."""
        return self.together.chosen_policy


class _Together(StepShieldAgent):
    """The shield of a team, and who proposes; what the first member is told, or asks, is done for all."""

    def __init__(self, team: Team, scenario: Scenario, settings: dict[str, Any]) -> None:
        self.policies = team.drivers
        self.vehicles = tuple(team.drivers)  # front to rear
        self._told: set[int] = set()  # members that know of the episodes that began last
        super().__init__(team.drivers[self.vehicles[0]], scenario, **settings)

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Find the bound once for all members."""
        if not self._told or vehicle in self._told:
            self._told = set()
            self.begin_all(worlds, self.vehicles, self.policies, rows)
        self._told.add(vehicle)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """The certified command of one member, [n] m/s2; all are decided when the first one asks."""
        return self.act_all(worlds, self.vehicles, self.policies)[:, self.vehicles.index(vehicle)].copy()


class _Member(AgentAround):
    """One driver of a shielded team."""

    adds = StepShieldAgent.adds

    def __init__(self, together: _Together, vehicle: int) -> None:
        policy = together.policies[vehicle]
        super().__init__(policy, f"{policy.name}+step")
        self.together = together

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """As all of them."""
        self.together.begin(worlds, vehicle, rows)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """Its own command, [n] m/s2."""
        return self.together.act(worlds, vehicle)

    def after_step(self, packed: Packed) -> None:
        """Follow the engine; the first member that is told does it for all."""
        self.together.after_step(packed)


def shield_around(agent: Agent) -> StepShield | None:
    """The step shield of an agent, or of the shielded team that it is a member of; None where there is none yet."""
    if isinstance(agent, _Member):
        return agent.together.shield
    return agent.shield if isinstance(agent, StepShieldAgent) else None


def drives_alone(driver: Driver) -> Agent | ShieldedTeam | None:
    """Who may say something about a whole world: an agent, the only driver of a team, or a shielded team."""
    if isinstance(driver, ShieldedTeam) or not isinstance(driver, Team):
        return driver
    return next(iter(driver.drivers.values())) if len(driver.drivers) == 1 else None


# Drivers behind one step shield: what they did, and what the shield did to them, world by world.

CHUNK = 500  # worlds advanced together: bounds memory, changes no result

Behind = StepShieldAgent | ShieldedTeam


class Shielded(NamedTuple):
    """Episodes behind a step shield: n worlds (any axes before), N vehicles, K of them shielded."""

    harm: Floats  # [n] of the count that is guarded (m2/s2)
    vehicle_harm: Floats  # [n, N] what each vehicle bears of it
    bound: Floats  # [n] that was told at the alert, with the allowance
    baseline: Floats  # [n, N] what each vehicle bears under the baseline plan
    replaced: Ints  # [n, K] decisions of each shielded vehicle that were replaced
    decisions: Ints  # [n] of each of them
    moving: Bools  # [n] the horizon cut the episode off


def put_shield(driver: Driver, task: Task, **settings: Any) -> Behind:
    """A copy of the ``driver`` behind one step shield: around one agent where one vehicle learns, else around a team.

    The settings are those of ``StepShieldAgent`` and ``ShieldedTeam``. Raises what they raise.
    """
    team = team_of(driver, task.vehicles)
    if len(task.vehicles) == 1:
        return StepShieldAgent(team.drivers[task.vehicles[0]], task.scenario, harm_count=task.harm_count, **settings)
    return ShieldedTeam(team, task.scenario, harm_count=task.harm_count, **settings)


def drive_behind(behind: Behind, worlds: Worlds, task: Task) -> Shielded:
    """Let what is behind a shield drive all worlds at once; it then holds the log of these episodes, if it keeps one.

    Raises ``PhysicsError`` naming the worlds that could not be advanced.
    """
    alone = None if isinstance(behind, ShieldedTeam) else task.vehicle
    episodes = drive(worlds, behind, task.scenario, alone)
    shield = behind.shield
    assert shield is not None and shield.running is not None
    return Shielded(
        episodes.ledger.world_harm(task.harm_count),
        episodes.ledger.vehicle_harm(task.harm_count),
        shield.first_bound + shield.allowance,
        shield.baseline_shares,
        shield.replaced.reshape(worlds.n, -1),
        shield.running.steps.copy(),
        ~episodes.at_rest,
    )


def drive_chunks(driver: Driver, worlds: Worlds, task: Task, **settings: Any) -> Shielded:
    """Let a copy of the ``driver`` drive every world behind a step shield, ``CHUNK`` at a time; as ``put_shield``."""
    parts = []
    for first in range(0, worlds.n, CHUNK):
        rows = np.arange(first, min(first + CHUNK, worlds.n))
        with renumbered(rows):
            parts.append(drive_behind(put_shield(driver, task, **settings), worlds.take(rows), task))
    return join(parts)


def join(parts: Sequence[Shielded]) -> Shielded:
    """Consecutive worlds as one."""
    return Shielded(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def stack(parts: Sequence[Shielded]) -> Shielded:
    """Several drivers in the same worlds, on an axis in front."""
    return Shielded(*(np.stack(columns) for columns in zip(*parts, strict=True)))


def shield_of(behind: Behind) -> StepShield:
    """The shield as it is now, after an episode began."""
    assert behind.shield is not None
    return behind.shield


# Factories of what the registry puts around an agent: the shields, with and without ``:believed``.


class BelievingHybrid(Believing):
    """Algorithm 1 on what was received: at the first decision policy and E-V2X-BM are compared as is believed."""

    policy: HybridAgent

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, which drives by what it observes, and what the comparison adds."""
        return combine(self.policy.policy, also=Source.BELIEFS)

    def _begin_policy(self, believed: Worlds, vehicle: int, rows: Ints) -> None:
        """The comparison is a rollout, which begins at t = 0 without impacts: the same line, its clock put back."""
        v, n = believed.vehicles, believed.n
        latency = np.maximum(v.latency_s - believed.time_s[:, np.newaxis], 0.0)
        vehicles = vehicles_at_once(
            v.braking_capacity_mps2, v.driving_capacity_mps2, latency, v.mass_t, v.speed_limit_mps, v.restitution
        )
        line = replace(
            believed, vehicles=vehicles, time_s=np.zeros(n), pair_hit=np.zeros_like(believed.pair_hit),
            obstacle_hit=np.zeros(n, np.bool_),
        )  # fmt: skip
        super()._begin_policy(line, vehicle, rows)


def shield_episodes(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+episode`` or ``+episode:pairwise`` around an agent, with ``:believed`` behind on what was received."""
    pairwise, believes = split_believed(argument)
    bound: Bound = "coupled" if pairwise is None else "pairwise"
    scenario = settings.needed_scenario()
    hybrid = HybridAgent(policy, scenario, bound=bound, harm_count=settings.harm_count)
    if believes and isinstance(policy, Believing):
        raise InvalidInput(f"agent {settings.spec!r}: {policy.name} decides on what was received itself; take +step")
    return BelievingHybrid(hybrid, scenario) if believes else hybrid


def shield_steps(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """``+step`` around an agent or a team, where several vehicles learn around a copy for each; ``+step:believed``."""
    scenario, harm_count, believes = settings.needed_scenario(), settings.harm_count, split_believed(argument)[1]
    if not isinstance(policy, Team) and len(scenario.learners) <= 1:
        make = BelievedShieldAgent if believes else StepShieldAgent
        return make(policy, scenario, harm_count=harm_count)
    if believes:
        raise InvalidInput(f"agent {settings.spec!r}: :believed shields one learner, not several; take +step")
    team = policy if isinstance(policy, Team) else Team.copies(policy, scenario.learners)
    return ShieldedTeam(team, scenario, harm_count=harm_count)


def shield_steps_robustly(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+robust`` or ``+robust:interior``, against the uncertainty of the settings.

    With ``:believed`` behind, against all that was not received, without one.
    """
    scenario, where, harm_count = settings.needed_scenario(), f"agent {settings.spec!r}", settings.harm_count
    certainty, believes = split_believed(argument)
    robust = checked_robust(certainty or CORNERS, where)
    if believes:
        return BelievedShieldAgent(policy, scenario, harm_count=harm_count, robust=robust)
    uncertainty = mode_uncertainty("robust", settings.uncertainty, where)
    return StepShieldAgent(policy, scenario, harm_count=harm_count, uncertainty=uncertainty, robust=robust)
