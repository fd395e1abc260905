"""A question to a list of any length, and the answer of one shard of it: a plain function that any process can run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial, reduce
from itertools import pairwise
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.knowledge import Knowledge, knowledge_of, knowledge_text
from ethbrake_marl.agents.team import Driver, team_of
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.evaluation.harm_metrics import METRICS
from ethbrake_marl.evaluation.identity import (
    policies_by_name,
    policy_sha256,
    result_versions,
    scenario_sha256,
    worlds_sha256,
)
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.evaluation.outcome import Evaluation
from ethbrake_marl.evaluation.rollout import evaluate_block
from ethbrake_marl.evaluation.shards.columns import agent_tallies
from ethbrake_marl.evaluation.shards.rows import rows_file
from ethbrake_marl.evaluation.shards.tally import Tally
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.limits.limits import Unproven, known_limits
from ethbrake_marl.scenario import Sample, Scenario, Task
from ethbrake_marl.scenario.sample import quantity, quantity_rules
from ethbrake_marl.shield.uncertainty import parse_uncertainty

LEAF = 1_000  # worlds that are hashed together; shards and blocks begin at a multiple of it
BLOCK = 4 * LEAF  # worlds advanced together: bounds memory, changes no result
MOST_EPISODES = 10**12
_TRIED = 100  # worlds at each end of a list that say whether best known harms may be had for all of it


@dataclass(frozen=True, slots=True)
class Question:
    """What is asked of the worlds 0 to ``episodes - 1`` of a list; it travels to other processes.

    Args:
        scenario: of the worlds, with the learners that are driven.
        agents: by name, as they are written.
        episodes: worlds of the list.
        seed: of the list.
        harm_count: harm that agents minimise.
        uncertainty: what agents behind ``+robust`` do not know, as on the command line.
        objectives: under which results are told, too.

    """

    scenario: Scenario
    agents: tuple[str, ...]
    episodes: int
    seed: int
    harm_count: HarmCount = "first"
    uncertainty: str | None = None
    objectives: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_whole_number("episodes", self.episodes, 1, MOST_EPISODES)
        check_whole_number("seed", self.seed, 0)

    @property
    def task(self) -> Task:
        """Who is driven."""
        return Task(self.scenario, self.scenario.learners, self.harm_count)

    def lineup(self) -> Mapping[str, Driver]:
        """The agents, made anew; raises what ``make_lineup`` raises."""
        intervals = None if self.uncertainty is None else parse_uncertainty(self.uncertainty)
        return make_lineup(self.agents, self.scenario, harm_count=self.harm_count, uncertainty=intervals)


@dataclass(frozen=True, slots=True)
class Asked:
    """A question with everything that its answer depends on, looked up once and told to every process."""

    question: Question
    identity: Mapping[str, Any]  # plain data
    knows: Mapping[str, Knowledge]  # by agent
    policies: Mapping[str, Mapping[str, str]]  # by agent: vehicle's name -> SHA-256 of its policy
    limits: bool  # the best known harm of its worlds is looked up
    because: str | None  # why nothing is proven for its worlds; None where something is

    @property
    def sha256(self) -> str:
        """Of the identity: answers belong together where it is the same."""
        return hashlib.sha256(json.dumps(self.identity, sort_keys=True).encode()).hexdigest()


def ask(question: Question) -> Asked:
    """Look up what a question is about: hashes of scenario, policies and user files, versions, and what is proven.

    Raises what ``Question.lineup`` raises.
    """
    lineup, scenario = question.lineup(), question.scenario
    teams = {name: team_of(agent, scenario.learners) for name, agent in lineup.items()}
    knows = {name: knowledge_of(team) for name, team in teams.items()}
    policies = {
        name: policies_by_name(
            {vehicle: sha for vehicle, agent in team.drivers.items() if (sha := policy_sha256(agent)) is not None},
            scenario,
        )
        for name, team in teams.items()
    }
    ends = sorted({0, max(question.episodes - _TRIED, 0)})
    found = [
        known_limits(scenario.sample(min(_TRIED, question.episodes), question.seed, first=k).worlds, question.task)
        for k in ends
    ]
    because = next((each.because for each in found if isinstance(each, Unproven)), None)
    identity = {
        "format": 1,
        "scenario": scenario.name,
        "scenario_sha256": scenario_sha256(scenario),
        "seed": question.seed,
        "episodes": question.episodes,
        "agents": list(lineup),
        "policy_sha256": policies,
        "knows": {name: knowledge_text(each) for name, each in knows.items()},
        "harm_count": question.harm_count,
        "uncertainty": question.uncertainty,
        "objectives": list(question.objectives),
        "metrics": sorted(METRICS),
        "versions": result_versions(),
    }
    limits = all(not isinstance(each, Unproven) and bool(each.known.all()) for each in found)
    return Asked(question, identity, knows, policies, limits, because)


def shard_bounds(episodes: int, shards: int) -> list[tuple[int, int]]:
    """First world and end of every shard: as equal as whole leaves allow, and no more shards than there are leaves."""
    check_whole_number("shards", shards, 1)
    leaves = -(-episodes // LEAF)
    shards = min(shards, leaves)
    ends = [min(leaves * k // shards * LEAF, episodes) for k in range(shards + 1)]
    return list(pairwise(ends))


_LINEUPS: dict[str, Mapping[str, Driver]] = {}  # of this process; an evaluation drives copies


def answer_shard(asked: Asked, first: int, end: int, rows: Path | None = None, block: int = BLOCK) -> Tally:
    """The statistics of worlds ``first`` to ``end - 1``; depends on nothing else, and ``block`` changes no bit.

    Args:
        asked: the question.
        first: a multiple of ``LEAF``.
        end: another one, or the end of the list.
        rows: also write one row per world and agent to this Parquet file.
        block: worlds advanced together, a multiple of ``LEAF``.

    Raises ``InvalidInput`` for a policy that is not the one that was asked about, and what driving raises.

    """
    if first % LEAF or block % LEAF or not (end % LEAF == 0 or end == asked.question.episodes) or not first < end:
        raise InvalidInput(f"shard from {first} to {end} in blocks of {block}: must be whole leaves of {LEAF:,} worlds")
    lineup = _lineup_of(asked)
    starts = range(first, end, block)
    work = partial(_answer_block, asked, lineup)
    if rows is None:
        return reduce(add, (work(k, min(k + block, end), None) for k in starts), Tally())
    with rows_file(rows, asked.question.objectives) as write:
        return reduce(add, (work(k, min(k + block, end), write) for k in starts), Tally())


def _lineup_of(asked: Asked) -> Mapping[str, Driver]:
    """The agents in this process, once."""
    if asked.sha256 not in _LINEUPS:
        here = ask(asked.question)
        if here.sha256 != asked.sha256:
            changed = sorted(key for key in asked.identity if here.identity.get(key) != asked.identity[key])
            raise InvalidInput(f"shards: {', '.join(changed)} changed since the evaluation began; begin it again")
        _LINEUPS[asked.sha256] = asked.question.lineup()
    return _LINEUPS[asked.sha256]


def _answer_block(
    asked: Asked, lineup: Mapping[str, Driver], first: int, end: int, write: Callable[[Evaluation], None] | None
) -> Tally:
    """The statistics of worlds that are advanced together."""
    question = asked.question
    sample = question.scenario.sample(end - first, question.seed, first=first)
    evaluation, left_out = evaluate_block(sample, lineup, scenario=question.scenario, seed=question.seed)
    if evaluation is None:
        return Tally(left_out=left_out)
    if write is not None:
        write(evaluation)
    worlds = evaluation.worlds
    ranges = {
        name: tuple((float(c.min()), float(c.max())) for c in quantity(worlds, name).T)
        for name in quantity_rules(worlds)
    }
    hidden = int(evaluation.hidden.sum())
    agents = agent_tallies(evaluation, question.objectives, limits=asked.limits)
    kept = Sample(worlds, evaluation.index, 0)
    return Tally(worlds.n, hidden, _worlds_hash(kept), ranges, left_out, agents)


def _worlds_hash(kept: Sample) -> int:
    """The sum of the hashes of the leaves; ``Tally`` keeps it modulo 2^256."""
    leaf = kept.index // LEAF
    total = 0
    for number in np.unique(leaf):
        rows = np.flatnonzero(leaf == number)
        total += int(worlds_sha256(kept.worlds.take(rows), kept.index[rows]), 16)
    return total
