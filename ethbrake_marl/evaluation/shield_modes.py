"""The modes of the shield compared on the same worlds: harm, and what each intervention was good for."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.agents.team import Driver
from ethbrake_marl.errors import renumbered
from ethbrake_marl.evaluation.identity import policies_by_name, policy_sha256, result_identity
from ethbrake_marl.evaluation.rollout import OnWorlds
from ethbrake_marl.evaluation.statistics import Estimate, estimates_to_json, mean, paired_difference
from ethbrake_marl.physics import Floats, LeftOutRows, Worlds, measured_without_failed
from ethbrake_marl.scenario import Sample, Task
from ethbrake_marl.shield import HybridAgent, StepShieldAgent
from ethbrake_marl.shield.review import VERDICTS, review

NONE, EPISODE, STEP, STEP_ALERT = "none", "episode", "step", "step-alert"  # the last: rollout at the alert only
CHUNK = 500  # worlds advanced together: bounds memory, changes no result


@dataclass(frozen=True, slots=True)
class ModeRow:
    """One agent behind one mode of the shield."""

    agent: str
    mode: str
    harm: Estimate  # mean over worlds (m2/s2)
    horizon_ends: int  # worlds that the horizon cut off before the line stood: no bound says what comes after
    against_episode: Estimate | None  # minus that of episode mode, paired by world; None: of episode mode itself
    replaced: float | None = None  # share of the decisions; of step mode alone, as all that follows
    verdicts: tuple[float, ...] | None = None  # shares of the replaced decisions, in the order of VERDICTS
    above_bound: int | None = None  # worlds whose realised harm is above the bound told at the alert
    left_out: LeftOutRows = ()  # worlds that could not be advanced: in no row, whichever agent and mode met them
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle -> the policy's that proposes, if one does

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; what does not exist is null, intervals are ``[low, high]``."""
        told: dict[str, Any] = {
            "agent": self.agent,
            "mode": self.mode,
            **estimates_to_json({"harm": self.harm}),
            "horizon_ends": self.horizon_ends,
            **estimates_to_json({"against_episode": self.against_episode}),
            "decisions_replaced": self.replaced,
        }
        shares = (None,) * len(VERDICTS) if self.verdicts is None else self.verdicts
        told |= {**dict(zip(VERDICTS, shares, strict=True)), "above_bound": self.above_bound}
        told["policy_sha256"] = dict(self.policy_sha256)
        return {**told, "left_out": [{"world": world, "reason": reason} for world, reason in self.left_out]}


def compare_modes(
    agents: Mapping[str, Agent],
    worlds: Worlds,
    task: Task,
    *,
    on_progress: OnWorlds | None = None,
) -> list[ModeRow]:
    """Let every agent drive the vehicle alone, in episode mode and in step mode, through every world; see ``ModeRow``.

    Each replaced decision of step mode is simulated again without the shield (``shield.review.review``). The given
    agents are left as they are. A world that cannot be advanced with one of them is left out for all, and named in
    ``left_out``. Raises ``InvalidInput`` where a shield refuses the scenario, ``PhysicsError`` where no world is left.
    """
    rows, _, left_out = measured_without_failed(
        lambda at: _compare(agents, worlds.take(at), task, on_progress), worlds.n
    )
    policies = {name: policy_sha256(agent) for name, agent in agents.items()}
    named = {
        name: {} if sha256 is None else policies_by_name({task.vehicle: sha256}, task.scenario)
        for name, sha256 in policies.items()
    }
    return [replace(row, left_out=left_out, policy_sha256=named[row.agent]) for row in rows]


def modes_to_json(rows: list[ModeRow], sample: Sample, task: Task) -> list[dict[str, Any]]:
    """What a results file of ``ethbrake shield`` holds: one object per row, of the worlds of ``sample``."""
    left_out = [world for world, _ in rows[0].left_out]
    about = result_identity("shield", task.scenario, sample, left_out)
    about |= {"harm_count": task.harm_count, "episodes": sample.worlds.n - len(left_out)}
    return [about | row.to_json() for row in rows]


def compare_behind_shields(agents: Mapping[str, Driver], worlds: Worlds, task: Task) -> list[ModeRow]:
    """``compare_modes`` of what is behind a shield among these agents; nothing where nobody has one.

    Agents whose shield does not know the world (``+robust``) are left out: their modes are another question.
    """
    proposers = {
        agent.policy.name: agent.policy
        for name, agent in agents.items()
        if isinstance(agent, HybridAgent | StepShieldAgent) and "+robust" not in name
    }
    return compare_modes(proposers, worlds, task) if proposers else []


