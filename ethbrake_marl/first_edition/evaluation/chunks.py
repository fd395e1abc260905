"""Evaluate long lists of worlds in chunks: in this process, in several processes, or on a Ray cluster.

Chunks have a fixed size, and sums over worlds are exact. Results are therefore the same for any number of processes.

Arguments that several functions share: ``agents`` are names as on the command line, such as ``full_brake`` and
``ppo+step``. ``seed`` is the seed of the worlds, None if they were not drawn from a seed. ``jobs`` is the number of
processes; None: one process, or with Ray one per core of the cluster. ``ray`` is the address of a Ray cluster, or
``local`` for this machine; None: Ray is not used. ``on_done`` is called after each chunk with the number of worlds
evaluated so far.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput, PhysicsError, check_whole_number
from ethbrake_marl.files.python_file import file_sha256
from ethbrake_marl.first_edition.agents.protocol import Driver, Knowledge, Team
from ethbrake_marl.first_edition.agents.spec import parse_spec
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.identity import (
    CHUNK,
    own_versions,
    policies_of,
    result_versions,
    scenario_sha256,
)
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.measure_sets import MEASURE_SETS, silent_in_long_lists
from ethbrake_marl.first_edition.evaluation.outcome import Outcome
from ethbrake_marl.first_edition.evaluation.own_measures import LOADED, load_measures
from ethbrake_marl.first_edition.evaluation.rollout import chunks_of, drive_chunk
from ethbrake_marl.first_edition.evaluation.summary import SummaryTable, summarise_sums
from ethbrake_marl.first_edition.evaluation.tally import Tally
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.game.measures import REPORTED
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.parallel import Call, run_each
from ethbrake_marl.registry import versions_used

MOST_EPISODES = 10**12

OnDone = Callable[[int], None]

# Agents of the lineup that this process built last, by ``Lineup.same``. An evaluation drives copies of them.
_BUILT: dict[str, Mapping[str, Driver]] = {}


@dataclass(frozen=True, slots=True)
class Lineup:
    """List of the agents of an evaluation as plain data, from which every worker process builds the same agents.

    Args:
        agents: names of the agents.
        scenario: scenario whose learners the agents drive.
        harm_count: count of harm that agents minimise.
        uncertainty: for shields that need it: how far quantities may differ from their stated values, written as in
            ``gaps_m=0.5``; None: no agent has such a shield.
        measures: names of the user's measures that every process loads (``load_measures``), some as ``FILE:NAME``.
        reported: names of all measures of the user whose values the evaluation reports.
        sets: names of the sets of measures that every process must have.
        same: hash of the policies, measures and software versions, which must be equal in every process.
        packages: version of each extension package that every process must have, by the package's name.

    """

    agents: tuple[str, ...]
    scenario: Scenario
    harm_count: HarmCount = "first"
    uncertainty: str | None = None
    measures: tuple[str, ...] = ()
    reported: tuple[str, ...] = ()
    sets: tuple[str, ...] = ()
    same: str = ""
    packages: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, agents: Sequence[str], scenario: Scenario, **how: Any) -> Lineup:
        """Return a lineup with the values of this process in ``reported``, ``sets``, ``same`` and ``packages``.

        ``how`` are the arguments ``harm_count``, ``uncertainty`` and ``measures`` of ``Lineup``. Raises the errors of
        ``make_lineup``.
        """
        load_measures(how.pop("measures", ()))
        sets = tuple(name for name, _ in MEASURE_SETS.items())  # loads the sets, so that their versions are known
        lineup = cls(tuple(agents), scenario, measures=tuple(LOADED), reported=tuple(REPORTED), sets=sets, **how)
        drivers = lineup._build()
        same = lineup._same(drivers)
        _BUILT.clear()
        _BUILT[same] = drivers
        return replace(lineup, same=same, packages=versions_used())

    def make(self) -> Mapping[str, Driver]:
        """Return the agents by name; each process builds them only once.

        Raises ``InvalidInput`` if this process has other policies, measures or versions than the process that created
        the lineup.
        """
        if self.same not in _BUILT:
            load_measures(self.measures)
            drivers = self._build()
            same = (
                self._same(drivers) == self.same
                and {*self.reported} <= REPORTED.keys()
                and {*self.sets} <= {*MEASURE_SETS}
            )
            if not same or any(_installed(name) != used for name, used in self.packages.items()):
                raise InvalidInput(
                    "evaluate: a worker process has other policies, measures or package versions than the main process;"
                    " install the same versions on all machines, and change no file while an evaluation runs"
                )
            _BUILT.clear()
            _BUILT[self.same] = drivers
        return _BUILT[self.same]

    def _build(self) -> Mapping[str, Driver]:
        return make_lineup(self.agents, self.scenario, harm_count=self.harm_count, uncertainty=self.uncertainty)

    def _same(self, drivers: Mapping[str, Driver]) -> str:
        policies = {
            name: policies_of(Team.of(agent, self.scenario.learners).drivers) for name, agent in drivers.items()
        }
        asked = self.harm_count, self.uncertainty, scenario_sha256(self.scenario)
        text = json.dumps([asked, policies, self._digests(), self.reported, own_versions()], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def _digests(self) -> list[str]:
        """Return the SHA-256 of every file of code or weights whose path is part of an agent's or a measure's name."""
        named = [part for spec in map(parse_spec, self.agents) if spec.file for part in (spec.file[0], spec.policy)]
        named += [name.rpartition(":")[0] for name in self.measures]
        return [file_sha256(Path(each)) for each in named if each is not None and Path(each).is_file()]


def _installed(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def evaluate_held(
    lineup: Lineup,
    sample: Sample,
    seed: int | None,
    *,
    jobs: int | None = None,
    ray: str | None = None,
    on_done: OnDone | None = None,
) -> Evaluation:
    """Let the agents of ``lineup`` drive all worlds of ``sample``, and keep all outcomes in memory.

    ``seed`` is only recorded in the result.
    """
    calls: Iterator[Call] = ((_drive, lineup, part, seed, first) for first, part in chunks_of(sample))
    parts: list[Evaluation] = []
    for part in run_each(calls, jobs, ray):
        parts.append(part)
        _report(on_done, len(parts), sample.worlds.n)
    return replace(Evaluation.join(parts), rejected=sample.rejected)


def _drive(lineup: Lineup, part: Sample, seed: int | None, first: int) -> Evaluation:
    evaluation = drive_chunk(part, lineup.make(), lineup.scenario, seed, lineup.scenario.learners, first)
    return replace(
        evaluation, outcomes={agent: _only(each, lineup.reported) for agent, each in evaluation.outcomes.items()}
    )


def _only(outcome: Outcome, names: Sequence[str]) -> Outcome:
    """Return the outcome with ``metrics`` reduced to the columns of the user's measures ``names``."""
    metrics = {c: each for c, each in outcome.metrics.items() if c in names or c.rpartition("_")[0] in names}
    return replace(outcome, metrics=metrics)


