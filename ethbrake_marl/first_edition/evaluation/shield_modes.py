"""Comparison of the shield's modes in the same worlds: harm, and whether each intervention of the shield helped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from ethbrake_marl.errors import renumbered
from ethbrake_marl.files.sheet import Column, Estimate, Row, Sheet
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, Team
from ethbrake_marl.first_edition.evaluation.identity import policies_of, result_identity
from ethbrake_marl.first_edition.evaluation.statistics import Texts, mean, paired_difference
from ethbrake_marl.first_edition.physics.left_out import LeftOutRows, measured_without_failed
from ethbrake_marl.first_edition.physics.state import Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.episodes import Shielded
from ethbrake_marl.first_edition.shields.evidence import SAME_HARM, VERDICTS, review
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent

# ``step-alert``: step mode with rollouts of the policy at the alert only; ``step-cap``: step mode with caps.
Mode = Literal["none", "episode", "step", "step-alert", "step-cap"]

CHUNK = 500  # number of worlds simulated together, to limit memory; does not change results


class VehicleRow(NamedTuple):
    """Results of one vehicle of the line under a shield in step mode."""

    vehicle: str  # name of the vehicle, such as ``vehicle_2``
    replaced: float | None  # fraction of the vehicle's decisions that the shield replaced; None: it has no shield
    harm: float  # mean harm per world that the vehicle bears (m2/s2)
    baseline: float  # mean harm that it would bear under the shield's baseline plan (m2/s2)
    above_baseline: float  # fraction of worlds in which it bears more harm than under the baseline plan


@dataclass(frozen=True, slots=True)
class ModeRow:
    """Results of one agent or team with the shield in one mode."""

    agent: str  # name without the shield
    mode: Mode  # ``none``: without a shield
    harm: Estimate  # mean harm per world (m2/s2)
    horizon_ends: int  # number of worlds in which a vehicle still moves at the horizon; no bound covers later harm
    # Harm minus the harm in episode mode, paired by world (m2/s2); None in episode mode itself, and for teams.
    against_episode: Estimate | None
    # Harm minus the harm without a shield, paired by world (m2/s2); None without a shield.
    against_none: Estimate | None = None
    # The fields from ``replaced`` to ``above_bound`` have values in step mode and its variants only.
    replaced: float | None = None  # fraction of all decisions of shielded vehicles that the shield replaced
    bound: Estimate | None = None  # mean over worlds of the shield's bound at the alert (m2/s2)
    vehicles: tuple[VehicleRow, ...] = ()  # front to rear
    # Fractions of the replaced decisions that were needed (harm would be higher without the replacement), harmless
    # (equal) and costly (lower), in this order; None if the shield replaced no decision.
    verdicts: tuple[float, ...] | None = None
    above_bound: int | None = None  # number of worlds whose harm exceeds the bound at the alert
    left_out: LeftOutRows = ()  # (row, reason) of each world left out because it failed with some agent
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle's name -> SHA-256 of its policy

    def to_json(self) -> dict[str, Any]:
        """Return the row as an object for JSON; missing values are null, and intervals are ``[low, high]``."""
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
    """Result of ``compare_modes``: a list with one row for each pair of an agent and a mode of the shield."""

    @property
    def of_teams(self) -> bool:
        """Whether the agents are teams of several vehicles; the shield has no episode mode for teams."""
        return all(row.against_episode is None for row in self)

    def to_json(self, sample: Sample, task: Task) -> list[dict[str, Any]]:
        """Return the content of a results file of ``ethbrake shield``: one object per agent and mode.

        ``sample`` and ``task`` are what ``compare_modes`` evaluated.
        """
        left_out = [world for world, _ in self[0].left_out]
        about = result_identity("shield", task.scenario, sample, left_out)
        about |= {"harm_count": task.harm_count, "episodes": sample.worlds.n - len(left_out)}
        if sample.clusters is not None:
            about["recordings"] = len(np.unique(np.delete(sample.clusters, left_out)))
        return [about | row.to_json() for row in self]

    def sheets(self) -> list[Sheet]:
        """Return tables for a terminal: harm of each agent in each mode; for teams also each vehicle's harm."""
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
        sheets = [Sheet(title, [*head, share("replaced"), *map(share, VERDICTS), Column("above")], lines, gap=2)]
        if teams:
            head = [Column("agent, mode, vehicle", text=True), share("replaced"), Column("bears")]
            head += [Column("under the baseline plan"), share("worlds with more")]
            bears = [(f"{row.agent}, {row.mode}, {each.vehicle}", *each[1:]) for row in self for each in row.vehicles]
            sheets.append(Sheet("What each vehicle bears, mean per world (m²/s²)", head, bears, gap=2))
        return sheets


