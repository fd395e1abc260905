"""A question to a list of any length, and the answer of one shard of it: a plain function that any process can run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial, reduce
from itertools import pairwise
from operator import add
from pathlib import Path
from typing import Any

import numpy as np

from ethbrake_marl.agents.protocol import Driver, Knowledge, knowledge_of, knowledge_text, team_of
from ethbrake_marl.defaults import HARM_COUNTS, HarmCount
from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number, naming_extras
from ethbrake_marl.evaluation.inputs import (
    make_lineup,
    policies_by_name,
    policy_sha256,
    result_versions,
    scenario_sha256,
    worlds_sha256,
)
from ethbrake_marl.evaluation.measures import COUNTED, KNOWN, REGISTERED, AgentTally, added, measures, tally_agents
from ethbrake_marl.evaluation.outcome import Evaluation, LeftOut, Outcome, is_papers_list, parameters_of
from ethbrake_marl.evaluation.results import (
    Columns,
    is_text,
    objective_columns,
    per_world_columns,
    results_to_json,
    vehicle_columns,
)
from ethbrake_marl.evaluation.rollout import evaluate_block
from ethbrake_marl.evaluation.statistics import (
    VALUE_BITS,
    Moments,
    estimates_to_json,
    exact_rate,
    mean_of,
)
from ethbrake_marl.evaluation.summary import Rescored, SummaryRow, summarise_tallies
from ethbrake_marl.files.sheet import parquet_file
from ethbrake_marl.limits.limits import Unproven, known_limits
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario import Sample, Scenario, Task
from ethbrake_marl.scenario.fields import DECLARED, quantity, quantity_rules
from ethbrake_marl.shield.uncertainty import parse_uncertainty

# The statistics of some worlds of a list: counts and exact sums, which merge in any order to the same bits.

HASHES = 1 << 256  # sums of hashes are kept modulo this
_MOST = 1 << 64
_ALWAYS = ("first_impact_harm", "total_harm")  # numbers that every agent has in every world
Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Tally:
    """The statistics of some worlds, added in any order.

    ``worlds_hash`` is the sum, modulo 2^256, of the SHA-256 of the leaves: 1,000 neighbouring worlds of the list each.
    """

    worlds: int = 0  # that count, driven by all agents
    hidden: int = 0  # in which the channel hides something from a driven vehicle
    worlds_hash: int = 0
    ranges: Mapping[str, tuple[Range, ...]] = field(default_factory=dict)  # least and largest of every quantity
    left_out: tuple[LeftOut, ...] = ()
    agents: Mapping[str, AgentTally] = field(default_factory=dict)

    def __add__(self, other: Tally) -> Tally:
        return Tally(
            self.worlds + other.worlds,
            self.hidden + other.hidden,
            (self.worlds_hash + other.worlds_hash) % HASHES,
            {name: _joined(self.ranges, other.ranges, name) for name in {**self.ranges, **other.ranges}},
            tuple(sorted((*self.left_out, *other.left_out))),
            added(self.agents, other.agents, AgentTally()),
        )

    def to_json(self) -> dict[str, Any]:
        """Plain data, as in the file of a finished shard."""
        return {
            "worlds": self.worlds,
            "hidden": self.hidden,
            "worlds_hash": hex(self.worlds_hash),
            "ranges": {name: [list(each) for each in entries] for name, entries in self.ranges.items()},
            "left_out": [list(left) for left in self.left_out],
            "agents": {name: agent.to_json() for name, agent in self.agents.items()},
        }

    @classmethod
    def from_json(cls, told: Any) -> Tally:
        """What ``to_json`` gave; raises ``InvalidInput`` for anything else."""
        try:
            tally = cls(
                _whole(told["worlds"]),
                _whole(told["hidden"]),
                int(told["worlds_hash"], 16) % HASHES,
                {name: tuple((float(a), float(b)) for a, b in entries) for name, entries in told["ranges"].items()},
                tuple(_left_out(*left) for left in told["left_out"]),
                {name: _agent_tally(agent) for name, agent in told["agents"].items()},
            )
            for agent in tally.agents.values() if tally.worlds else ():
                if any(agent.moments[name].count != tally.worlds for name in _ALWAYS):
                    raise ValueError("an agent that did not drive every world")
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise InvalidInput(f"is no tally of a shard: {error!r}") from None
        return tally


def _whole(value: Any) -> int:
    if type(value) is not int or not 0 <= value < _MOST:
        raise ValueError(f"{value!r} is no whole number from 0 on")
    return value


def _agent_tally(told: Mapping[str, Any]) -> AgentTally:
    return AgentTally(
        {name: _count(*pair) for name, pair in told["counts"].items()},
        {name: _moments(*parts) for name, parts in told["moments"].items()},
        {name: int(value, 16) for name, value in told["products"].items()},
    )


def _count(so: Any, of: Any) -> tuple[int, int]:
    if _whole(so) > _whole(of):
        raise ValueError(f"{so} of {of} worlds")
    return so, of


def _moments(count: Any, total: str, squares: str) -> Moments:
    """Moments that some values can have, none of them beyond 2^1000."""
    found = Moments(_whole(count), int(total, 16), int(squares, 16))
    n = found.count
    if abs(found.total) > n << (VALUE_BITS + 1000) or n * found.squares < found.total**2 or (n == 0 < found.squares):
        raise ValueError("moments that no values have")
    return found


def _left_out(world: Any, seed: Any, agent: Any, reason: Any) -> LeftOut:
    if not (isinstance(agent, str) and isinstance(reason, str)):
        raise ValueError(f"{agent!r}, {reason!r}: must be texts")
    return LeftOut(_whole(world), _whole(seed), agent, reason)


def _joined(
    one: Mapping[str, tuple[Range, ...]], other: Mapping[str, tuple[Range, ...]], name: str
) -> tuple[Range, ...]:
    """The ranges that hold both."""
    first, second = one.get(name), other.get(name)
    if first is None or second is None:
        return second if first is None else first  # type: ignore[return-value]  # one of them is there
    return tuple((min(a[0], b[0]), max(a[1], b[1])) for a, b in zip(first, second, strict=True))


def _further(objectives: Sequence[str]) -> Callable[[Outcome], Mapping[str, Floats]]:
    """What gives, beside the measures, the harm of each vehicle and its part under each objective."""
    return lambda outcome: {
        name: np.asarray(values)
        for name, values in (vehicle_columns(outcome) | objective_columns(outcome, objectives)).items()
    }


# One row per world and agent of a shard, as a Parquet file: world by world, whatever the shards and blocks are.

_WHOLE = {"world", "collided", "impacts", "chosen_policy", "hidden"}


def row_columns(evaluation: Evaluation, objectives: Sequence[str]) -> Columns:
    """The columns of a shard's rows, world by world."""
    found = per_world_columns(evaluation, objectives, limits=False)
    n, agents = evaluation.worlds.n, len(evaluation.outcomes)
    order = np.arange(n * agents).reshape(agents, n).T.ravel().tolist()
    return {name: [values[k] for k in order] for name, values in found.items()}


