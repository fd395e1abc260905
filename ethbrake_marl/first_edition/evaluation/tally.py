"""For each agent, the sums of its measures over some worlds. Sums can be added in any order, with the same result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ethbrake_marl.first_edition.evaluation.agent_tally import AgentTally, tally_agents
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.identity import HASHES, hash_of_chunks
from ethbrake_marl.first_edition.evaluation.measure_sets import contexts_of, silent_because
from ethbrake_marl.first_edition.evaluation.outcome import LeftOut
from ethbrake_marl.first_edition.evaluation.rescores import Rescored, Rescores
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.scenario.fields import QUANTITY

Range = tuple[float, float]  # smallest and largest value


@dataclass(frozen=True, slots=True)
class Tally:
    """For each agent, the sums of its measures; ``tally + other`` has the sums over the worlds of both."""

    worlds: int = 0  # number of worlds, without left-out worlds
    hidden: int = 0  # number of worlds in which the V2X channel hides something from a controlled vehicle
    worlds_hash: int = 0  # ``hash_of_chunks`` of the worlds
    # Key of a quantity -> smallest and largest value for each vehicle or pair, or for the whole world.
    ranges: Mapping[str, tuple[Range, ...]] = field(default_factory=dict)
    recordings: frozenset[str] = frozenset()  # names of the recordings that the worlds come from
    rejected: int = 0  # number of drawn worlds that were rejected because of an early impact
    left_out: tuple[LeftOut, ...] = ()  # worlds that could not be simulated with some agent; no sum contains them
    agents: Mapping[str, AgentTally] = field(default_factory=dict)  # name of an agent -> sums of its measures
    # ``MeasureSet.because_key`` -> why the set of measures does not apply; None if the set applies.
    silent: Mapping[str, str | None] = field(default_factory=dict)

    @classmethod
    def of(cls, part: Evaluation, objectives: Sequence[str] | None = None, *, long_list: bool = True) -> Tally:
        """Return the sums of an evaluation of consecutive worlds of the evaluation list.

        ``objectives`` is as in ``tally_agents``. ``long_list`` says whether to omit the sets of measures that do not
        apply to more than 100,000 worlds.
        """
        worlds = part.worlds
        if not worlds.n:
            return cls(left_out=part.left_out, rejected=part.rejected)
        ranges = {
            name: tuple((float(np.nanmin(c)), float(np.nanmax(c))) for c in rule.of(worlds).T)
            for name, rule in QUANTITY.of(worlds).items()
        }
        contexts = contexts_of(part, long_list=long_list)
        return cls(
            worlds.n,
            int(part.hidden.sum()),
            hash_of_chunks(worlds, part.index),
            ranges,
            frozenset() if part.clusters is None else frozenset(part.clusters.tolist()),
            part.rejected,
            part.left_out,
            tally_agents(part.outcomes, contexts, objectives=objectives, clusters=part.clusters),
            silent_because(contexts),
        )

    def __add__(self, other: Tally) -> Tally:
        ranges, agents = dict(self.ranges), dict(self.agents)
        for name, entries in other.ranges.items():
            both = zip(ranges.get(name, entries), entries, strict=True)
            ranges[name] = tuple((min(a[0], b[0]), max(a[1], b[1])) for a, b in both)
        return Tally(
            self.worlds + other.worlds,
            self.hidden + other.hidden,
            (self.worlds_hash + other.worlds_hash) % HASHES,
            ranges,
            self.recordings | other.recordings,
            self.rejected + other.rejected,
            tuple(sorted((*self.left_out, *other.left_out))),
            agents | {name: agents.get(name, AgentTally()) + each for name, each in other.agents.items()},
            {**self.silent, **{key: why or self.silent.get(key) for key, why in other.silent.items()}},
        )

    def rescore(self, objectives: Sequence[str], vehicles: int) -> Rescores:
        """Return the mean value of each objective over the worlds, for every agent, vehicle and count of harm.

        ``Tally.of`` must have been called with these ``objectives``. ``vehicles`` is the number N of vehicles.
        """
        return Rescores(
            [
                Rescored(
                    name, each, count, tuple(own.moments[f"{each}_{count}_{i + 1}"].estimate for i in range(vehicles))
                )
                for name, own in self.agents.items()
                for count in HARM_COUNTS
                for each in objectives
            ],
            len(self.recordings),
        )
