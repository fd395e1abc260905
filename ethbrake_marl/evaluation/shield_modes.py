"""The modes of the shield compared on the same worlds: harm, and what each intervention was good for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.table import Table

from ethbrake_marl.agents.protocol import Agent, Driver, Team, team_of
from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.errors import renumbered
from ethbrake_marl.evaluation.inputs import policies_by_name, policy_sha256, result_identity
from ethbrake_marl.evaluation.rollout import OnWorlds
from ethbrake_marl.evaluation.statistics import mean, paired_difference
from ethbrake_marl.files.sheet import Estimate, estimates_to_json
from ethbrake_marl.physics import Floats, Ints, LeftOutRows, Worlds, measured_without_failed
from ethbrake_marl.scenario import Sample, Task
from ethbrake_marl.shield import HybridAgent, ShieldedDriver
from ethbrake_marl.shield.guard import Shielded, join, put_shield, shielded_episodes
from ethbrake_marl.shield.review import SAME_HARM, VERDICTS, review

NONE, EPISODE, STEP = "none", "episode", "step"
STEP_ALERT, STEP_CAP = "step-alert", "step-cap"  # step mode: rollout at the alert only; no vehicle above its cap
CHUNK = 500  # worlds advanced together: bounds memory, changes no result


class VehicleRow(NamedTuple):
    """One vehicle of the line in step mode."""

    vehicle: str
    replaced: float | None  # share of its decisions; None: it is not shielded
    harm: float  # mean over worlds of what it bears (m2/s2)
    baseline: float  # ... of what it would bear under the baseline plan
    above_baseline: float  # share of the worlds in which it bears more than that


@dataclass(frozen=True, slots=True)
class ModeRow:
    """One agent, or one team, behind one mode of the shield."""

    agent: str
    mode: str
    harm: Estimate  # mean over worlds (m2/s2)
    horizon_ends: int  # worlds that the horizon cut off before the line stood: no bound says what comes after
    against_episode: Estimate | None  # minus that of episode mode, paired by world; None: of that itself, and of teams
    against_none: Estimate | None = None  # likewise, minus that without a shield
    # all that follows is of step mode alone
    replaced: float | None = None  # share of the decisions of all shielded vehicles
    bound: Estimate | None = None  # at the alert, mean over worlds (m2/s2)
    vehicles: tuple[VehicleRow, ...] = ()
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
            **estimates_to_json({"against_episode": self.against_episode, "against_none": self.against_none}),
            "decisions_replaced": self.replaced,
            **estimates_to_json({"bound": self.bound}),
            "vehicles": [vehicle._asdict() for vehicle in self.vehicles],
        }
        shares = (None,) * len(VERDICTS) if self.verdicts is None else self.verdicts
        told |= {**dict(zip(VERDICTS, shares, strict=True)), "above_bound": self.above_bound}
        told["policy_sha256"] = dict(self.policy_sha256)
        return {**told, "left_out": [{"world": world, "reason": reason} for world, reason in self.left_out]}


def compare_modes(
    agents: Mapping[str, Driver],
    worlds: Worlds,
    task: Task,
    *,
    on_progress: OnWorlds | None = None,
) -> list[ModeRow]:
    """Let every agent drive alone, in episode mode and in step mode, through every world; see ``ModeRow``.

    Where several vehicles learn, a team (an agent: a copy for each) drives alone, behind one step shield, and behind
    one that caps what each vehicle bears; episode mode is for one vehicle. Each replaced decision of step mode is
    simulated again without the shield (``shield.review.review``). The given agents are left as they are. A world that
    cannot be advanced with one of them is left out for all, and named in ``left_out``. Raises ``InvalidInput`` where a
    shield refuses the scenario, ``PhysicsError`` where no world is left.
    """
    rows, _, left_out = measured_without_failed(
        lambda at: _compare(agents, worlds.take(at), task, on_progress), worlds.n
    )
    named = {name: _policies(agent, task) for name, agent in agents.items()}
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
    behind = {name: agent.shield if isinstance(agent, Team) else agent for name, agent in agents.items()}
    proposers = {
        shielded.policy.name: shielded.policy
        for name, shielded in behind.items()
        if isinstance(shielded, HybridAgent) or (isinstance(shielded, ShieldedDriver) and "+robust" not in name)
    }
    return compare_modes(proposers, worlds, task) if proposers else []


def _policies(agent: Driver, task: Task) -> Mapping[str, str]:
    """Vehicle -> the SHA-256 of the policy that proposes for it, where one does."""
    drivers = agent.drivers if isinstance(agent, Team) else dict.fromkeys(task.vehicles, agent)
    found = {vehicle: policy_sha256(each) for vehicle, each in drivers.items()}
    return policies_by_name({vehicle: sha for vehicle, sha in found.items() if sha is not None}, task.scenario)


def _compare(agents: Mapping[str, Driver], worlds: Worlds, task: Task, on_progress: OnWorlds | None) -> list[ModeRow]:
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
        rows += _rows(name, parts, task)
    return rows


def are_teams(rows: Sequence[ModeRow]) -> bool:
    """Whether the rows are of several learners: there is no episode mode to compare with."""
    return all(row.against_episode is None for row in rows)


def modes_tables(rows: list[ModeRow]) -> list[Table]:
    """The rows for a terminal, below the name of each agent; of teams also what each vehicle bears."""
    return [_modes_table(rows), _shares_table(rows)] if are_teams(rows) else [_modes_table(rows)]


def _modes_table(rows: list[ModeRow]) -> Table:
    title = "Mean harm per world (m²/s²), difference with 95 % interval"
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("agent, mode", overflow="fold")
    several = are_teams(rows)
    against = "minus no shield" if several else "minus episode mode"
    for heading in ("harm", against, *(["bound"] if several else []), "replaced", *VERDICTS, "above"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        if row.mode == NONE:
            table.add_row(row.agent)
        shares = (None,) * len(VERDICTS) if row.verdicts is None else row.verdicts
        table.add_row(
            f"  {row.mode}",
            f"{row.harm.value:.2f}",
            _write_estimate(row.against_none if several else row.against_episode),
            *(["–" if row.bound is None else f"{row.bound.value:.2f}"] if several else []),
            *(_percent(share) for share in (row.replaced, *shares)),
            "–" if row.above_bound is None else str(row.above_bound),
        )
    return table


def _shares_table(rows: list[ModeRow]) -> Table:
    title = "What each vehicle bears, mean per world (m²/s²)"
    table = Table(box=box.SIMPLE_HEAD, title=title, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("agent, mode, vehicle", overflow="fold")
    for heading in ("replaced", "bears", "under the baseline plan", "worlds with more"):
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        if row.vehicles:
            table.add_row(f"{row.agent}, {row.mode}")
        for each in row.vehicles:
            harms = (f"{each.harm:.2f}", f"{each.baseline:.2f}")
            table.add_row(f"  {each.vehicle}", _percent(each.replaced), *harms, _percent(each.above_baseline))
    return table


class _Part(NamedTuple):
    """One chunk of worlds under one mode; what is not None is of step mode."""

    harm: Floats  # [n]
    moving: int  # worlds that the horizon cut off
    shielded: Shielded | None = None
    verdicts: Ints | None = None  # how many interventions got each of VERDICTS


def _measured(worlds: Worlds, agent: Driver, task: Task) -> dict[str, _Part]:
    """Each mode in one chunk."""
    several = len(task.vehicles) > 1
    found = {NONE: _alone(worlds, team_of(agent, task.vehicles), task)}
    if not several:
        assert isinstance(agent, Agent)
        hybrid = HybridAgent(agent, task.scenario, harm_count=task.harm_count)
        found[EPISODE] = _alone(worlds, Team({task.vehicle: hybrid}, hybrid.name), task)
    modes: dict[str, dict[str, Any]] = {STEP: {}, STEP_ALERT: {"later_rollouts": False}}
    for mode, settings in (modes | ({STEP_CAP: {"cap": "baseline"}} if several else {})).items():
        episodes = drive(worlds, put_shield(agent, task, logging=True, **settings), task.scenario)
        shielded = shielded_episodes(episodes, task)
        verdict = review(episodes.guarded.shield, agent, worlds).verdict
        counted = np.array([int((verdict == each).sum()) for each in VERDICTS])
        found[mode] = _Part(shielded.harm, int(shielded.moving.sum()), shielded, counted)
    return found


def _alone(worlds: Worlds, team: Team, task: Task) -> _Part:
    episodes = drive(worlds, team, task.scenario)
    return _Part(episodes.ledger.world_harm(task.harm_count), int((~episodes.at_rest).sum()))


def _rows(name: str, parts: list[dict[str, _Part]], task: Task) -> list[ModeRow]:
    harm = {mode: np.concatenate([part[mode].harm for part in parts]) for mode in parts[0]}

    def minus(mode: str, other: str) -> Estimate | None:
        return None if mode == other or other not in harm else paired_difference(harm[mode], harm[other])

    rows = []
    for mode in harm:
        moving = sum(part[mode].moving for part in parts)
        row = ModeRow(name, mode, mean(harm[mode]), moving, minus(mode, EPISODE), minus(mode, NONE))
        rows.append(
            row if parts[0][mode].shielded is None else _in_step_mode(row, [part[mode] for part in parts], task)
        )
    return rows


def _in_step_mode(row: ModeRow, parts: list[_Part], task: Task) -> ModeRow:
    """The row with what the shield did."""
    whole = join([part.shielded for part in parts if part.shielded is not None])
    counted = np.sum([part.verdicts for part in parts if part.verdicts is not None], axis=0).tolist()
    decisions, replaced = int(whole.decisions.sum()), sum(counted)
    each = dict(zip(task.vehicles, (whole.replaced.sum(axis=0) / decisions).tolist(), strict=True))
    above = (whole.vehicle_harm > whole.baseline + SAME_HARM).mean(axis=0)
    return replace(
        row,
        replaced=replaced / (decisions * len(task.vehicles)),
        bound=mean(whole.bound),
        verdicts=tuple(count / replaced for count in counted) if replaced else None,
        above_bound=int((whole.harm > whole.bound).sum()),
        vehicles=tuple(
            VehicleRow(
                vehicle, each.get(i), float(whole.vehicle_harm[:, i].mean()), float(whole.baseline[:, i].mean()),
                float(above[i]),
            )
            for i, vehicle in enumerate(task.scenario.vehicle_names)
        ),
    )  # fmt: skip


def _write_estimate(estimate: Estimate | None) -> str:
    if estimate is None:
        return "–"
    interval = "" if estimate.interval is None else f" [{estimate.interval[0]:+.2f}, {estimate.interval[1]:+.2f}]"
    return f"{estimate.value:+.2f}{interval}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100.0 * share:.1f} %"