@contextmanager
def rows_file(path: Path, objectives: Sequence[str]) -> Iterator[Callable[[Evaluation], None]]:
    """Give what adds the rows of evaluations to the file, which appears at ``path`` when the block ends well.

    Worlds that were left out have no row. Raises ``MissingExtra`` without pyarrow.
    """
    with naming_extras():
        import pyarrow

    def array(name: str, values: Sequence[Any]) -> Any:
        whole = pyarrow.int64() if name in _WHOLE else pyarrow.float64()
        return pyarrow.array(values, pyarrow.string() if is_text(name) else whole)

    with parquet_file(path, compression="zstd") as write:

        def add(evaluation: Evaluation) -> None:
            columns = row_columns(evaluation, objectives)
            write({name: array(name, values) for name, values in columns.items()})

        yield add


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
        "format": 2,
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
        "metrics": sorted(REGISTERED),
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
    agents = tally_agents(evaluation, limits=asked.limits, extra=_further(question.objectives))
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


# The table and the results file of a list that was evaluated in shards, from its merged tally alone.

INTERVALS = {"rates": "Clopper-Pearson", "means": "Student's t, of exact sums"}


def summarise_shards(asked: Asked, tally: Tally) -> list[SummaryRow]:
    """One row per agent, as ``summarise``; rates with exact intervals. Raises ``PhysicsError`` if no world is left."""
    if not tally.worlds:
        raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in tally.left_out})
    question = asked.question
    told = {name: _told_range(name, entries) for name, entries in tally.ranges.items()}
    shared = {
        "parameters": parameters_of(question.task, question.seed, tally.worlds, asked.because, told),
        "left_out": tally.left_out,
        "beside_paper": is_papers_list(question.scenario, question.seed, question.task.vehicles),
        "hidden_share": tally.hidden / tally.worlds,
        "worlds_sha256": f"{tally.worlds_hash:064x}",
        "scenario_sha256": asked.identity["scenario_sha256"],
        "versions": asked.identity["versions"],
    }
    tallies = {name: _without_limits(tally.agents[name], tally.worlds) for name in asked.identity["agents"]}
    return summarise_tallies(tallies, tally.worlds, exact_rate, asked.knows, asked.policies, shared)


def _without_limits(tally: AgentTally, worlds: int) -> AgentTally:
    """The tally without what needs the best known harm, unless that is known in every world."""
    if tally.count(KNOWN) == worlds:
        return tally
    names = {measure.name for measure in (*measures(()), *COUNTED) if measure.limits}
    counts = {name: pair for name, pair in tally.counts.items() if name not in names}
    return AgentTally(counts, {n: each for n, each in tally.moments.items() if n not in names}, tally.products)


def rescore_shards(asked: Asked, tally: Tally) -> list[Rescored]:
    """Every agent under every objective of the question and both counts, as ``rescore``."""
    vehicles = range(asked.question.scenario.vehicles)
    return [
        Rescored(
            name,
            each,
            harm_count,
            tuple(mean_of(tally.agents[name].moments[f"{each}_{harm_count}_{i + 1}"]) for i in vehicles),
        )
        for name in asked.identity["agents"]
        for harm_count in HARM_COUNTS
        for each in asked.question.objectives
    ]


def shards_to_json(asked: Asked, tally: Tally, rows: Sequence[SummaryRow]) -> list[dict[str, Any]]:
    """What a results file holds: one object per agent, each vehicle's harm and the kind of the intervals among it."""
    question = asked.question
    settings = {"harm_count": question.harm_count, "uncertainty": question.uncertainty}
    found = results_to_json(rows, told=rescore_shards(asked, tally), settings=settings)
    names = [f"{name}_{i + 1}" for name in _ALWAYS for i in range(question.scenario.vehicles)]

    def borne(agent: str) -> dict[str, Any]:
        return estimates_to_json({name: mean_of(tally.agents[agent].moments[name]) for name in names})

    told = {"kind": "evaluate-shards", "intervals": INTERVALS}
    return [{**row, **told, "vehicle_harm": borne(row["agent"])} for row in found]


def _told_range(name: str, entries: Sequence[tuple[float, float]]) -> Any:
    """As ``conditions.quantities`` tells it."""
    told = [low if low == high else [low, high] for low, high in entries]
    return told[0] if DECLARED[name].per == "world" else told