def _compare(agents: Mapping[str, Agent], worlds: Worlds, task: Task, on_progress: OnWorlds | None) -> list[ModeRow]:
    """The rows of worlds that can all be advanced; ``PhysicsError`` names those that cannot."""
    rows = []
    for name, agent in agents.items():
        parts = []
        for first in range(0, worlds.n, CHUNK):
            chunk = np.arange(first, min(first + CHUNK, worlds.n))
            with renumbered(chunk):
                parts.append(_measured(worlds.take(chunk), agent, task))
            if on_progress is not None:
                on_progress(name, min(first + CHUNK, worlds.n))
        rows += _rows(name, parts)
    return rows


def modes_table(rows: list[ModeRow]) -> Table:
    """The rows for a terminal, below the name of each agent."""
    title = "Mean harm per world (m²/s²), difference with 95 % interval"
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("agent, mode", overflow="fold")
    for heading in ("harm", "minus episode mode", "replaced", *VERDICTS, "above"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        if row.mode == NONE:
            table.add_row(row.agent)
        shares = (None,) * len(VERDICTS) if row.verdicts is None else row.verdicts
        table.add_row(
            f"  {row.mode}",
            f"{row.harm.value:.2f}",
            _write_estimate(row.against_episode),
            *(_percent(share) for share in (row.replaced, *shares)),
            "–" if row.above_bound is None else str(row.above_bound),
        )
    return table


def _measured(worlds: Worlds, agent: Agent, task: Task) -> dict[str, Any]:
    """Of one chunk: harm per world under each mode, and what step mode replaced."""
    scenario, vehicle, harm_count = task.scenario, task.vehicle, task.harm_count
    found: dict[str, Any] = {}
    drivers: dict[str, Agent] = {
        NONE: copy.deepcopy(agent),
        EPISODE: HybridAgent(agent, scenario, harm_count=harm_count),
    }
    for name, later in ((STEP, True), (STEP_ALERT, False)):
        drivers[name] = StepShieldAgent(
            copy.deepcopy(agent), scenario, harm_count=harm_count, logging=True, later_rollouts=later
        )
    for name, driver in drivers.items():
        episodes = drive(worlds, driver, scenario, vehicle)
        harm = episodes.ledger.world_harm(harm_count)
        found[name], found[f"{name} moving"] = harm, int((~episodes.at_rest).sum())
        if isinstance(driver, StepShieldAgent):
            shield = driver.shield
            assert shield is not None and shield.running is not None
            verdict = review(driver, worlds, vehicle).verdict
            above = int((harm > shield.first_bound).sum())
            counted = [int((verdict == each).sum()) for each in VERDICTS]
            found[f"{name} counts"] = np.array([int(shield.running.steps.sum()), above, *counted])
    return found


def _rows(name: str, parts: list[dict[str, Any]]) -> list[ModeRow]:
    harm: dict[str, Floats] = {
        mode: np.concatenate([part[mode] for part in parts]) for mode in (NONE, EPISODE, STEP, STEP_ALERT)
    }
    moving = {mode: sum(part[f"{mode} moving"] for part in parts) for mode in harm}
    rows = [
        ModeRow(name, NONE, mean(harm[NONE]), moving[NONE], paired_difference(harm[NONE], harm[EPISODE])),
        ModeRow(name, EPISODE, mean(harm[EPISODE]), moving[EPISODE], None),
    ]
    for mode in (STEP, STEP_ALERT):
        decisions, above, *counted = np.sum([part[f"{mode} counts"] for part in parts], axis=0).tolist()
        replaced = sum(counted)
        shares = tuple(each / replaced for each in counted) if replaced else None
        difference = paired_difference(harm[mode], harm[EPISODE])
        rows.append(
            ModeRow(name, mode, mean(harm[mode]), moving[mode], difference, replaced / decisions, shares, above)
        )
    return rows


def _write_estimate(estimate: Estimate | None) -> str:
    if estimate is None:
        return "–"
    interval = "" if estimate.interval is None else f" [{estimate.interval[0]:+.2f}, {estimate.interval[1]:+.2f}]"
    return f"{estimate.value:+.2f}{interval}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100.0 * share:.1f} %"
