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

from ethbrake_marl.agents.protocol import Knowledge, Source
from ethbrake_marl.defaults import HarmCount
from ethbrake_marl.errors import IncompleteTable, InvalidInput, PhysicsError, count_of
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.harm import Ledger
from ethbrake_marl.limits.limits import Limits, Unproven, known_limits
from ethbrake_marl.physics import Bools, Floats, Ints, Worlds
from ethbrake_marl.physics.messages import is_periodic
from ethbrake_marl.scenario import Scenario, Task, load_scenario
from ethbrake_marl.scenario.fields import DECLARED, Texts, quantity, quantity_rules
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
    metrics: Mapping[str, Floats] = field(default_factory=dict)  # registered measures by column, [n]

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
        return import_module(f"{__package__}.results").make_frame(self, library)

    def _repr_html_(self) -> str:
        """What each agent did, for a notebook."""
        harms = {"First-impact harm": "first_impact_harm", "Total harm": "total_harm"}
        rows = []
        for agent, outcome in self.outcomes.items():
            collided = rate(int(outcome.collided.sum()), self.worlds.n)
            means = [mean(getattr(outcome, name)).in_words() for name in harms.values()]
            rows.append((agent, collided.in_words(digits=1, scale=100.0, unit=" %"), *means))
        note = "Means per world in m²/s², with their 95 % intervals. eb.summarise tells more."
        return Sheet(repr(self), ("Agent", "Collisions", *harms), rows, note).html()

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


# The three tests that stand beside each other: the paper's own, and two that close its ways out.
#
# All three have the same gaps and speeds in world k. ``docs/decisions/0011`` says why the first is the main one, and
# why
# none is shown alone.

MAIN_TEST = "paper-random"
TESTS = {
    MAIN_TEST: "Main test, the paper's rules: Vehicle 2 may drive, nothing stands ahead of Vehicle 1, and pushing it on"
    " costs nothing in either count.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast; it can"
    " neither drive on nor push with its motor.",
    "paper-random-obstacle": "Obstacle test: the same worlds with the obstacle that Vehicle 1 brakes for, 1.7 m beyond"
    " where it stops by itself. Vehicle 1's impact with it is harm.",
}

_TEXTS = {"title", "description", "source"}


def is_as_shipped(scenario: Scenario) -> bool:
    """Whether every value of the scenario is that of the shipped one of its name, whatever its texts say."""
    return scenario.model_dump(exclude=_TEXTS) == load_scenario(scenario.name).model_dump(exclude=_TEXTS)


def other_tests(scenario: Scenario) -> tuple[Scenario, ...]:
    """The two tests that belong beside results on ``scenario``; none where it is not one of the three as shipped."""
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return ()
    return tuple(load_scenario(name) for name in TESTS if name != scenario.name)


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One row of a table of the paper, as printed; the paper reports a single harm and no intervals."""

    table: str
    agent: str  # the paper's name
    episodes: int
    collisions: int
    collision_rate: float
    average_harm: float  # m2/s2
    harm_decrease: float | None  # relative to Non-E, as printed


RANDOM_TEST = "random test"
HYBRID_TEST = "hybrid test"

PAPER_ROWS = (
    PaperRow(RANDOM_TEST, "Non-E", 10_000, 9391, 0.9391, 33.5878, 0.0),
    PaperRow(RANDOM_TEST, "E-V2X-BM", 10_000, 8520, 0.852, 9.8772, 0.7059),
    PaperRow(RANDOM_TEST, "Hybrid SAC", 10_000, 5896, 0.5896, 5.7001, 0.8302),
    PaperRow(RANDOM_TEST, "Hybrid PPO", 10_000, 5974, 0.5974, 5.6202, 0.8326),
    PaperRow(HYBRID_TEST, "E-V2X-BM", 5_000, 4263, 0.8526, 9.8514, None),
    PaperRow(HYBRID_TEST, "Standalone DRL", 5_000, 3737, 0.7474, 12.229, None),
    PaperRow(HYBRID_TEST, "Hybrid", 5_000, 2995, 0.599, 7.3641, None),
)

PAPER_PARAMETERS = {
    RANDOM_TEST: (
        "10,000 worlds; d = 5–10 m; v = 18–22 m/s; braking and driving capacity (6, 7, 6) m/s²; τ2 = 0.5 s, τ3 = 0.8 s;"
        " m = (4.5, 5.5, 5.9) t; not stated: e, time step, horizon, seed"
    ),
    HYBRID_TEST: (
        "5,000 worlds; d = 5–10 m; capacities, latencies and masses as in the random test; not stated: speeds for this"
        " test, e, time step, horizon, seed"
    ),
}

PAPER_NOTE = (
    "The paper's rows cannot come from the parameters that it states: in 62.3 % of the worlds of its random test no"
    " command of Vehicle 2 whatsoever avoids an impact (in 65.1 % none avoids contact), yet its hybrids collide in"
    " 59 %; and in its 5,000-world test the hybrid avoids 2,005 collisions, although its two parts together avoid at"
    " most 2,000. If Vehicle 2 could act at about 0.2 s instead of the stated 0.5 s, full braking would come close to"
    " the paper's row (the scenario paper-random-early). The paper's E-V2X-BM harm is close to what the pairwise closed"
    " form predicts at the alert, not to what those commands cause; for the 5,000-world table that holds only at the"
    " speeds of the random test, since at those of the paper's figure of distances it predicts 3.07. Nothing here is"
    " tuned to these rows. docs/paper.md goes through the paper's equations, figures and tables one by one."
)

_SHOWN_WITH = ("paper-random", "paper-random-early")  # the second is the variant of which the note speaks


def is_papers_test(evaluation: Evaluation) -> bool:
    """Whether the results may stand beside the paper's rows: a list drawn from one of these shipped scenarios.

    Every value of the scenario counts, not its name; Vehicle 2 is driven, and the worlds are no table of the user's.
    """
    return is_papers_list(evaluation.scenario, evaluation.seed, evaluation.vehicles)


def is_papers_list(scenario: Scenario, seed: int | None, vehicles: tuple[int, ...]) -> bool:
    """``is_papers_test`` for these driven ``vehicles`` (from 0) in the list of this seed; None: the user's table."""
    if scenario.name not in _SHOWN_WITH or seed is None or vehicles != (1,):
        return False
    return is_as_shipped(scenario)


