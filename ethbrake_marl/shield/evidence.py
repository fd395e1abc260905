"""Was an intervention needed? Every one is simulated again without it, and the price of the bound is measured."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.actions import action_to_command
from ethbrake_marl.agents import Agent, AgentAround, Driver, Team, drive
from ethbrake_marl.engine import Memory, Script
from ethbrake_marl.errors import InvalidInput, count_of, renumbered
from ethbrake_marl.physics import Bools, Decisions, Floats, Ints, LeftOutRows, Worlds, measured_without_failed
from ethbrake_marl.scenario import Task
from ethbrake_marl.shield.enclosure import CORNERS, checked_robust
from ethbrake_marl.shield.guard import Shielded, ShieldedDriver
from ethbrake_marl.shield.step_shield import StepShield, proposed_action
from ethbrake_marl.shield.uncertainty import Uncertainty

SAME_HARM = 1e-9  # harms (m2/s2) closer than this are one harm
ALLOWANCES = (0.0, 1.0, 3.0, 10.0, 30.0, 100.0, 1e6)  # m2/s2, of an operating curve
VERDICTS = ("needed", "harmless", "costly")


class Review(NamedTuple):
    """What each logged intervention of the running episodes was good for; m interventions."""

    world: Ints  # [m] row of the batch
    vehicle: Ints  # [m] whose action was replaced
    step: Ints  # [m] number of the decision
    realised: Floats  # [m] harm of the episode as it went (m2/s2)
    without: Floats  # [m] had the policy, or the whole team, driven alone from that decision on
    verdict: NDArray[np.str_]  # [m] one of VERDICTS
    trusted: Bools  # [m] nothing seen in that world contradicted the assumptions

    def share(self, verdict: str) -> float:
        """Share of the interventions with this verdict; 0 where there was none."""
        return float((self.verdict == verdict).mean()) if self.verdict.size else 0.0


def review(shield: StepShield, policy: Driver, worlds: Worlds) -> Review:
    """Simulate every intervention of a driven batch again without it: from there on the ``policy`` drives alone.

    ``shield`` (with ``logging``) as it was when the episodes of ``worlds``, which are at the alert, had ended; what was
    logged in earlier episodes is left out. ``policy`` proposed: an agent, or of several vehicles the whole team.
    *needed*: harm would have been higher; *costly*: lower; *harmless*: the same. What was realised is simulated again,
    too, so both harms are the engine's, also where the truth was not what the shield was told. Raises ``InvalidInput``
    without a log, or for another number of worlds.
    """
    if shield.log is None or shield.running is None:
        raise InvalidInput("review: nothing was logged; make the shield with logging=True, and drive behind it")
    if worlds.n != shield.running.n:
        raise InvalidInput(f"review: {count_of(worlds.n, 'world')}, but {shield.running.n} were driven last")
    log = [entry for entry in shield.log if entry.world < worlds.n and entry.episode == shield.episode[entry.world]]
    world = np.array([entry.world for entry in log], np.int64)
    step = np.array([entry.step for entry in log], np.int64)
    realised, without = np.zeros(0), np.zeros(0)
    if world.size:
        never = np.full(worlds.n, shield.backup.plan.shape[1])
        realised = _released_harm(shield, policy, worlds, np.arange(worlds.n), never)[world]
        without = _released_harm(shield, policy, worlds, world, step)
    verdict = np.where(without > realised + SAME_HARM, "needed", "harmless")
    verdict = np.where(without < realised - SAME_HARM, "costly", verdict)
    whose = np.array([entry.vehicle for entry in log], np.int64)
    return Review(world, whose, step, realised, without, verdict, ~shield.distrusted[world])


def _released_harm(shield: StepShield, policy: Driver, worlds: Worlds, world: Ints, step: Ints) -> Floats:
    """In some worlds [m], when what was applied is applied again up to decision ``step`` [m], then who proposes."""
    scenario, plan = shield.scenario, shield.backup.plan[world]
    actions = plan.reshape(*plan.shape[:2], len(shield.vehicles))
    again = {
        i: _Released(agent, actions[:, :, c], step, shield.vehicles, scenario.time_step_s)
        for c, (i, agent) in enumerate(Team.of(policy, shield.vehicles).drivers.items())
    }
    with renumbered(world):
        return drive(worlds.take(world), Team(again, "released"), scenario).ledger.world_harm(shield.harm_count)


class OperatingPoint(NamedTuple):
    """What the shield does at one allowance."""

    allowance: float  # m2/s2 above the bound that certificates may reach
    intervention_rate: float  # share of decisions, of all shielded vehicles together
    harm: float  # mean over worlds (m2/s2)
    left_out: LeftOutRows = ()  # worlds that could not be advanced: in no point, whichever allowance met them


def operating_curves(
    worlds: Worlds,
    policies: Mapping[str, Driver],
    task: Task,
    allowances: Sequence[float] = ALLOWANCES,
    *,
    on_progress: Callable[[str], None] | None = None,
) -> dict[str, list[OperatingPoint]]:
    """Interventions against residual harm for each policy: one point per allowance, from none to very large.

    A world that cannot be advanced in one of the cases is left out of all, and named in ``left_out``; ``on_progress``
    is told each policy that is done. Raises ``PhysicsError`` where no world is left.
    """

    def measured(at: Ints) -> dict[str, list[OperatingPoint]]:
        curves = {}
        for name, policy in policies.items():
            points = []
            for allowance in allowances:
                team = ShieldedDriver.around(policy, task, allowance=allowance)
                found = Shielded.of(drive(worlds.take(at), team, task.scenario), task)
                rate = float(found.replaced.sum() / (found.decisions.sum() * found.replaced.shape[1]))
                points.append(OperatingPoint(float(allowance), rate, float(found.harm.mean())))
            curves[name] = points
            if on_progress is not None:
                on_progress(name)
        return curves

    curves, _, left_out = measured_without_failed(measured, worlds.n)
    return {name: [point._replace(left_out=left_out) for point in points] for name, points in curves.items()}


class _Released(AgentAround):
    """Given actions [m, L] up to a step, and from that step on a policy."""

    def __init__(
        self, policy: Agent, actions: Floats, release: Ints, deciding: tuple[int, ...], time_step_s: float
    ) -> None:
        super().__init__(policy, "released")
        self._actions, self._release, self._time_step_s = actions, release, time_step_s
        self._deciding = deciding  # vehicles that decide together

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        return {"policy": super().begin(alert, vehicle, scripts), "first_s": alert.first_decision_s(self._deciding)}

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        own, policy = proposed_action(self.policy, worlds, memory["policy"], vehicle)
        step = Decisions(memory["first_s"], self._time_step_s).latest(worlds.time_s)
        held = self._actions[np.arange(len(step)), np.clip(step, 0, self._actions.shape[1] - 1)]
        action = np.where(step < self._release, held, own)
        return action_to_command(action, worlds.vehicles, vehicle), {**memory, "policy": policy}


# The cost of not knowing: robust mode's price, and harm where the truth is not what the shield believes.

WIDTHS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of a curve, in units of the intervals that are given
TRUTHS = ("as told", "inside", "corner")  # the world that was told; one evenly out of its box; one of the box's corners
MODES = ("step", "robust")

Progress = Callable[[str, int], None]  # what is driven, worlds done so far


class RobustnessPoint(NamedTuple):
    """How one shield did at one width of the intervals, in one kind of truth; means are over all worlds."""

    mode: str  # one of MODES; step mode believes what it is told
    truth: str  # one of TRUTHS
    width: float  # in units of the intervals that were given
    harm: float  # mean realised (m2/s2)
    bound: float  # mean stated at the alert (m2/s2)
    above: float  # share of worlds that realise more than the bound stated at the alert
    excess: float  # mean of how much more, 0 where it is not (m2/s2)
    distrusted: float  # share of worlds in which the shield noticed
    left_out: LeftOutRows = ()  # worlds that could not be advanced: in no point, whichever shield and truth met them


def robustness(
    worlds: Worlds,
    policy: Agent,
    task: Task,
    uncertainty: Uncertainty,
    *,
    widths: Sequence[float] = WIDTHS,
    seed: int = 0,
    robust: str = CORNERS,
    on_progress: Progress | None = None,
) -> list[RobustnessPoint]:
    """Both shields around ``policy`` in every kind of truth at each width; ``worlds`` is what the shields are told.

    The engine runs the truth, and the policy sees it; the shields begin with what they are told and see what happens.
    The numbers that place a truth in its box are those of ``seed``, the same for all widths. ``robust`` says what the
    robust shield certifies of a box, as in ``ShieldOptions``. A world that cannot be advanced in one of the cases is
    left out of all, and named in ``left_out``. Raises ``InvalidInput`` for no width or a negative one, ``UnknownName``
    for another ``robust``, ``PhysicsError`` where no world is left, and what ``ShieldedDriver`` raises.
    """
    checked_robust(robust, "robustness")
    if not widths or not all(0.0 <= width < np.inf for width in widths):
        raise InvalidInput(f"robustness: widths {tuple(widths)}: at least one is needed, each at least 0")
    try:
        uncertainty.scaled(max(widths)).draw(worlds, np.random.default_rng(seed))
    except InvalidInput as error:
        raise InvalidInput(f"{error}; widths of up to {max(widths):g} times those given are measured") from None

    def measured(at: Ints) -> list[RobustnessPoint]:
        points, known, told = [], dict[tuple[float, str, str], RobustnessPoint](), worlds.take(at)
        for width, truth, mode in itertools.product(map(float, widths), TRUTHS, MODES):
            alike = width == 0.0 or (mode, truth) == ("step", "as told")  # what is told is all that matters
            key = (0.0, "as told", "step") if alike else (width, truth, mode)
            if key not in known:
                intervals = uncertainty.scaled(width)
                shielded = ShieldedDriver(
                    policy, task.scenario, harm_count=task.harm_count, told=told,
                    uncertainty=intervals if mode == "robust" else None,
                    robust=robust if mode == "robust" else CORNERS,
                )  # fmt: skip
                driven = worlds
                if key[1] != "as told":  # drawn for all worlds: a truth does not depend on which of them are left out
                    driven = intervals.draw(worlds, np.random.default_rng(seed), corners=truth == "corner")
                episodes = drive(driven.take(at), shielded, task.scenario, task.vehicle)
                harm, shield = episodes.ledger.world_harm(task.harm_count), episodes.guarded.shield
                bound = shield.predicted_harm
                above = np.maximum(harm - bound, 0.0)
                known[key] = RobustnessPoint(
                    mode, truth, width, float(harm.mean()), float(bound.mean()), float((above > 0.0).mean()),
                    float(above.mean()), float(shield.distrusted.mean()),
                )  # fmt: skip
            points.append(known[key]._replace(mode=mode, truth=truth, width=width))
            if on_progress is not None:
                on_progress(f"{mode}, {truth}, width {width:g}", worlds.n)
        return points

    found, _, left_out = measured_without_failed(measured, worlds.n)
    return [point._replace(left_out=left_out) for point in found]