def compare_modes(
    agents: Mapping[str, Driver],
    worlds: Worlds,
    task: Task,
    *,
    behind: bool = False,
    clusters: Texts | None = None,
    on_progress: Callable[[str, int], None] | None = None,
) -> ShieldModes:
    """Compare every agent in the same worlds: without a shield, and with a shield in episode mode and in step mode.

    Two variants of step mode are also compared. In ``step-alert`` the shield simulates the policy's rollout only at the
    alert. In ``step-cap`` the shield limits each vehicle's harm (``cap="baseline"``). Teams have ``step-cap`` and no
    episode mode; single agents have episode mode and no ``step-cap``. To judge each decision in which step mode
    replaced the policy's action, the episode is simulated again, and from this decision on the policy drives without a
    shield. If the simulation of a world fails with one agent, the world is left out for all agents.

    Args:
        agents: agents or teams by name, without a shield (unless ``behind``). The objects that you pass do not change.
        worlds: worlds at the alert.
        task: the scenario, the controlled vehicles, and the count of harm that the shield bounds.
        behind: whether ``agents`` already have shields. If so, the policies behind shields in episode or step mode are
            compared, and other agents are omitted. If no agent has such a shield, the result is empty.
        clusters: name of each world's recording, [n]; None: all worlds are independent.
        on_progress: called with an agent's name and the number of worlds that the agent has driven so far.

    Raises ``InvalidInput`` if a shield refuses the scenario, and ``PhysicsError`` if every world is left out.

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
        lambda at: _compare(agents, worlds.take(at), task, None if clusters is None else clusters[at], on_progress),
        worlds.n,
    )
    drivers = {
        name: agent.drivers if isinstance(agent, Team) else dict.fromkeys(task.vehicles, agent)
        for name, agent in agents.items()
    }
    named = {name: policies_of(each) for name, each in drivers.items()}
    return ShieldModes(replace(row, left_out=left_out, policy_sha256=named[row.agent]) for row in rows)


class _Part(NamedTuple):
    """Results of an agent in some worlds with the shield in one mode."""

    harm: Floats  # [n] harm of the line in each world (m2/s2)
    moving: int  # number of worlds in which a vehicle still moves at the horizon
    # The next two fields have values in step mode and its variants only.
    shielded: Shielded | None = None
    verdicts: Ints | None = None  # [3] numbers of interventions that were needed, harmless and costly


def _compare(
    agents: Mapping[str, Driver],
    worlds: Worlds,
    task: Task,
    clusters: Texts | None,
    on_progress: Callable[[str, int], None] | None,
) -> list[ModeRow]:
    """Return the rows of ``compare_modes``; raise ``PhysicsError``, which lists the worlds whose simulation failed."""
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
        rows += [_row(name, mode, [part[mode] for part in parts], harm, task, clusters) for mode in harm]
    return rows


def _measured(worlds: Worlds, agent: Driver, task: Task) -> dict[Mode, _Part]:
    """Let an agent or team drive ``worlds`` once in every mode of the shield."""
    several, parts = len(task.vehicles) > 1, {}
    alone: dict[Mode, Team] = {"none": Team.of(agent, task.vehicles)}
    if not several:
        assert isinstance(agent, Agent)
        hybrid = HybridAgent(agent, task.scenario, harm_count=task.harm_count)
        alone["episode"] = Team({task.vehicle: hybrid}, hybrid.name)
    for mode, team in alone.items():
        episodes = drive(worlds, team, task.scenario)
        parts[mode] = _Part(episodes.ledger.world_harm(task.harm_count), int((~episodes.at_rest).sum()))
    behind: dict[Mode, dict[str, Any]] = {"step": {}, "step-alert": {"later_rollouts": False}}
    behind |= {"step-cap": {"cap": "baseline"}} if several else {}
    for mode, settings in behind.items():
        episodes = drive(worlds, ShieldedDriver.around(agent, task, logging=True, **settings), task.scenario)
        shielded = Shielded.of(episodes, task)
        verdict = review(episodes.guarded.shield, agent, worlds).verdict
        counted = np.array([int((verdict == each).sum()) for each in VERDICTS])
        parts[mode] = _Part(shielded.harm, int(shielded.moving.sum()), shielded, counted)
    return parts


def _row(
    agent: str, mode: Mode, parts: list[_Part], harm: Mapping[Mode, Floats], task: Task, clusters: Texts | None
) -> ModeRow:
    """Return the row of one agent and one mode, from the results ``parts`` of each chunk of worlds.

    ``harm`` maps every mode to the harm of this agent in every world (m2/s2), [n].
    """

    def minus(other: Mode) -> Estimate | None:
        there = mode != other and other in harm
        return paired_difference(harm[mode], harm[other], clusters) if there else None

    moving = sum(part.moving for part in parts)
    row = ModeRow(agent, mode, mean(harm[mode], clusters), moving, minus("episode"), minus("none"))
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
        bound=mean(whole.bound, clusters),
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