# The conditions behind a result: what stands beside every table, figure and report.

_SYMBOLS = {
    "gaps_m": ("d", "m"),
    "speeds_mps": ("v", "m/s"),
    "braking_capacity_mps2": ("braking capacity", "m/s²"),
    "driving_capacity_mps2": ("driving capacity", "m/s²"),
    "latency_s": ("τ", "s"),
    "mass_t": ("m", "t"),
    "restitution": ("e", ""),
    "obstacle_gap_m": ("obstacle at", "m"),
}
_STAY = "\u00a0"  # a blank at which no line is broken


def quantities(worlds: Worlds) -> dict[str, Any]:
    """Every quantity of the worlds as plain data: a list per vehicle or pair, one entry for the whole world.

    An entry is a number where all worlds agree, else its ``[least, largest]`` value.
    """
    found: dict[str, Any] = {}
    for key, rule in quantity_rules(worlds).items():
        entries = [_entry(column) for column in quantity(worlds, key).T]
        found[key] = entries[0] if rule.per == "world" else entries
    return found


def parameters(evaluation: Evaluation) -> dict[str, Any]:
    """Conditions of an evaluation as plain data: scenario, seed, count, who drove what, and all ``quantities``."""
    because = evaluation.limits.because if isinstance(evaluation.limits, Unproven) else None
    found = quantities(evaluation.worlds)
    return parameters_of(evaluation.task, evaluation.seed, evaluation.worlds.n, because, found)


def parameters_of(
    task: Task, seed: int | None, count: int, because: str | None, found: Mapping[str, Any]
) -> dict[str, Any]:
    """``parameters`` from their parts.

    Args:
        task: scenario, and who was driven.
        seed: of the list; None for worlds that were given.
        count: number of worlds.
        because: why nothing is proven for these worlds; None where it is.
        found: ``quantities`` of the worlds.

    """
    scenario = task.scenario
    driven = [scenario.vehicle_names[i] for i in task.vehicles]
    scripts = {scenario.vehicle_names[i]: script for i, script in scenario.scripts.items()}
    scripts = {name: script for name, script in scripts.items() if name not in driven}
    return {
        "scenario": scenario.name,
        "seed": seed,
        "count": count,
        **({"controlled_vehicle": driven[0]} if len(driven) == 1 else {"controlled_vehicles": driven}),
        "scripts": scripts,
        "time_step_s": scenario.time_step_s,
        "horizon_s": scenario.horizon_s,
        "no_limits_because": because,
        **found,
    }


def parameter_line(found: Mapping[str, Any]) -> str:
    """The ``parameters`` in one line, for captions: scenario, number of worlds, seed, then ``quantity_line``."""
    seed = "" if found["seed"] is None else f", seed {found['seed']}"
    return f"{found['scenario']}: {count_of(found['count'], 'world')}{seed}; {quantity_line(found)}"


def quantity_line(found: Mapping[str, Any]) -> str:
    """The ``quantities`` in one line, each with its symbol and unit: ``d = 7 m; v = (20, 18, 20) m/s; ...``."""
    parts = []
    for key, (symbol, unit) in _SYMBOLS.items():
        if key not in found:
            continue
        entries = [found[key]] if DECLARED[key].per == "world" else found[key]
        parts.append(f"{symbol}{_STAY}={_STAY}{_entries(entries)}{f'{_STAY}{unit}' if unit else ''}")
    return "; ".join(parts)


def _entry(column: Floats) -> float | list[float]:
    low, high = float(np.min(column)), float(np.max(column))
    return low if low == high else [low, high]


def _entries(entries: list[float | list[float]]) -> str:
    """``20``, ``(6, 7, 6)`` or ``5–10``; entries that read alike are written once."""
    texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
    return texts[0] if len(set(texts)) == 1 else f"({f',{_STAY}'.join(texts)})"
