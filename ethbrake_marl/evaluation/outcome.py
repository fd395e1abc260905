"""The outcomes of agents that drove the same worlds, world by world."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.knowledge import Knowledge, Source
from ethbrake_marl.errors import IncompleteTable, InvalidInput, PhysicsError, count_of
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.files.html import html_table
from ethbrake_marl.harm import HarmCount, Ledger
from ethbrake_marl.limits.limits import Limits, Unproven, known_limits
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.estimates import is_periodic
from ethbrake_marl.scenario import Scenario, Task
from ethbrake_marl.scenario.sample import Texts
from ethbrake_marl.scenario.v2x import hidden_from

_SHOWN_AGENTS = 5  # by name, in ``repr``


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one agent achieved, world by world.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> outcome = eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario).outcome("full_brake")
    >>> outcome.total_harm.round(2), outcome.collided
    (array([33.79, 77.19,  0.  ]), array([ True,  True, False]))

    """

    ledger: Ledger  # of every impact
    final: Worlds  # each world as its episode left it
    at_rest: Bools  # [n] the line came to rest; else the horizon cut the episode off
    predicted_harm: Floats | None  # [n] what the agent expected at the alert, if it predicts and drives alone
    chosen_policy: Bools | None  # [n] a hybrid drove by its policy; else by its backup
    knows: Knowledge = (Source.UNSTATED,)  # what the agent says it knows of the line
    shoved_m: Floats | None = None  # [n] how far Vehicle 1 ends beyond where it would by itself, see ``travel``
    sampled_harm: Floats | None = None  # [n] the paper's sum over samples of the same commands, see ``sampled_harm``
    policies: Mapping[int, str] = field(default_factory=dict)  # vehicle (0 = front) -> SHA-256 of its policy's manifest
    metrics: Mapping[str, Floats] = field(default_factory=dict)  # registered harm metrics by column, [n]

    def __repr__(self) -> str:
        return f"Outcome({count_of(len(self.collided), 'world')}, {int(self.collided.sum()):,} collided, {self._means})"

    @property
    def _means(self) -> str:
        """Mean harms, for ``repr``; nothing is a mean where there are no worlds."""
        if not len(self.collided):
            return "no harm"
        return f"harm {self.first_impact_harm.mean():.2f} first-impact, {self.total_harm.mean():.2f} total"

    def take(self, rows: Ints | Bools) -> Outcome:
        """That of some of the worlds."""
        ledger = Ledger(*(getattr(self.ledger, f.name)[rows] for f in fields(Ledger)))
        names = ("predicted_harm", "chosen_policy", "shoved_m", "sampled_harm")
        columns: dict[str, Any] = {
            name: None if getattr(self, name) is None else getattr(self, name)[rows] for name in names
        }
        columns |= {"knows": self.knows, "policies": self.policies}
        columns |= {"metrics": {name: column[rows] for name, column in self.metrics.items()}}
        return Outcome(ledger, self.final.take(rows), self.at_rest[rows], **columns)

    @property
    def collided(self) -> Bools:
        """Whether any impact happened, [n]."""
        return self.ledger.collided

    @property
    def impacts(self) -> Ints:
        """Number of impacts of all pairs, and with an obstacle ahead, [n]."""
        return self.ledger.impacts

    def world_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of all vehicles under a counting rule, [n] m2/s2."""
        return self.ledger.world_harm(harm_count)

    @property
    def first_impact_harm(self) -> Floats:
        """Harm of all vehicles, each pair's first impact only, [n] m2/s2."""
        return self.ledger.world_harm("first")

    @property
    def total_harm(self) -> Floats:
        """Harm of all vehicles, every impact, [n] m2/s2."""
        return self.ledger.world_harm("total")

    def vehicle_harm(self, harm_count: HarmCount) -> Floats:
        """Harm of each vehicle, [n, N] m2/s2."""
        return self.ledger.vehicle_harm(harm_count)

    @property
    def ended(self) -> NDArray[np.str_]:
        """How each episode ended, [n]: ``at_rest`` or ``horizon``."""
        return np.where(self.at_rest, "at_rest", "horizon")


class LeftOut(NamedTuple):
    """A world that is in no outcome, because it could not be advanced with one of the agents."""

    world: int  # number in its list
    seed: int | None  # of the list; None for worlds that were given
    agent: str  # the first one that met it
    reason: str

    def __str__(self) -> str:
        of = "" if self.seed is None else f" of seed {self.seed}"
        return f"world {self.world}{of} ({self.agent}: {self.reason})"


