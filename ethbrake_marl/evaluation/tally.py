"""Sums over some worlds of a list. Sums of chunks can be added in any order, with the same bits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ethbrake_marl.evaluation.agent_tally import AgentTally, tally_agents
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.identity import HASHES, hash_of_chunks
from ethbrake_marl.evaluation.measures import contexts_of, silent_because
from ethbrake_marl.evaluation.outcome import LeftOut
from ethbrake_marl.evaluation.rescores import Rescored, Rescores
from ethbrake_marl.game.harm import HARM_COUNTS
from ethbrake_marl.scenario.fields import QUANTITY

Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Tally:
    """Statistics of some worlds of a list; tallies can be added in any order.

    ``worlds_hash`` is the hash of the worlds as in ``worlds_sha256``.
    """

    worlds: int = 0  # number of worlds that all agents drove
    hidden: int = 0  # number of worlds in which the channel hides something from a controlled vehicle
    worlds_hash: int = 0
    ranges: Mapping[str, tuple[Range, ...]] = field(default_factory=dict)  # smallest and largest of every quantity
    left_out: tuple[LeftOut, ...] = ()
    agents: Mapping[str, AgentTally] = field(default_factory=dict)
    silent: Mapping[str, str | None] = field(default_factory=dict)  # why sets of measures do not apply, by key

    @classmethod
    def of(cls, part: Evaluation, objectives: Sequence[str] | None = None, *, long_list: bool = True) -> Tally:
        """Return the statistics of a part of a list.

        ``objectives`` as in ``tally_agents``; ``long_list`` as in ``contexts_of``.
        """
        worlds = part.worlds
        if not worlds.n:
            return cls(left_out=part.left_out)
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
            part.left_out,
            tally_agents(part.outcomes, contexts, objectives=objectives),
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
            tuple(sorted((*self.left_out, *other.left_out))),
            agents | {name: agents.get(name, AgentTally()) + each for name, each in other.agents.items()},
            {**self.silent, **{key: why or self.silent.get(key) for key, why in other.silent.items()}},
        )

    def rescore(self, objectives: Sequence[str], vehicles: int) -> Rescores:
        """Return the mean harm of every agent under these objectives and both counts, as in ``Evaluation.rescore``."""
        return Rescores(
            [
                Rescored(
                    name, each, count, tuple(own.moments[f"{each}_{count}_{i + 1}"].estimate for i in range(vehicles))
                )
                for name, own in self.agents.items()
                for count in HARM_COUNTS
                for each in objectives
            ]
        )
