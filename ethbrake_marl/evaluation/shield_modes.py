"""The modes of the shield compared on the same worlds: harm, and what each intervention was good for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.agents.driving import drive
from ethbrake_marl.agents.protocol import Agent, Driver, Team
from ethbrake_marl.errors import renumbered
from ethbrake_marl.evaluation.identity import policies_of, result_identity
from ethbrake_marl.evaluation.statistics import mean, paired_difference
from ethbrake_marl.files.sheet import Column, Estimate, Row, Sheet
from ethbrake_marl.physics.left_out import LeftOutRows, measured_without_failed
from ethbrake_marl.physics.state import Floats, Ints, Worlds
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.task import Task
from ethbrake_marl.shield.drivers import ShieldedDriver
from ethbrake_marl.shield.episodes import Shielded
from ethbrake_marl.shield.evidence import SAME_HARM, VERDICTS, review
from ethbrake_marl.shield.paper_hybrid import HybridAgent

# ``step-alert``: rollout at the alert only; ``step-cap``: no vehicle above its cap.
Mode = Literal["none", "episode", "step", "step-alert", "step-cap"]

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
    mode: Mode
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
        shares = self.verdicts or (None,) * len(VERDICTS)
        return {
            "agent": self.agent,
            "mode": self.mode,
            **Estimate.side_by_side({"harm": self.harm}),
            "horizon_ends": self.horizon_ends,
            **Estimate.side_by_side({"against_episode": self.against_episode, "against_none": self.against_none}),
            "decisions_replaced": self.replaced,
            **Estimate.side_by_side({"bound": self.bound}),
            "vehicles": [vehicle._asdict() for vehicle in self.vehicles],
            **dict(zip(VERDICTS, shares, strict=True)),
            "above_bound": self.above_bound,
            "policy_sha256": dict(self.policy_sha256),
            "left_out": [{"world": world, "reason": reason} for world, reason in self.left_out],
        }


class ShieldModes(list[ModeRow]):
    """The rows of ``compare_modes``: every agent behind every mode."""

    @property
    def of_teams(self) -> bool:
        """Whether the rows are of several learners: there is no episode mode to compare with."""
        return all(row.against_episode is None for row in self)

    def to_json(self, sample: Sample, task: Task) -> list[dict[str, Any]]:
        """What a results file of ``ethbrake shield`` holds: one object per row, of the worlds of ``sample``."""
        left_out = [world for world, _ in self[0].left_out]
        about = result_identity("shield", task.scenario, sample, left_out)
        about |= {"harm_count": task.harm_count, "episodes": sample.worlds.n - len(left_out)}
        return [about | row.to_json() for row in self]

    def sheets(self) -> list[Sheet]:
        """The rows as tables, below the name of each agent; of teams also what each vehicle bears."""
        share, teams = partial(Column, digits=1, scale=100.0, unit=" %"), self.of_teams
        head = [Column("agent, mode", text=True), Column("harm", interval="hidden")]
        head += [Column("minus no shield" if teams else "minus episode mode", sign="+")]
        head += [Column("bound", interval="hidden")] if teams else []
        lines: list[Row] = []
        for row in self:
            lines += [(row.agent,)] if row.mode == "none" else []
            compared = (row.against_none, row.bound) if teams else (row.against_episode,)
            shares = row.verdicts or (None,) * len(VERDICTS)
            lines.append((f"  {row.mode}", row.harm, *compared, row.replaced, *shares, row.above_bound))
        title = "Mean harm per world (m²/s²), difference with 95 % interval"
        found = [Sheet(title, [*head, share("replaced"), *map(share, VERDICTS), Column("above")], lines, gap=2)]
        if teams:
            head = [Column("agent, mode, vehicle", text=True), share("replaced"), Column("bears")]
            head += [Column("under the baseline plan"), share("worlds with more")]
            bears = [(f"{row.agent}, {row.mode}, {each.vehicle}", *each[1:]) for row in self for each in row.vehicles]
            found.append(Sheet("What each vehicle bears, mean per world (m²/s²)", head, bears, gap=2))
        return found


def compare_modes(
    agents: Mapping[str, Driver],
    worlds: Worlds,
    task: Task,
    *,
    behind: bool = False,
    on_progress: Callable[[str, int], None] | None = None,
) -> ShieldModes:
    """Let every agent drive alone, in episode mode and in step mode, through every world; see ``ModeRow``.

    Where several vehicles learn, a team (an agent: a copy for each) drives alone, behind one step shield, and behind
    one that caps what each vehicle bears; episode mode is for one vehicle. Each replaced decision of step mode is
    simulated again without the shield (``shield.review.review``). The given agents are left as they are. A world that
    cannot be advanced with one of them is left out for all, and named in ``left_out``.

    ``behind``: of what is behind a shield among these agents, and nothing where nobody has one. Agents whose shield
    does not know the world are left out then: their modes are another question.

    Raises ``InvalidInput`` where a shield refuses the scenario, ``PhysicsError`` where no world is left.
    """
    if behind:
        shields = [agent.shield if isinstance(agent, Team) else agent for agent in agents.values()]
        agents = {
            shield.policy.name: shield.policy
            for shield in shields
            if isinstance(shield, HybridAgent) or (isinstance(shield, ShieldedDriver) and shield.options.mode == "step")
        }
        if not agents:
            return ShieldModes()
    rows, _, left_out = measured_without_failed(
        lambda at: _compare(agents, worlds.take(at), task, on_progress), worlds.n
    )
    drivers = {
        name: agent.drivers if isinstance(agent, Team) else dict.fromkeys(task.vehicles, agent)
        for name, agent in agents.items()
    }
    named = {name: policies_of(each) for name, each in drivers.items()}
    return ShieldModes(replace(row, left_out=left_out, policy_sha256=named[row.agent]) for row in rows)


class _Part(NamedTuple):
    """One chunk of worlds under one mode; what is not None is of step mode."""

    harm: Floats  # [n]
    moving: int  # worlds that the horizon cut off
    shielded: Shielded | None = None
    verdicts: Ints | None = None  # how many interventions got each of VERDICTS


def _compare(
    agents: Mapping[str, Driver], worlds: Worlds, task: Task, on_progress: Callable[[str, int], None] | None
) -> list[ModeRow]:
    """The rows of worlds that can all be advanced; ``PhysicsError`` names those that cannot."""
    rows = []
    for name, agent in agents.items():
        parts: list[dict[Mode, _Part]] = []
        for first in range(0, worlds.n, CHUNK):
            chunk = np.arange(first, min(first + CHUNK, worlds.n))
            with renumbered(chunk):
                parts.append(_measured(worlds.take(chunk), agent, task))
            if on_progress is not None:
                on_progress(name, min(first + CHUNK, worlds.n))
        harm = {mode: np.concatenate([part[mode].harm for part in parts]) for mode in parts[0]}
        rows += [_row(name, mode, [part[mode] for part in parts], harm, task) for mode in harm]
    return rows


def _measured(worlds: Worlds, agent: Driver, task: Task) -> dict[Mode, _Part]:
    """Each mode in one chunk."""
    several, found = len(task.vehicles) > 1, {}
    alone: dict[Mode, Team] = {"none": Team.of(agent, task.vehicles)}
    if not several:
        assert isinstance(agent, Agent)
        hybrid = HybridAgent(agent, task.scenario, harm_count=task.harm_count)
        alone["episode"] = Team({task.vehicle: hybrid}, hybrid.name)
    for mode, team in alone.items():
        episodes = drive(worlds, team, task.scenario)
        found[mode] = _Part(episodes.ledger.world_harm(task.harm_count), int((~episodes.at_rest).sum()))
    behind: dict[Mode, dict[str, Any]] = {"step": {}, "step-alert": {"later_rollouts": False}}
    behind |= {"step-cap": {"cap": "baseline"}} if several else {}
    for mode, settings in behind.items():
        episodes = drive(worlds, ShieldedDriver.around(agent, task, logging=True, **settings), task.scenario)
        shielded = Shielded.of(episodes, task)
        verdict = review(episodes.guarded.shield, agent, worlds).verdict
        counted = np.array([int((verdict == each).sum()) for each in VERDICTS])
        found[mode] = _Part(shielded.harm, int(shielded.moving.sum()), shielded, counted)
    return found


def _row(agent: str, mode: Mode, parts: list[_Part], harm: Mapping[Mode, Floats], task: Task) -> ModeRow:
    """One mode of an agent, from its parts and the harm under every mode; of step mode with what the shield did."""

    def minus(other: Mode) -> Estimate | None:
        return None if mode == other or other not in harm else paired_difference(harm[mode], harm[other])

    moving = sum(part.moving for part in parts)
    row = ModeRow(agent, mode, mean(harm[mode]), moving, minus("episode"), minus("none"))
    shielded = [part.shielded for part in parts if part.shielded is not None]
    if not shielded:
        return row
    whole = Shielded.join(shielded)
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