@dataclass(frozen=True)
class Evaluation:
    """Outcomes of agents that drove the same vehicles in the same worlds, row k of every array being world k.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> evaluation = eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario)
    >>> list(evaluation.outcomes), evaluation.vehicle, evaluation.index
    (['full_brake', 'coast'], 1, array([0, 1, 2]))

    """

    scenario: Scenario  # of the worlds
    vehicles: tuple[int, ...]  # indices (0 = front) of the vehicles that were driven; the others followed scripts
    worlds: Worlds  # at the alert
    index: Ints  # [n] number of each world in its list
    seed: int | None  # of the list; None for worlds that were given
    outcomes: dict[str, Outcome]  # by the agent's name
    left_out: tuple[LeftOut, ...] = ()  # worlds of the list that are in none of the arrays, the same for all agents
    kinds: Mapping[str, Texts] = field(default_factory=dict)  # ``scenario`` of a mixture, ``vehicle_2_type``, ...: [n]

    def __repr__(self) -> str:
        drivers = [f"{agent!r:.42}" for agent in list(self.outcomes)[:_SHOWN_AGENTS]]
        more = len(self.outcomes) - len(drivers)
        drivers += [f"{more} more"] if more else []
        seed = "" if self.seed is None else f" of seed {self.seed}"
        return (
            f"Evaluation({self.scenario.name!r}, {count_of(self.worlds.n, 'world')}{seed}, {self.task.names:.80} driven"
            f" by {', '.join(drivers)})"
        )

    @property
    def vehicle(self) -> int:
        """The vehicle that was driven; raises ``InvalidInput`` if it is not exactly one."""
        return self.task.vehicle

    @property
    def task(self) -> Task:
        """What was asked of the agents."""
        return Task(self.scenario, self.vehicles)

    @cached_property
    def limits(self) -> Limits | Unproven:
        """What is known of each world whoever drives: found once, for everything that tells of this evaluation.

        Warns (``IncompleteTable``) where a table of best known harm holds some of the worlds, and not the others.
        """
        found = known_limits(self.worlds, self.task)
        if isinstance(found, Limits) and found.warning:
            warnings.warn(found.warning, IncompleteTable, stacklevel=2)
        return found

    def take(self, rows: Ints | Bools) -> Evaluation:
        """That of some of the worlds; nobody is left out of them."""
        outcomes = {name: outcome.take(rows) for name, outcome in self.outcomes.items()}
        kinds = {name: column[rows] for name, column in self.kinds.items()}
        return replace(
            self, worlds=self.worlds.take(rows), index=self.index[rows], outcomes=outcomes, left_out=(), kinds=kinds
        )

    @property
    def hidden(self) -> Bools:
        """Worlds in which the channel hides something of the line from a driven vehicle, [n]; see ``v2x``."""
        hidden = np.zeros(self.worlds.n, np.bool_)
        for vehicle in self.vehicles:
            hidden |= hidden_from(self.worlds.vehicles, vehicle) | is_periodic(self.worlds)
        return hidden

    def to_frame(self, library: str | None = None) -> Any:
        """One row per agent and world: the columns of ``--per-world`` (docs/evaluation.md), NaN for no number.

        A pandas ``DataFrame`` where pandas is installed, else one of polars, else a mapping of column names to arrays.
        ``library`` asks for one of them: ``pandas``, ``polars`` or ``columns``. Raises ``UnknownName`` for another, and
        ``InvalidInput`` for one that is not installed.
        """
        # by name, as an entry point: the columns are made above this file, from what it defines
        return import_module(f"{__package__}.frame").make_frame(self, library)

    def _repr_html_(self) -> str:
        """What each agent did, for a notebook."""
        harms = {"First-impact harm": "first_impact_harm", "Total harm": "total_harm"}
        rows = []
        for agent, outcome in self.outcomes.items():
            collided = rate(int(outcome.collided.sum()), self.worlds.n)
            means = [mean(getattr(outcome, name)).in_words() for name in harms.values()]
            rows.append((agent, collided.in_words(digits=1, scale=100.0, unit=" %"), *means))
        note = "Means per world in m²/s², with their 95 % intervals. eb.summarise tells more."
        return html_table(("Agent", "Collisions", *harms), rows, caption=repr(self), note=note)

    def complete(self) -> Evaluation:
        """The evaluation itself, for who needs every world; raises ``PhysicsError`` if some were left out."""
        if self.left_out:
            raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in self.left_out})
        return self

    def outcome(self, agent: str) -> Outcome:
        """The outcome of one agent; raises ``InvalidInput`` naming those that were evaluated."""
        if agent not in self.outcomes:
            raise InvalidInput(f"agent {agent!r} was not evaluated; evaluated: {', '.join(self.outcomes)}")
        return self.outcomes[agent]