def tally_list(
    lineup: Lineup,
    episodes: int,
    seed: int,
    *,
    objectives: Sequence[str] = (),
    jobs: int | None = None,
    ray: str | None = None,
    on_done: OnDone | None = None,
) -> Tally:
    """Let the agents of ``lineup`` drive an evaluation list of 1 to 10^12 worlds, and return sums of their measures.

    The worlds are drawn and driven chunk by chunk, so memory does not grow with the length of the list. The result
    omits sets of measures whose computation takes longer than the simulation of the episodes. If ``objectives`` such as
    ``"social:45"`` (docs/cooperation.md) are passed, the result also contains, for each vehicle, the sum of the harm
    that it bears, and the sum of each objective's value.
    """
    check_whole_number("episodes", episodes, 1, MOST_EPISODES)
    check_whole_number("seed", seed, 0)
    chunks = range(0, episodes, CHUNK)
    calls: Iterator[Call] = (
        (_count, lineup, first, min(first + CHUNK, episodes), seed, tuple(objectives) or None) for first in chunks
    )
    whole = Tally()
    for done, part in enumerate(run_each(calls, jobs, ray), 1):
        whole += part
        _report(on_done, done, episodes)
    return whole


def _count(lineup: Lineup, first: int, end: int, seed: int, objectives: Sequence[str] | None) -> Tally:
    return Tally.of(_drive(lineup, lineup.scenario.sample(end - first, seed, first=first), seed, first), objectives)


def _report(on_done: OnDone | None, chunks: int, worlds: int) -> None:
    if on_done is not None:
        on_done(min(chunks * CHUNK, worlds))


def summarise_tally(lineup: Lineup, tally: Tally, seed: int) -> SummaryTable:
    """Return the results table of an evaluation list, with one row per agent, from the result of ``tally_list``.

    Raises ``PhysicsError`` if every world was left out because of an error.
    """
    if not tally.worlds:
        raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in tally.left_out})
    scenario = lineup.scenario
    task = Task(scenario, scenario.learners, lineup.harm_count)
    teams = {name: Team.of(agent, scenario.learners) for name, agent in lineup.make().items()}
    return summarise_sums(
        {name: tally.agents[name] for name in teams},
        Conditions.of_test(
            task,
            seed,
            tally.worlds,
            tally.silent,
            Conditions.of_ranges(tally.ranges),
            recordings=len(tally.recordings),
            rejected=tally.rejected,
        ),
        silent_in_long_lists(),
        knows={name: Knowledge.of(team) for name, team in teams.items()},
        policies={name: policies_of(team.drivers) for name, team in teams.items()},
        left_out=tally.left_out,
        hidden_share=tally.hidden / tally.worlds,
        worlds_sha256=f"{tally.worlds_hash:064x}",
        scenario_sha256=scenario_sha256(scenario),
        versions=result_versions(),
    )
