"""Outcomes of agents in the same worlds, the registry of measures, their tallies, and the tables made of them."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from fractions import Fraction
from functools import cached_property, partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents import Knowledge, Source
from ethbrake_marl.errors import InvalidInput, PhysicsError, count_of, describe_error, unknown_name
from ethbrake_marl.evaluation.inputs import HASHES, hash_of_chunks, result_versions, scenario_sha256, worlds_sha256
from ethbrake_marl.evaluation.statistics import Moments, exact_sum, mean, rate
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.files.sheet import DASH, Column, Estimate, Row, Sheet, Shown, terminal_text
from ethbrake_marl.harm import HARM_COUNTS, INJURY_CURVES, Declared, HarmCount, Ledger, injury_probability, scored
from ethbrake_marl.limits import Limits, Unproven, known_limits
from ethbrake_marl.physics import Bools, Floats, ImpactRows, Ints, Messages, Worlds, advance, make_worlds
from ethbrake_marl.registry import Part, Registry
from ethbrake_marl.scenario import QUANTITY, Scenario, Task, load_scenario

_SHOWN_AGENTS = 5  # by name, in ``repr``
_NAMED = 10  # worlds left out that are named one by one; all stand in the JSON
COLUMN = "metric_"  # before the name of a registered measure, in JSON and in files with every world
Columns = dict[str, list[Any]]  # of one row per world
Values = NDArray[Any]  # [n]

# Columns of files with every world that hold texts, but for the types of vehicles.
UNSTATED = Knowledge((Source.UNSTATED,))
_TEXT_COLUMNS = {"agent", "scenario", "unavoidable_reason", "best_known_source", "ended", "knows"}
_ALWAYS_TOLD = (
    "gaps_m",
    "speeds_mps",
    "obstacle_gap_m",
)  # quantities of those files that may be the same in all worlds
_COLUMNS = ("at_rest", "predicted_harm", "chosen_policy", "shoved_m", "sampled_harm")  # of an outcome, [n]
_LIBRARIES = ("pandas", "polars", "columns")  # of a frame, in the order of preference


class IncompleteTable(UserWarning):
    """A table of best known harm holds some of the worlds asked about, and not the others."""


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
    knows: Knowledge = UNSTATED  # what the agent says it knows of the line
    shoved_m: Floats | None = None  # [n] how far Vehicle 1 ends beyond where it would by itself
    sampled_harm: Floats | None = None  # [n] the paper's sum over samples of the same commands
    policies: Mapping[str, str] = field(default_factory=dict)  # vehicle's name -> SHA-256 of its policy's manifest
    metrics: Mapping[str, Floats] = field(default_factory=dict)  # registered measures by column, [n]

    def __repr__(self) -> str:
        n, means = len(self.collided), "no harm"
        if n:
            means = f"harm {self.first_impact_harm.mean():.2f} first-impact, {self.total_harm.mean():.2f} total"
        return f"Outcome({count_of(n, 'world')}, {int(self.collided.sum()):,} collided, {means})"

    def take(self, rows: Ints | Bools) -> Outcome:
        """That of some of the worlds."""
        found = {name: getattr(self, name) for name in _COLUMNS}
        columns: dict[str, Any] = {name: None if column is None else column[rows] for name, column in found.items()}
        metrics = {name: column[rows] for name, column in self.metrics.items()}
        return replace(self, ledger=self.ledger.take(rows), final=self.final.take(rows), metrics=metrics, **columns)

    @classmethod
    def join(cls, parts: Sequence[Outcome]) -> Outcome:
        """One from those of consecutive worlds."""
        first, columns = parts[0], dict[str, Any]()
        for name in _COLUMNS:  # what one part cannot tell is not told of the whole
            told = [getattr(part, name) for part in parts]
            columns[name] = None if any(each is None for each in told) else np.concatenate(told)
        ledger = Ledger(*(np.concatenate([getattr(part.ledger, f.name) for part in parts]) for f in fields(Ledger)))
        final = Worlds.concatenate([part.final for part in parts])
        metrics = {name: np.concatenate([part.metrics[name] for part in parts]) for name in first.metrics}
        return replace(first, ledger=ledger, final=final, metrics=metrics, **columns)

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

    def borne(self, objectives: Sequence[Declared] = ()) -> dict[str, Floats]:
        """What each vehicle bears under both counts, ``total_harm_2``, and what each objective makes of it [n] (m2/s2).

        That is ``social:45_first_2``.
        """
        told = {"first_impact_harm": self.vehicle_harm("first"), "total_harm": self.vehicle_harm("total")}
        for objective in objectives:
            for harm_count in HARM_COUNTS:
                (values,) = scored(self.ledger, harm_count, [objective]).values()
                told[f"{objective}_{harm_count}"] = values
        return {f"{name}_{i + 1}": each[:, i] for name, each in told.items() for i in range(each.shape[1])}

    def columns(self) -> dict[str, Values | None]:
        """What happened in each world, by the names of ``--per-world``; None where the agent says nothing."""
        final, obstacle = self.final, {}
        if (ahead := final.obstacle_ahead).any():  # of the harm above, what Vehicle 1's impacts with the obstacle did
            obstacle = {
                "obstacle_first_impact_harm": np.where(ahead, self.ledger.obstacle_harm("first"), np.nan),
                "obstacle_total_harm": np.where(ahead, self.ledger.obstacle_harm("total"), np.nan),
                "final_obstacle_gap_m": np.where(ahead, final.obstacle_gap_m, np.nan),
            }
        return {
            "collided": self.collided + 0,
            "impacts": self.impacts,
            **self.borne(),
            "first_impact_harm": self.first_impact_harm,
            "total_harm": self.total_harm,
            "sampled_harm": self.sampled_harm,
            "vehicle_1_shoved_m": self.shoved_m,
            **obstacle,
            **{f"final_gap_{p + 1}_m": final.gaps_m[:, p] for p in range(final.N - 1)},
            **{f"final_speed_{i + 1}_mps": final.speeds_mps[:, i] for i in range(final.N)},
            "end_s": final.time_s,
            "ended": self.ended,
            "predicted_harm": self.predicted_harm,
            "chosen_policy": None if self.chosen_policy is None else self.chosen_policy + 0,
            **{COLUMN + name: column + 0 for name, column in self.metrics.items()},  # truths as 0 and 1
        }


def none_for_nan(column: Values) -> list[Any]:
    """The values of a column, None where there is no number."""
    return [None if value != value else value for value in column.tolist()]


class LeftOut(NamedTuple):
    """A world that is in no outcome, because it could not be advanced with one of the agents."""

    world: int  # number in its list
    seed: int | None  # of the list; None for worlds that were given
    agent: str  # the first one that met it
    reason: str

    def __str__(self) -> str:
        of = "" if self.seed is None else f" of seed {self.seed}"
        return f"world {self.world}{of} ({self.agent}: {self.reason})"

    @staticmethod
    def line(worlds: Sequence[str], whole: int) -> str:
        """That these of ``whole`` worlds, each named with its reason, count in no figure."""
        named = [*worlds[:_NAMED], *(["and so on"] if len(worlds) > _NAMED else [])]
        return (
            f"LEFT OUT for every agent: {len(worlds):,} of {whole:,} worlds, which the physics could not advance"
            f" (please report them): {'; '.join(named)}."
        )


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
    kinds: Mapping[str, NDArray[np.str_]] = field(default_factory=dict)  # ``scenario``, ``vehicle_2_type``: each [n]
    host: str = ""  # that moved the worlds; else the physics here, of which something is proven

    def __repr__(self) -> str:
        drivers = [f"{agent!r:.42}" for agent in list(self.outcomes)[:_SHOWN_AGENTS]]
        more = len(self.outcomes) - len(drivers)
        drivers += [f"{more} more"] if more else []
        seed = "" if self.seed is None else f" of seed {self.seed}"
        return (
            f"Evaluation({self.scenario.name!r}, {count_of(self.worlds.n, 'world')}{seed}, {self.task.names:.80} driven"
            f" by {', '.join(drivers)})"
        )

    def telling(self, names: Collection[str]) -> Evaluation:
        """The same, of registered measures with these alone."""
        outcomes = {}
        for agent, outcome in self.outcomes.items():
            kept = {c: each for c, each in outcome.metrics.items() if c in names or c.rpartition("_")[0] in names}
            outcomes[agent] = replace(outcome, metrics=kept)
        return replace(self, outcomes=outcomes)

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
        if self.host:
            return Unproven(f"{self.host} moved these worlds, and what is proven is of the physics here")
        found = known_limits(self.worlds, self.task)
        if isinstance(found, Limits) and found.warning:
            warnings.warn(found.warning, IncompleteTable, stacklevel=2)
        return found

    @classmethod
    def join(cls, parts: Sequence[Evaluation]) -> Evaluation:
        """One from those of consecutive worlds of a list; raises ``PhysicsError`` if every world was left out."""
        left_out = tuple(left for part in parts for left in part.left_out)
        some = [part for part in parts if part.worlds.n]
        if not some:
            raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in left_out})
        if len(parts) == 1:
            return parts[0]
        return replace(
            some[0],
            worlds=Worlds.concatenate([part.worlds for part in some]),
            index=np.concatenate([part.index for part in some]),
            outcomes={name: Outcome.join([part.outcomes[name] for part in some]) for name in some[0].outcomes},
            left_out=left_out,
            kinds={name: np.concatenate([part.kinds[name] for part in some]) for name in some[0].kinds},
        )

    def take(self, rows: Ints | Bools) -> Evaluation:
        """That of some of the worlds; nobody is left out of them."""
        outcomes = {name: outcome.take(rows) for name, outcome in self.outcomes.items()}
        kinds = {name: column[rows] for name, column in self.kinds.items()}
        return replace(
            self, worlds=self.worlds.take(rows), index=self.index[rows], outcomes=outcomes, left_out=(), kinds=kinds
        )

    def tally(
        self, *, baseline: str = "full_brake", limits: bool = True, objectives: Sequence[str] | None = None
    ) -> dict[str, AgentTally]:
        """The tally of every agent.

        Args:
            baseline: what is compared with, but for regrets, which are compared with full braking.
            limits: with what needs the best known harm of each world.
            objectives: also sum up what each vehicle bears, and these of it; None: neither.

        """
        regrets, values = self.regrets if limits else None, {}
        for agent, outcome in self.outcomes.items():
            told = ((m.name, m.values(outcome, regrets)) for m in (*measures(outcome.metrics), *COUNTED))
            values[agent] = {name: column for name, column in told if column is not None}
            values[agent] |= {} if objectives is None else outcome.borne(objectives)
        paired = {str(m.of): BASELINE if m.limits else baseline for m in measures() if m.against}
        found = {}
        for agent, own in values.items():
            truths = {name: column for name, column in own.items() if column.dtype == np.bool_}
            found[agent] = AgentTally(
                {name: (int(column.sum()), len(column)) for name, column in truths.items()},
                {name: Moments.of(column) for name, column in own.items() if name not in truths},
                {
                    name: exact_sum(own[name], values[other][name])
                    for name, other in paired.items()
                    if name in own and other in values
                },
            )
        return found

    @staticmethod
    def check_group(kinds: Collection[str], by: str) -> None:
        """Raise what ``summarise_by`` would for worlds with these columns of ``kinds``."""
        if not kinds:
            raise InvalidInput(
                f"by {by!r}: these worlds have no groups; those of a mixture have scenario, those with vehicle_types"
                " have vehicle_1_type and so on"
            )
        if by not in kinds:
            raise unknown_name("group", by, kinds)

    @property
    def hidden(self) -> Bools:
        """Worlds in which the channel hides something of the line from a driven vehicle, [n]; see ``v2x``."""
        from_each = [self.worlds.vehicles.hide_from(i) | Messages.of(self.worlds).periodic for i in self.vehicles]
        hidden: Bools = np.logical_or.reduce([np.zeros(self.worlds.n, np.bool_), *from_each])
        return hidden

    @cached_property
    def regrets(self) -> Regrets | None:
        """Best known harm of every world, the agents of this evaluation included; None where nothing is proven."""
        limits = self.limits
        if isinstance(limits, Unproven):
            return None
        outcomes = self.outcomes.values()
        first = np.fmin.reduce([limits.first_impact_harm, *(outcome.first_impact_harm for outcome in outcomes)])
        total = np.fmin.reduce([limits.total_harm, *(outcome.total_harm for outcome in outcomes)])
        regrets = Regrets(limits, first, total, np.zeros(0, np.str_))
        below = np.logical_or.reduce([regrets.below(outcome) for outcome in outcomes])
        avoidable = limits.proof.avoidable
        witness = np.zeros(below.shape, np.bool_) if avoidable is None else avoidable
        source = np.select([witness, ~limits.known, below], ["witness", "agents", "below_table"], "table")
        return replace(regrets, source=source)

    @property
    def conditions(self) -> Conditions:
        """Under which these are the results, with all quantities of the worlds."""
        because = self.limits.because if isinstance(self.limits, Unproven) else None
        return Conditions.of_test(self.task, self.seed, self.worlds.n, because, Conditions.of(self.worlds))

    def per_world(self, objectives: Sequence[Declared] = ()) -> Columns:
        """One row per agent and world; docs/per-world.md lists the columns. None where there is no value.

        Initial quantities are named as in a table of initial states: ``gap_1_m``, ``speed_1_mps``, ``latency_2_s``,
        ``restitution``.
        """
        n, regrets = self.worlds.n, self.regrets
        initial: Columns = {"world": self.index.tolist()}
        initial |= {name: column.tolist() for name, column in self.kinds.items()}
        for key, rule in QUANTITY.of(self.worlds).items():
            values = rule.of(self.worlds)
            if key in _ALWAYS_TOLD or np.ptp(values, axis=0).any():
                initial |= {rule.column_of(i): none_for_nan(values[:, i]) for i in range(values.shape[1])}
        found: Columns = {}
        for agent, outcome in self.outcomes.items():
            told = outcome.columns()
            for name, of in KNOWN_OF_WORLDS.items():
                told[name] = None if regrets is None else of(regrets, outcome)
            told |= {name: column for name, column in outcome.borne(objectives).items() if name not in told}
            columns: Columns = {
                "agent": [agent] * n,
                **initial,
                **{name: [None] * n if column is None else none_for_nan(column) for name, column in told.items()},
                "knows": [outcome.knows.text] * n,
                "hidden": self.hidden.astype(int).tolist(),
            }
            for left in self.left_out:
                told_of = {"agent": agent, "world": left.world, "ended": f"left out: {left.agent}: {left.reason}"}
                columns = {name: [*values, told_of.get(name)] for name, values in columns.items()}
            found = {name: [*found.get(name, ()), *values] for name, values in columns.items()}
        return found

    def arrays(self, objectives: Sequence[Declared] = ()) -> dict[str, NDArray[Any]]:
        """``per_world`` as arrays: NaN for no number, the empty text for no text."""
        found = {}
        for name, values in self.per_world(objectives).items():
            texts = name in _TEXT_COLUMNS or (name.startswith("vehicle_") and name.endswith("_type"))
            found[name] = np.array([("" if texts else np.nan) if value is None else value for value in values])
        return found

    def to_frame(self, library: str | None = None) -> Any:
        """One row per agent and world: the columns of ``--per-world`` (docs/per-world.md), NaN for no number.

        A pandas ``DataFrame`` where pandas is installed, else one of polars, else a mapping of column names to arrays.
        ``library`` asks for one of them: ``pandas``, ``polars`` or ``columns``. Raises ``UnknownName`` for another, and
        ``InvalidInput`` for one that is not installed.
        """
        if library is not None and library not in _LIBRARIES:
            raise unknown_name("library", library, _LIBRARIES)
        chosen = library or next((name for name in _LIBRARIES[:-1] if find_spec(name) is not None), _LIBRARIES[-1])
        if chosen == _LIBRARIES[-1]:
            return self.arrays()
        if find_spec(chosen) is None:
            raise InvalidInput(f"to_frame: {chosen} is not installed: {sys.executable} -m pip install {chosen}")
        return import_module(chosen).DataFrame(self.arrays())

    def rescore(self, declared: Sequence[Declared] | None = None) -> Rescores:
        """Every agent under every objective and both counts, in that order."""
        return Rescores(
            [
                Rescored(agent, objective, harm_count, tuple(mean(column) for column in values.T))
                for agent, outcome in self.outcomes.items()
                for harm_count in HARM_COUNTS
                for objective, values in scored(outcome.ledger, harm_count, declared).items()
            ]
        )

    def _repr_html_(self) -> str:
        """What each agent did, for a notebook."""
        share = Column("Collisions", digits=1, scale=100.0, unit=" %")
        rows = [
            (agent, rate(int(each.collided.sum()), self.worlds.n), mean(each.first_impact_harm), mean(each.total_harm))
            for agent, each in self.outcomes.items()
        ]
        note = "Means per world in m²/s², with their 95 % intervals. eb.summarise tells more."
        return Sheet(repr(self), ("Agent", share, Column("First-impact harm"), Column("Total harm")), rows, note).html()

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
# why none is shown alone.

TESTS = {
    "paper-random": "Main test, the paper's rules: Vehicle 2 may drive, nothing stands ahead of Vehicle 1, and pushing"
    " it on costs nothing in either count.",
    "paper-random-brake-only": "Brake-only test: the same worlds, but Vehicle 2 may only brake and coast; it can"
    " neither drive on nor push with its motor.",
    "paper-random-obstacle": "Obstacle test: the same worlds with the obstacle that Vehicle 1 brakes for, 1.7 m beyond"
    " where it stops by itself. Vehicle 1's impact with it is harm.",
}


def is_as_shipped(scenario: Scenario) -> bool:
    """Whether every value of the scenario is that of the shipped one of its name, whatever its texts say."""
    one, other = (
        each.model_dump(exclude={"title", "description", "source"}) for each in (scenario, load_scenario(scenario.name))
    )
    return one == other


def other_tests(scenario: Scenario) -> tuple[Scenario, ...]:
    """The two tests that belong beside results on ``scenario``; none where it is not one of the three as shipped."""
    if scenario.name not in TESTS or not is_as_shipped(scenario):
        return ()
    return tuple(load_scenario(name) for name in TESTS if name != scenario.name)


@dataclass(frozen=True, slots=True)
class PaperRow:
    """One row of a table of the paper, as printed; the paper reports a single harm and no intervals."""

    table: Literal["random test", "hybrid test"]
    agent: str  # the paper's name
    episodes: int
    collisions: int
    collision_rate: float
    average_harm: float  # m2/s2
    harm_decrease: float | None  # relative to Non-E, as printed


PAPER_ROWS = (
    PaperRow("random test", "Non-E", 10_000, 9391, 0.9391, 33.5878, 0.0),
    PaperRow("random test", "E-V2X-BM", 10_000, 8520, 0.852, 9.8772, 0.7059),
    PaperRow("random test", "Hybrid SAC", 10_000, 5896, 0.5896, 5.7001, 0.8302),
    PaperRow("random test", "Hybrid PPO", 10_000, 5974, 0.5974, 5.6202, 0.8326),
    PaperRow("hybrid test", "E-V2X-BM", 5_000, 4263, 0.8526, 9.8514, None),
    PaperRow("hybrid test", "Standalone DRL", 5_000, 3737, 0.7474, 12.229, None),
    PaperRow("hybrid test", "Hybrid", 5_000, 2995, 0.599, 7.3641, None),
)

PAPER_PARAMETERS = {
    "random test": (
        "10,000 worlds; d = 5–10 m; v = 18–22 m/s; braking and driving capacity (6, 7, 6) m/s²; τ2 = 0.5 s, τ3 = 0.8 s;"
        " m = (4.5, 5.5, 5.9) t; not stated: e, time step, horizon, seed"
    ),
    "hybrid test": (
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


def is_papers_test(task: Task, seed: int | None) -> bool:
    """Whether the paper's rows are about this: Vehicle 2 in a list of its random test, as shipped."""
    scenario = task.scenario
    return scenario.name in _SHOWN_WITH and seed is not None and task.vehicles == (1,) and is_as_shipped(scenario)


def check_papers_test(task: Task, seed: int | None) -> None:
    """Raise ``InvalidInput`` where the paper's rows are about something else."""
    if not is_papers_test(task, seed):
        raise InvalidInput(
            f"paper: the paper's rows are about Vehicle 2 in a list of {' or '.join(_SHOWN_WITH)} as shipped, and these"
            f" are {'worlds of no known seed' if seed is None else 'a list'} of {task.scenario.name!r};"
            f" {'give evaluate the seed of the list, or ' if seed is None else ''}leave paper out"
        )


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
    "friction": ("friction", ""),
    "brake_rate_mps3": ("brake rate", "m/s³"),
    "release_rate_mps3": ("release rate", "m/s³"),
}
_STAY = "\u00a0"  # a blank at which no line is broken


class Conditions(dict[str, Any]):
    """Under which results hold, as plain data: who drove what in which test, and every quantity of its worlds."""

    @classmethod
    def of(cls, worlds: Worlds) -> Conditions:
        """Every quantity of the worlds: a list per vehicle or pair, one entry for the whole world.

        An entry is a number where all worlds agree, else its ``[least, largest]`` value.
        """
        return cls.of_ranges({key: rule.of(worlds).T for key, rule in QUANTITY.of(worlds).items()})

    @classmethod
    def of_ranges(cls, ranges: Mapping[str, Iterable[Any]]) -> Conditions:
        """Those whose entries have these values, or these least and largest ones."""
        found = {
            key: [(float(np.nanmin(each)), float(np.nanmax(each))) for each in entries]
            for key, entries in ranges.items()
        }
        told = {key: [low if low == high else [low, high] for low, high in ends] for key, ends in found.items()}
        return cls({key: ends[0] if QUANTITY.declared[key].per == "world" else ends for key, ends in told.items()})

    @classmethod
    def of_test(
        cls, task: Task, seed: int | None, count: int, because: str | None, found: Mapping[str, Any]
    ) -> Conditions:
        """Those of a test.

        Args:
            task: scenario, and who was driven.
            seed: of the list; None for worlds that were given.
            count: number of worlds.
            because: why nothing is proven for these worlds; None where it is.
            found: the quantities of the worlds.

        """
        scenario = task.scenario
        driven = [scenario.vehicle_names[i] for i in task.vehicles]
        scripts = {scenario.vehicle_names[i]: script for i, script in scenario.scripts.items()}
        return cls(
            scenario=scenario.name,
            seed=seed,
            count=count,
            **({"controlled_vehicle": driven[0]} if len(driven) == 1 else {"controlled_vehicles": driven}),
            scripts={name: script for name, script in scripts.items() if name not in driven},
            time_step_s=scenario.time_step_s,
            horizon_s=scenario.horizon_s,
            no_limits_because=because,
            **found,
        )

    @property
    def line(self) -> str:
        """In one line, for captions: scenario, number of worlds, seed, then ``quantities``."""
        seed = "" if self["seed"] is None else f", seed {self['seed']}"
        return f"{self['scenario']}: {count_of(self['count'], 'world')}{seed}; {self.quantities}"

    @property
    def quantities(self) -> str:
        """The quantities in one line, each with its symbol and unit: ``d = 7 m; v = (20, 18, 20) m/s; ...``.

        Entries that read alike are written once.
        """
        parts = []
        for key, (symbol, unit) in _SYMBOLS.items():
            if key in self:
                entries = [self[key]] if QUANTITY.declared[key].per == "world" else self[key]
                texts = [f"{e[0]:.3g}–{e[1]:.3g}" if isinstance(e, list) else f"{e:.4g}" for e in entries]
                told = texts[0] if len(set(texts)) == 1 else f"({f',{_STAY}'.join(texts)})"
                parts.append(f"{symbol}{_STAY}={_STAY}{told}{f'{_STAY}{unit}' if unit else ''}")
        return "; ".join(parts)


# The limits of an evaluation: the least harm known of each world is that of ``limits.limits``, or what an agent of the
# same evaluation achieved, whichever is less.

NO_HARM = 1e-3  # m2/s2: nobody is hurt by 0.03 m/s
TOLERANCE = 1e-6  # m2/s2; less than this below the best known harm is rounding


@dataclass(frozen=True)
class Regrets:
    """The limits after all agents of one evaluation drove, [n] each."""

    limits: Limits
    first_impact_harm: Floats  # best known, the agents of this evaluation among them (m2/s2)
    total_harm: Floats
    source: NDArray[np.str_]  # where these come from: witness, table, agents or below_table

    def best(self, harm_count: HarmCount) -> Floats:
        """Best known harm under one count, [n] m2/s2."""
        return self.first_impact_harm if harm_count == "first" else self.total_harm

    def regret(self, outcome: Outcome, harm_count: HarmCount) -> Floats:
        """The outcome's harm minus the best known, [n] m2/s2, never negative."""
        return outcome.ledger.world_harm(harm_count) - self.best(harm_count)

    def below(self, outcome: Outcome) -> Bools:
        """Worlds in which the outcome is below what was known before, in either count, by more than rounding, [n]."""
        first, total = self.limits.first_impact_harm, self.limits.total_harm
        return (outcome.first_impact_harm < first - TOLERANCE) | (outcome.total_harm < total - TOLERANCE)

    @property
    def avoidable(self) -> Bools | None:
        """Where contact can be avoided, [n]; None where that is not decided."""
        return self.limits.proof.avoidable

    @property
    def between(self) -> Between | None:
        """The worlds with proven contact and no proven impact; None where contact is not decided."""
        if self.avoidable is None:
            return None
        return Between.of(~self.avoidable, self.limits.proof.impact, self.first_impact_harm, self.total_harm)


# What was avoidable and the best known in each world, by the names of ``--per-world``.
KNOWN_OF_WORLDS: dict[str, Callable[[Regrets, Outcome], Values | None]] = {
    "avoidable": lambda r, _: None if r.avoidable is None else r.avoidable + 0,
    "unavoidable_reason": lambda r, _: r.limits.proof.reason,
    "best_known_first_impact_harm": lambda r, _: r.first_impact_harm,
    "best_known_total_harm": lambda r, _: r.total_harm,
    "best_known_source": lambda r, _: r.source,
    "impact_proven": lambda r, _: r.limits.proof.impact + 0,
    "proven_harm": lambda r, _: r.limits.proof.harm,
    "regret_first_impact_harm": lambda r, o: r.regret(o, "first"),
    "regret_total_harm": lambda r, o: r.regret(o, "total"),
}


@dataclass(frozen=True, slots=True)
class Between:
    """The worlds with proven contact in which no impact is proven, and the least harm known there (m2/s2)."""

    rate: float  # share of all worlds
    mean_first: float | None  # None where there is no such world, or the least harm of none of them is known
    mean_total: float | None
    harmless_rate: float | None  # share of them whose best known total harm is below 1e-3

    @property
    def text(self) -> str:
        """What is known of them, as a sentence after another; empty without such a world."""
        if self.rate == 0.0:
            return ""
        text = f" In {100 * self.rate:.1f} % contact is certain, but perhaps no impact"
        if self.mean_first is None or self.harmless_rate is None:
            return f"{text}."
        return (
            f"{text}: the least harm known there is {self.mean_first:.2f} on average, and practically none in"
            f" {100 * self.harmless_rate:.0f} % of these."
        )

    @classmethod
    def of(cls, contact: Bools, impact: Bools, first: Floats, total: Floats) -> Between:
        """Those of worlds with these proofs; ``first`` and ``total`` [n] are the least harms known, NaN: none is."""
        there = contact & ~impact
        known = there & np.isfinite(first) & np.isfinite(total)
        if not known.any():
            return cls(float(there.mean()), None, None, None)
        harmless = float((total[known] < NO_HARM).mean())
        return cls(float(there.mean()), float(first[known].mean()), float(total[known].mean()), harmless)


# The entries.

BASELINE = "full_brake"
FAR_M = 5.0  # Vehicle 1 counts as shoved far beyond this
MOVING = 0.05  # share of worlds: more of them not at rest at the horizon, and harm after it may have been left out


@dataclass(frozen=True, slots=True)
class Measure:
    """Something that is told of every agent: where each world has a truth, a rate; where it has a number, a mean.

    ``of`` gives the values of all worlds, [n], from outcome and limits (None where nothing is proven), or None where
    there are none; or it names the measure whose values these are.
    """

    name: str  # in JSON
    of: Callable[[Outcome, Any], Values | None] | str
    heading: str = ""  # of its column in tables; "": in none
    short: str = ""  # the same in a terminal
    about: str = ""  # what it means; stands once for headings that begin alike
    percent: bool = False  # how a table shows it
    against: Literal["", "difference", "decrease"] = ""  # of the baseline, paired by world
    limits: bool = False  # it needs them
    always: bool = True  # JSON tells it where it does not exist, too: null

    def values(self, outcome: Outcome, regrets: Regrets | None) -> Values | None:
        """Those of an outcome."""
        if isinstance(self.of, str) or (self.limits and regrets is None):
            return None
        return self.of(outcome, regrets)

    def column(self) -> Column:
        """Its column in a table."""
        shown = {"digits": 1, "scale": 100.0, "unit": " %"} if self.percent else {}
        return Column(self.heading, self.name, short=self.short, **shown)  # type: ignore[arg-type]


_OF_THE_EPISODE = (
    Measure(
        "collision_rate", lambda o, _: o.collided, "Collisions", percent=True,
        about="Share of worlds with at least one impact; Wilson's interval. Every agent meets the same worlds, each"
        " once.",
    ),
    Measure(
        "first_impact_harm", lambda o, _: o.first_impact_harm, "First-impact harm", "First-impact\nharm",
        "Squared closing speed (m²/s²), summed over the pairs, each pair's first impact only (the paper's protocol);"
        " mean per world.",
    ),
    Measure(
        "total_harm", lambda o, _: o.total_harm, "Total harm", "Total\nharm",
        "The same over every impact. A light early touch makes a later, harder impact of the same pair free under the"
        " first count, so both are shown.",
    ),
    Measure(
        "sampled_harm", lambda o, _: o.sampled_harm, "Sampled harm", "Sampled\nharm",
        "The paper's own sum (its eq. Jharm): the agent's commands replayed through the paper's fixed-step map at the"
        " time step; at every sample each pair that overlaps and closes adds its squared closing speed (m²/s²), so"
        " pushing costs harm for as long as it lasts.",
    ),
    Measure(
        "vehicle_1_shoved_m", lambda o, _: o.shoved_m, "Vehicle 1 shoved (m)", "Shoved\nm",
        "How far Vehicle 1 ends beyond the point where it would stop by itself, mean per world; and the share of worlds"
        " in which that is more than 5 m. Both counts of harm leave pushing free unless something stands ahead; Vehicle"
        " 1 brakes for something.",
    ),
    Measure(
        "vehicle_1_shoved_far_rate", lambda o, _: None if o.shoved_m is None else o.shoved_m > FAR_M,
        "Vehicle 1 shoved > 5 m", "Shoved\n> 5 m", percent=True,
    ),
    Measure(
        "first_impact_harm_difference", "first_impact_harm", against="difference",
        about="First-impact harm minus that of full braking, paired by world.",
    ),
    Measure(
        "total_harm_difference", "total_harm", against="difference",
        about="The same of total harm.",
    ),
    Measure(
        "harm_decrease_first", "first_impact_harm", "Decrease, first-impact", "Decrease\nfirst",
        "1 − harm / harm of full braking in the same worlds; interval by the delta method, paired by world.",
        percent=True, against="decrease",
    ),
    Measure(
        "harm_decrease_total", "total_harm", "Decrease, total", "Decrease\ntotal", percent=True, against="decrease"
    ),
    Measure(
        "predicted_harm",
        lambda o, _: None if o.predicted_harm is None or not np.isfinite(o.predicted_harm).all() else o.predicted_harm,
        "Predicted harm", "Pre-\ndicted",
        "What the agent itself expected at the alert, under the count that it minimises.", always=False,
    ),
)  # fmt: skip

_OF_THE_LIMITS = (
    Measure(
        "unavoidable_rate", lambda _, r: None if r.avoidable is None else ~r.avoidable, limits=True,
        about="Share of worlds in which contact is proven unavoidable.",
    ),
    Measure(
        "impact_proven_rate", lambda _, r: r.limits.proof.impact, limits=True,
        about="Share of worlds in which an impact is proven unavoidable.",
    ),
    Measure(
        "avoidable_collision_rate",
        lambda o, r: None if r.avoidable is None else o.collided & r.avoidable, limits=True,
        about="Share of worlds with a collision, though contact is proven avoidable.",
    ),
    Measure(
        "best_known_first_impact_harm", lambda _, r: r.first_impact_harm, limits=True,
        about="The least first-impact harm known of the same worlds.",
    ),
    Measure(
        "best_known_total_harm", lambda _, r: r.total_harm, limits=True,
        about="The same of total harm.",
    ),
    Measure(
        "proven_harm", lambda _, r: r.limits.proof.harm, limits=True,
        about="Proven: nobody can do less.",
    ),
    Measure(
        "best_known_minus_proven_first", lambda _, r: r.first_impact_harm - r.limits.proof.harm, limits=True,
        about="What is left between the best known and the proof.",
    ),
    Measure(
        "best_known_minus_proven_total", lambda _, r: r.total_harm - r.limits.proof.harm, limits=True,
        about="The same of total harm.",
    ),
    Measure(
        "mean_regret", "mean_regret_first", limits=True,
        about="The same as mean_regret_first.",
    ),
    Measure(
        "mean_regret_first", lambda o, r: r.regret(o, "first"), "Regret, first-impact", "Regret\nfirst",
        "First-impact harm minus the best known first-impact harm of the same world; mean per world. The best known is"
        " 0 where contact is proven avoidable, else the result of a search over whole profiles of Vehicle 2, or of an"
        " agent in this table that did better. With ≥: the best of some world is known from these agents alone.",
        limits=True,
    ),
    Measure(
        "mean_regret_total", lambda o, r: r.regret(o, "total"), limits=True,
        about="The same of total harm.",
    ),
    Measure(
        "share_of_possible_reduction", "mean_regret_first", against="decrease", limits=True,
        about="The same as share_of_possible_reduction_first.",
    ),
    Measure(
        "share_of_possible_reduction_first", "mean_regret_first", "Share of the possible reduction, first-impact",
        "Share of\npossible",
        "(Full braking − agent) / (full braking − best known), first-impact harm: how much of the reduction of harm"
        " that is known to be possible the agent brings.",
        percent=True, against="decrease", limits=True,
    ),
    Measure(
        "share_of_possible_reduction_total", "mean_regret_total", against="decrease", limits=True,
        about="The same of total harm.",
    ),
)  # fmt: skip

HORIZON, CHOSEN, KNOWN, BELOW = "horizon_ends", "policy_share", "known", "below_best_known"
COUNTED = (  # told as numbers of worlds or shares, without an interval
    Measure(HORIZON, lambda o, _: ~o.at_rest),
    Measure(CHOSEN, lambda o, _: o.chosen_policy),
    Measure(KNOWN, lambda _, r: r.limits.known, limits=True),
    Measure(BELOW, lambda o, r: r.below(o), limits=True),
)


def _registered_values(name: str, outcome: Outcome, _: object) -> Values:
    return outcome.metrics[name]


def measures(columns: Iterable[str] = ()) -> tuple[Measure, ...]:
    """All that are told, in the order of JSON; ``columns`` are those of registered measures, as an outcome has them."""
    own = [Measure(COLUMN + name, partial(_registered_values, name), _heading(name)) for name in columns]
    return (*_OF_THE_EPISODE, *own, *_OF_THE_LIMITS)


# Their sums over some worlds, exact: they merge in any order to the same bits.


@dataclass(frozen=True, slots=True)
class AgentTally:
    """What one agent did in some worlds, by measure."""

    counts: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # worlds in which it is so, of how many
    moments: Mapping[str, Moments] = field(default_factory=dict)
    products: Mapping[str, Fraction] = field(default_factory=dict)  # with the baseline's

    def __add__(self, other: AgentTally) -> AgentTally:
        counts = dict(self.counts)
        for name, (so, of) in other.counts.items():
            before = counts.get(name, (0, 0))
            counts[name] = before[0] + so, before[1] + of
        moments, products = dict(self.moments), dict(self.products)
        moments |= {name: moments.get(name, Moments()) + each for name, each in other.moments.items()}
        products |= {name: products.get(name, Fraction()) + each for name, each in other.products.items()}
        return AgentTally(counts, moments, products)

    def count(self, name: str) -> int:
        """Worlds in which it is so."""
        return self.counts.get(name, (0, 0))[0]

    def share(self, name: str, worlds: int) -> float | None:
        """Their share; None unless all of the worlds have it."""
        so, of = self.counts.get(name, (0, 0))
        return so / worlds if of == worlds else None

    def found(self, name: str, worlds: int) -> Moments | None:
        """The moments of a number; None unless all of the worlds have it."""
        moments = self.moments.get(name)
        return moments if moments is not None and moments.count == worlds else None


Range = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Tally:
    """The statistics of some worlds of a list, added in any order; ``worlds_hash`` as in ``worlds_sha256``."""

    worlds: int = 0  # that count, driven by all agents
    hidden: int = 0  # in which the channel hides something from a driven vehicle
    worlds_hash: int = 0
    ranges: Mapping[str, tuple[Range, ...]] = field(default_factory=dict)  # least and largest of every quantity
    left_out: tuple[LeftOut, ...] = ()
    agents: Mapping[str, AgentTally] = field(default_factory=dict)

    @classmethod
    def of(cls, part: Evaluation, objectives: Sequence[str] | None = None, *, limits: bool = False) -> Tally:
        """Those of a part of a list; ``objectives`` and ``limits`` as in ``Evaluation.tally``."""
        worlds = part.worlds
        if not worlds.n:
            return cls(left_out=part.left_out)
        ranges = {
            name: tuple((float(np.nanmin(c)), float(np.nanmax(c))) for c in rule.of(worlds).T)
            for name, rule in QUANTITY.of(worlds).items()
        }
        agents = part.tally(limits=limits, objectives=objectives)
        hashed = hash_of_chunks(worlds, part.index)
        return cls(worlds.n, int(part.hidden.sum()), hashed, ranges, part.left_out, agents)

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
        )

    def rescore(self, objectives: Sequence[str], vehicles: int) -> Rescores:
        """Every agent under these objectives and both counts, as ``Evaluation.rescore``."""
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


def _estimate_all(
    tallies: Mapping[str, AgentTally], agent: str, worlds: int, *, baseline: str
) -> dict[str, Estimate | None]:
    """What one agent did in so many worlds, by measure; None for what not all of them have."""
    own = tallies[agent]
    columns = [name.removeprefix(COLUMN) for name in (*own.counts, *own.moments) if name.startswith(COLUMN)]
    registered = list(REGISTERED.values())
    columns.sort(key=lambda column: registered.index(each) if (each := _registered(column)) else len(registered))

    def estimate(measure: Measure) -> Estimate | None:
        name = measure.name if callable(measure.of) else measure.of
        if own.share(name, worlds) is not None:
            return rate(own.count(name), worlds)
        found = own.found(name, worlds)
        if found is None or not measure.against:
            return None if found is None else found.estimate
        compared = tallies.get(BASELINE if measure.limits else baseline)
        other = None if compared is None else compared.found(name, worlds)
        if other is None or (measure.limits and own.count(KNOWN) != worlds):
            return None
        product = own.products[name]
        return found.decrease(other, product) if measure.against == "decrease" else found.minus(other, product).estimate

    return {measure.name: estimate(measure) for measure in measures(columns)}


# Measures of the user's own: functions of every impact of an episode.

_NAME = re.compile(r"(?!.*_([0-9]+|interval|low|high)\Z)[a-z][a-z0-9_]{0,63}")  # x_2 is that of the second vehicle


@dataclass(frozen=True, slots=True)
class EpisodeImpacts:
    """What a registered measure is computed from, for n episodes of N vehicles; its arrays cannot be written to."""

    worlds: Worlds  # [n] at the alert
    rows: ImpactRows  # every impact, by world and then by time, arrays [k]

    @classmethod
    def unwritable(cls, worlds: Worlds, rows: ImpactRows) -> EpisodeImpacts:
        """Those of these episodes; the arrays of ``rows`` cannot be written to from now on."""
        for column in fields(rows):
            getattr(rows, column.name).flags.writeable = False
        return cls(worlds.read_only(), rows)

    @property
    def largest_speed_change_mps(self) -> Floats:
        """The largest change of speed of each vehicle in one impact (delta-v), [n, N]; 0 without one.

        One that is pushed by a vehicle that touches it already has no impact of its own, and so no change from it.
        """
        rows, change = self.rows, np.zeros(self.worlds.speeds_mps.shape)
        np.maximum.at(change, (rows.world, rows.pair + 1), np.abs(rows.rear_speed_change_mps))
        pairs = rows.pair >= 0  # an obstacle ahead is no vehicle
        np.maximum.at(change, (rows.world[pairs], rows.pair[pairs]), np.abs(rows.front_speed_change_mps[pairs]))
        return change


EpisodeFunction = Callable[[EpisodeImpacts], Values]


@dataclass(frozen=True, slots=True)
class _Registered:
    """A measure beside the usual ones."""

    name: str
    unit: str
    about: str
    function: EpisodeFunction
    form: str = ""  # what it gives: a truth or a number, per world or per vehicle


def register_measure(name: str, function: EpisodeFunction, *, unit: str = "1") -> None:
    """Make every evaluation from now on tell ``name`` with its interval: in tables, files and pages.

    An installed package does the same, for evaluations that name it, with an entry point of the group
    ``ethbrake_marl.measures``: its function, a ``Part`` of it, or a mapping of names to such.

    Args:
        name: 1 to 64 of ``a-z``, digits and ``_``, beginning with a letter, not ending in ``_`` and a number,
            ``_interval``, ``_low`` or ``_high``; columns are called ``metric_NAME``.
        function: from ``EpisodeImpacts`` to a number for each world [n], or one for each vehicle [n, N], which
            become columns of their own; of truths a rate is told. Its docstring says what it is. It must work for
            lines of any length.
        unit: of its numbers.

    Registering the same again changes nothing. Raises ``AlreadyExists`` for another one under a name that is taken,
    ``InvalidInput`` for what cannot be used, a function among that which fails, or gives another shape or a number that
    is not finite, in two worlds.

    """
    if not isinstance(name, str) or _NAME.fullmatch(name) is None:
        raise InvalidInput(
            f"measure {name!r:.80}: must be 1 to 64 of a-z, 0-9 and _, beginning with a letter, not ending in _"
            " and a number, _interval, _low or _high"
        )
    if not callable(function) or not (function.__doc__ or "").strip():
        raise InvalidInput(f"measure {name!r}: needs a function with a docstring that says what it is")
    metric = _Registered(name, str(unit), " ".join((function.__doc__ or "").split()), function)
    metric = replace(metric, form=_form(_checked(metric, _tried())))
    MEASURES.add(name, metric, lambda other: other == metric)


MEASURES: Registry[_Registered] = Registry("measure", "measures", register_measure)
REGISTERED = MEASURES.loaded  # those that every evaluation tells
LOADED: dict[str, None] = {}  # names that ``load_measures`` was given, in order


def load_measures(names: Iterable[str]) -> None:
    """Make every evaluation from now on tell these measures: those of installed packages, ``injury`` among them.

    ``my_file.py:measure`` runs that file, which can do whatever you can: it names a function or a ``Part``. Raises
    ``UnknownName`` with a suggestion, ``InvalidInput`` for what cannot be loaded.
    """
    for name in names:
        file, colon, own = name.rpartition(":")
        if colon:
            part = load_from_file(file, own)
            given, settings = (part.given, part.settings) if isinstance(part, Part) else ((part,), {})
            register_measure(own, *given, **settings)
        else:
            MEASURES.load(name)
        LOADED[name] = None


def _injury(curve: str, rule: Literal["", "_vehicle", "_every"]) -> EpisodeFunction:
    def told(episodes: EpisodeImpacts) -> Values:
        rows, found = episodes.rows, np.zeros(episodes.worlds.speeds_mps.shape)
        struck = rows.pair >= 0  # an obstacle ahead is no vehicle
        world = np.concatenate([rows.world, rows.world[struck]])
        vehicle = np.concatenate([rows.pair + 1, rows.pair[struck]])
        front, rear = np.abs(rows.rear_speed_change_mps), np.abs(rows.front_speed_change_mps[struck])
        p = np.concatenate([injury_probability(front, "front", curve), injury_probability(rear, "rear", curve)])
        if rule == "_every":
            np.add.at(found, (world, vehicle), p)
        else:  # of several entries for one vehicle the last one stays, which is that of the largest change
            order = np.argsort(np.concatenate([front, rear]), kind="stable")
            found[world[order], vehicle[order]] = p[order]
        return 1_000.0 * (found if rule == "_vehicle" else found.sum(axis=1))

    each = {
        "": "summed over the vehicles, each by its largest change of speed",
        "_vehicle": "by its largest change of speed",
        "_every": "summed over every impact, as if each met other people",
    }
    about = INJURY_CURVES[curve]
    told.__doc__ = (
        f"Injuries of {about.injury} in 1,000 lines, {each[rule]}: {about.formula}; dv in m/s ({about.source})."
    )
    return told


_RULES: tuple[Literal["", "_vehicle", "_every"], ...] = ("", "_vehicle", "_every")
# The injuries in 1,000 lines, by each of ``harm.INJURY_CURVES``, under one name of the entry points (pyproject.toml).
#
# ``injury_CURVE`` is the sum over the vehicles of a line, each by its largest change of speed, as the literature takes
# it; ``injury_CURVE_vehicle`` tells it of each; ``injury_CURVE_every`` sums over every impact, as if each met other
# people. A vehicle that was not hit has none, nor has one pushed by a vehicle that touches it already.
INJURY = {
    f"injury_{curve}{rule}": Part(_injury(curve, rule), unit="per 1,000 lines")
    for curve in INJURY_CURVES
    for rule in _RULES
}


def _heading(column: str) -> str:
    metric = _registered(column)
    if metric is None:  # of results that were computed before it was forgotten
        return column
    vehicle = column.removeprefix(metric.name).removeprefix("_")
    return f"{metric.name}{f', vehicle {vehicle}' if vehicle else ''} ({metric.unit})"


def _registered(column: str) -> _Registered | None:
    return REGISTERED.get(column) or REGISTERED.get(column.rpartition("_")[0])


def _form(values: Values) -> str:
    return f"a {'truth' if values.dtype == np.bool_ else 'number'} per {'world' if values.ndim == 1 else 'vehicle'}"


def _checked(metric: _Registered, episodes: EpisodeImpacts) -> Values:
    """What it gives, [n] or [n, N], checked."""
    what, (n, vehicles) = f"measure {metric.name!r}", episodes.worlds.speeds_mps.shape
    try:
        given = metric.function(episodes)
        value = np.asarray(None if np.ma.isMaskedArray(given) else given)
    except Exception as error:
        raise InvalidInput(f"{what}: its function fails: {describe_error(error)}") from error
    if value.shape not in ((n,), (n, vehicles)) or value.dtype.kind not in "fiub":
        raise InvalidInput(
            f"{what}: gave {value.dtype} of shape {value.shape}; must be numbers of shape ({n},), one per world, or"
            f" ({n}, {vehicles}), one per vehicle too"
        )
    finite = np.isfinite(value).reshape(n, -1).all(axis=1)
    if not finite.all():
        world = int(np.argmin(finite))
        raise InvalidInput(f"{what}: is {value[world]} in world {world}; must be finite")
    return value if value.dtype == np.bool_ else value.astype(np.float64)


def _tried() -> EpisodeImpacts:
    """Two lines of three, one with an impact of its second pair."""
    worlds = make_worlds(
        [[8.0, 6.0], [3.0, 21.0]],
        [[20.0, 18.0, 22.0], [9.0, 13.0, 11.0]],
        braking_capacity_mps2=[6.0, 7.0, 5.0],
        driving_capacity_mps2=[1.0, 2.0, 3.0],
        latency_s=[0.0, 0.5, 0.25],
        mass_t=[4.5, 15.5, 5.9],
        restitution=[0.0, 0.3],
    )
    one = (np.array([each]) for each in (2.5, 4.0, True, 1.2, -3.1))
    return EpisodeImpacts.unwritable(worlds, ImpactRows(np.array([0]), np.array([1]), *one))


class Tape:
    """The steps of a batch of episodes as they are driven (``Watch``), and every impact in them.

    With ``steps`` False only the impacts are kept.
    """

    def __init__(self, worlds: Worlds, *, steps: bool = True) -> None:
        self.worlds = worlds  # at the alert
        self.steps: list[tuple[Worlds, Floats, Floats]] = []  # before, commands [n, N], until [n]
        self._keeps_steps = steps
        self._rows: list[ImpactRows] = []

    def see(self, before: Worlds, command_mps2: Floats, until_s: Floats) -> None:
        """Keep one step."""
        moving = until_s > before.time_s
        some = np.flatnonzero(moving | (before.time_s == self.worlds.time_s))  # an impact at the very alert
        rows = advance(before.take(some), command_mps2[some], until_s=until_s[some], record=True)[1].rows
        assert rows is not None  # they were asked for
        self._rows.append(replace(rows, world=some[rows.world]))
        if self._keeps_steps:
            self.steps.append((before, command_mps2, until_s))

    def impacts(self) -> ImpactRows:
        """Every impact so far, by world and then by time."""
        columns = {f.name: np.concatenate([getattr(rows, f.name) for rows in self._rows]) for f in fields(ImpactRows)}
        order = np.argsort(columns["world"], kind="stable")
        return ImpactRows(**{name: column[order] for name, column in columns.items()})

    def measured(self) -> dict[str, Values]:
        """Every registered measure of these episodes by column, [n]: ``NAME``, or ``NAME_1``, ``NAME_2``, ...

        Raises ``InvalidInput`` that names measure and world.
        """
        episodes = EpisodeImpacts.unwritable(self.worlds.take(np.arange(self.worlds.n)), self.impacts())
        found: dict[str, Values] = {}
        for metric in REGISTERED.values():
            values = _checked(metric, episodes)
            if _form(values) != metric.form:
                raise InvalidInput(
                    f"measure {metric.name!r}: gave {_form(values)}; when it was registered it gave {metric.form}"
                )
            if values.ndim == 1:
                found[metric.name] = values
            else:
                found |= {f"{metric.name}_{i + 1}": column.copy() for i, column in enumerate(values.T)}
        return found


@dataclass(frozen=True, slots=True)
class Rescored:
    """One agent under one objective and count: the mean for each vehicle, front to rear (m2/s2); less is better."""

    agent: str
    objective: str
    harm_count: HarmCount
    each: tuple[Estimate, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON: objective, harm count, and each vehicle's mean with its interval."""
        each = Estimate.side_by_side({f"vehicle_{i + 1}": estimate for i, estimate in enumerate(self.each)})
        return {"objective": self.objective, "harm_count": self.harm_count, **each}


class Rescores(list[Rescored]):
    """Agents under objectives and counts: a list that ``print`` and a notebook show as two tables."""

    def __str__(self) -> str:
        return terminal_text(self.sheet("first"), "", self.sheet("total"))

    def _repr_html_(self) -> str:
        return "\n".join(self.sheet(harm_count).html() for harm_count in HARM_COUNTS)

    def sheet(self, harm_count: HarmCount) -> Sheet:
        """The means under one count: one line per agent and objective, one column per vehicle."""
        shown = [row for row in self if row.harm_count == harm_count]
        vehicles = range(len(shown[0].each) if shown else 0)
        columns = [Column(f"Vehicle {i + 1}", interval="below") for i in vehicles]
        names = ["" if k and shown[k - 1].agent == row.agent else row.agent for k, row in enumerate(shown)]
        lines = [(name, row.objective, *row.each) for name, row in zip(names, shown, strict=True)]
        title = f"Objectives, {'first-impact' if harm_count == 'first' else 'total'} harm"
        note = "Means per world in m²/s² (injury:CURVE: injuries in 1,000 lines), with their 95 % intervals."
        return Sheet(title, ["Agent", "Objective", *columns], lines, note)


@dataclass(frozen=True, slots=True)
class Exploits:
    """What an agent does that harm does not count: it shoves Vehicle 1, or still moves at the horizon.

    >>> from ethbrake_marl.evaluation.measures import Exploits
    >>> found = Exploits(shoved_m=8.1, moving=0.504)
    >>> found.names, found.text
    (('shoves', 'moving'), 'shoves Vehicle 1 by 8.1 m on average, still moves at the horizon in 50.4 % of the worlds')
    >>> Exploits(shoved_m=None, moving=0.0).names  # shoving is not measured
    ()

    """

    shoved_m: float | None  # how far Vehicle 1 ends beyond where it would by itself, mean; None: not measured
    moving: float  # share of the worlds in which the line is not at rest at the horizon

    @classmethod
    def of_json(cls, row: Mapping[str, Any]) -> Exploits:
        """Those of a row of a results file."""
        return cls(row.get("vehicle_1_shoved_m"), row["horizon_ends"] / row["episodes"])

    @property
    def names(self) -> tuple[str, ...]:
        """Which of the two are beyond what is usual: ``shoves`` (more than 5 m), ``moving`` (more than 5 %)."""
        shoves = self.shoved_m is not None and self.shoved_m > FAR_M
        return ("shoves",) * shoves + ("moving",) * (self.moving > MOVING)

    @property
    def text(self) -> str:
        """The same in words; empty without any."""
        words = {
            "shoves": f"shoves Vehicle 1 by {self.shoved_m or 0.0:.1f} m on average",
            "moving": f"still moves at the horizon in {100 * self.moving:.1f} % of the worlds",
        }
        return ", ".join(words[name] for name in self.names)

    @staticmethod
    def sentence(agents: Mapping[str, Exploits]) -> str:
        """What stands below a table of these agents; empty where none of them does such a thing."""
        each = "; ".join(f"{agent} {found.text}" for agent, found in agents.items() if found.names)
        return f"{MARK} Harm does not count this: {each} (docs/exploits.md)." if each else ""


# The table of an evaluation: a row per agent, for a terminal and for a document, and the sentences below it.

MARK = "‡"  # behind the name of an agent that exploits what harm does not count
SEES_THROUGH = "† "  # before what an agent knows that no channel brought
_HEAD = {
    "Agent": "What drives the controlled vehicle; all other vehicles follow the scenario. full_brake is the paper's"
    " non-ethical strategy (Non-E). e_v2x_bm is the best constant deceleration found in this simulation;"
    " e_v2x_bm:pairwise is the paper's closed form, which treats the pairs as independent.",
    "Knows": "What the agent has to know of the line. own sensors: its own vehicle and what its sensors see. messages:"
    " also the messages that have reached it. true state: the others' states, capacities and latencies as they are,"
    " received or not. true model: also masses, restitution and scripts, enough to simulate the line ahead. Of a policy"
    " behind a shield or +search both parts are told. † marks agents that see through a channel that hides"
    " something here.",
}
_ALWAYS_SHOWN = ("collision_rate", "first_impact_harm", "total_harm", "sampled_harm", "vehicle_1_shoved_m")
_NARROW = (  # in a narrow terminal too, where there is no regret to show, and where there is
    ("harm_decrease_first", "harm_decrease_total"),
    ("mean_regret_first", "share_of_possible_reduction_first"),
)
_IN_NOTEBOOKS = (
    *("Agent", "Knows", "collision_rate", "first_impact_harm", "total_harm"),
    *("mean_regret_first", "harm_decrease_first", "share_of_possible_reduction_first"),
)
_BELOW = ("collision_rate", "first_impact_harm", "total_harm")  # a terminal shows their intervals; JSON has all


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """What one agent achieved over the list of worlds; harms are means per world, m2/s2.

    ``row["harm_decrease_total"]`` is the estimate of any measure, by its name in JSON; None where it does not exist.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> rows[0].agent, rows[0].collisions, round(rows[0].total_harm.value, 2), rows[0]["predicted_harm"]
    ('full_brake', 2, 36.99, None)

    """

    agent: str  # its name
    episodes: int  # worlds
    estimates: Mapping[str, Estimate | None]  # of every measure, by its name in JSON
    collisions: int  # worlds with at least one impact
    horizon_ends: int  # worlds that the horizon cut off before the line stood
    parameters: Conditions  # of the test
    policy_share: float | None = None  # share of worlds in which a hybrid drove by its policy
    known_best_share: float | None = None  # worlds whose best is known without the agents of this evaluation
    below_best_known: int | None = None  # worlds in which the agent is below it
    between: Between | None = None  # the worlds in which contact is proven and no impact
    warning: str = ""  # a table of best known harm holds some of the worlds, and not the others
    left_out: tuple[LeftOut, ...] = ()  # worlds of the list that no row counts: they could not be advanced
    beside_paper: bool = False  # the paper's rows stand below
    knows: Knowledge = UNSTATED  # what the agent says it knows of the line
    hidden_share: float = 0.0  # worlds in which the channel hides something from a driven vehicle, whoever drives
    worlds_sha256: str = ""  # of the list; results on the same worlds have the same
    scenario_sha256: str = ""  # of all that shapes an episode
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle -> its policy's, where one drives
    versions: Mapping[str, str] = field(default_factory=dict)  # of what computed it

    def __getitem__(self, measure: str) -> Estimate | None:
        return self.estimates[measure]

    @property
    def collision_rate(self) -> Estimate:
        """Share of worlds."""
        return self.estimates["collision_rate"]  # type: ignore[return-value]  # all have it in all worlds

    @property
    def first_impact_harm(self) -> Estimate:
        """Each pair's first impact."""
        return self.estimates["first_impact_harm"]  # type: ignore[return-value]  # all have it in all worlds

    @property
    def total_harm(self) -> Estimate:
        """Every impact."""
        return self.estimates["total_harm"]  # type: ignore[return-value]  # all have it in all worlds

    @property
    def metrics(self) -> dict[str, Estimate]:
        """Registered measures, by column."""
        found = {name.removeprefix(COLUMN): each for name, each in self.estimates.items() if name.startswith(COLUMN)}
        return {name: each for name, each in found.items() if each is not None}

    @property
    def sees_through(self) -> bool:
        """Whether the channel hides something here that this agent reads all the same."""
        return self.hidden_share > 0.0 and self.knows.sees_through

    @property
    def exploits(self) -> Exploits:
        """What it does that harm does not count."""
        shoved = self.estimates["vehicle_1_shoved_m"]
        return Exploits(None if shoved is None else shoved.value, self.horizon_ends / self.episodes)

    @property
    def marked(self) -> str:
        """Its agent, marked where it exploits what harm does not count."""
        return f"{self.agent} {MARK}" if self.exploits.names else self.agent

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON; what does not exist is null, intervals are ``[low, high]``."""
        of_limits = {measure.name for measure in measures() if measure.limits}
        optional = {measure.name for measure in measures() if not measure.always}
        told = {name: each for name, each in self.estimates.items() if each or name not in optional}
        return {
            "kind": "evaluate",
            "agent": self.agent,
            "knows": self.knows.text,
            "sees_through_channel": self.sees_through,
            "hidden_share": self.hidden_share,
            "episodes": self.episodes,
            "collisions": self.collisions,
            "horizon_ends": self.horizon_ends,
            "exploits": list(self.exploits.names),
            **Estimate.side_by_side({name: each for name, each in told.items() if name not in of_limits}),
            **({"policy_share": self.policy_share} if self.policy_share is not None else {}),
            **Estimate.side_by_side({name: each for name, each in told.items() if name in of_limits}),
            "known_best_share": self.known_best_share,
            "best_known_warning": self.warning or None,
            "below_best_known": self.below_best_known,
            "impact_unproven": None if self.between is None else asdict(self.between),
            "left_out": [left._asdict() for left in self.left_out],
            "worlds_sha256": self.worlds_sha256,
            "scenario_sha256": self.scenario_sha256,
            "policy_sha256": dict(self.policy_sha256),
            "versions": dict(self.versions),
            **({"metrics": {name: _heading(name) for name in self.metrics}} if self.metrics else {}),
            "parameters": self.parameters,
        }


class SummaryTable(list[SummaryRow]):
    """The rows of ``summarise``: a list that ``print`` and a notebook show as a table.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> isinstance(rows, eb.SummaryTable), len(rows)
    (True, 1)

    """

    def __repr__(self) -> str:
        return f"SummaryTable({', '.join(row.agent for row in self)})"

    def __str__(self) -> str:
        return terminal_text(*self.tables())

    def _repr_html_(self) -> str:
        note = "Harm: means per world in m²/s². In brackets: 95 % intervals. Decrease: of full braking's harm."
        note += f" WARNING: {self[0].warning}." if self and self[0].warning else ""
        worlds = f"{self[0].parameters['scenario']}, {count_of(self[0].episodes, 'world')}" if self else "no agent"
        sheet = self.sheet()
        ours = replace(sheet, title=worlds, rows=sheet.rows[: len(self)], note=note)
        return ours.only(k for k, name in enumerate(sheet.names) if name in _IN_NOTEBOOKS).html()

    @classmethod
    def of_tallies(
        cls,
        tallies: Mapping[str, AgentTally],
        conditions: Conditions,
        task: Task,
        knows: Mapping[str, Knowledge],
        policies: Mapping[str, Mapping[str, str]],
        *,
        baseline: str = BASELINE,
        paper: bool = False,
        **shared: Any,
    ) -> SummaryTable:
        """One row per agent, from what was counted in the worlds of a list.

        Args:
            tallies: of every agent.
            conditions: of the test.
            task: who is driven where.
            knows: by agent.
            policies: by agent: vehicle's name -> SHA-256 of its policy.
            baseline: what is compared with.
            paper: show the paper's rows below.
            shared: what all rows say alike.

        Raises ``InvalidInput`` for ``paper`` where its rows are about something else.

        """
        worlds = conditions["count"]
        if paper:
            check_papers_test(task, conditions["seed"])
        return cls(
            SummaryRow(
                agent=agent,
                episodes=worlds,
                estimates=_estimate_all(tallies, agent, worlds, baseline=baseline),
                collisions=tally.count("collision_rate"),
                horizon_ends=tally.count(HORIZON),
                policy_share=tally.share(CHOSEN, worlds),
                known_best_share=tally.share(KNOWN, worlds),
                below_best_known=tally.count(BELOW) if BELOW in tally.counts else None,
                knows=knows[agent],
                policy_sha256=policies[agent],
                parameters=conditions,
                beside_paper=paper,
                **shared,
            )
            for agent, tally in tallies.items()
        )

    def meanings(self) -> dict[str, str]:
        """What the columns mean, by the beginning of their headings; those of registered measures last."""
        about = {each.heading.partition(",")[0]: each.about for each in measures() if each.about and each.heading}
        own = [_registered(column) for column in self[0].metrics] if self else []
        return _HEAD | about | {metric.name: metric.about for metric in own if metric is not None}

    def sheet(self) -> Sheet:
        """The table: agent, what it knows, and every measure that has a heading, those of registered ones last.

        A regret is marked as a lower bound where the best of some world is not known beforehand. Below it stand the
        paper's rows, if they were asked for.
        """
        columns = [each.column() for each in measures() if each.heading]
        columns += [Column(_heading(name), COLUMN + name) for name in (self[0].metrics if self else ())]
        lines: list[Row] = []
        for row in self:
            cells: dict[str, Any] = {column.name: row[column.name] for column in columns}
            value, interval = Column("").show(row["mean_regret_first"])
            bound = row.known_best_share is not None and row.known_best_share < 1.0
            cells["mean_regret_first"] = Shown(f"≥ {value}" if bound else value, interval)
            lines.append((row.marked, SEES_THROUGH * row.sees_through + row.knows.text, *cells.values()))
        for paper in PAPER_ROWS if self and self[0].beside_paper else ():
            printed = {
                "collision_rate": f"{100 * paper.collision_rate:.4g} %",
                "first_impact_harm": f"{paper.average_harm:.6g}",
            }
            if paper.harm_decrease is not None:
                printed["harm_decrease_first"] = f"{100 * paper.harm_decrease:.4g} %"
            section = f"paper, {paper.table}"
            lines += [] if section in lines else [section]
            lines.append((paper.agent, None, *(printed.get(column.name) for column in columns)))
        return Sheet("", ["Agent", "Knows", *columns], lines)

    def terminal(self) -> Sheet:
        """The table for a terminal of 80 columns or more: ours, then the paper's rows, then the conditions of each."""
        narrow = (*_ALWAYS_SHOWN, *_NARROW[bool(self.limit_line())])
        columns = [
            replace(each, wide=each.name not in narrow, interval="below" if each.name in _BELOW else "hidden")
            for each in (measure.column() for measure in measures() if measure.heading)
        ]
        lines: list[Row] = []
        for row in self.sheet().rows:
            if not isinstance(row, str):
                row = (row[0] if row[1] is None else f"{row[0]}\n{row[1]}", *row[2 : 2 + len(columns)])
            lines.append(row)
        return Sheet("", [Column("Agent,\nwhat it knows", text=True), *columns], lines, self._conditions(), gap=1)

    def tables(self) -> list[Sheet]:
        """``terminal``, and below it the registered measures: a line per agent, the mean per world, its interval."""
        lines = [(row.agent, _heading(column), value) for row in self for column, value in row.metrics.items()]
        own = Sheet("Measures", ["Agent", Column("Measure", text=True), Column("Mean or rate")], lines)
        return [self.terminal(), own] if lines else [self.terminal()]

    def brief(self, beside: Mapping[str, SummaryTable]) -> Sheet:
        """The table on one screen: collisions and both harms, also in the tests ``beside``, and what must be told.

        The paper's rows, and the other measures, are not in it.
        """
        ours = SummaryTable(replace(row, beside_paper=False) for row in self)
        sheet = ours.terminal()
        kept = sheet.only(k for k, name in enumerate(sheet.names) if k == 0 or name in _BELOW)
        columns, rows = list(kept.columns), [list(row) for row in kept.rows]
        note = f"{ours[0].parameters.line}. Harm: mean per world in m²/s², below it the 95 % interval."
        notes = [note, *(text for _, text in ours.notes())]
        for test, table in beside.items():
            drove = {row.agent: row for row in table}
            columns.append(Column(f"{TESTS[test].partition(' test')[0]}:\nfirst, total"))
            for row, each in zip(rows, (drove.get(row.agent) for row in self), strict=True):
                row.append(each and f"{each.first_impact_harm.value:.2f}, {each.total_harm.value:.2f}")
            must = [text for kind, text in table.notes() if kind == "note"]
            notes.append(" ".join([TESTS[test], f"{count_of(table[0].episodes, 'world')}.", *must]))
        return replace(kept, columns=columns, rows=rows, note="\n".join(notes))

    def markdown(self) -> str:
        """The table for a document, with the conditions of ours and of the paper's below it."""
        return f"{self.sheet().markdown()}\n\n{self._conditions()}\n"

    def _conditions(self) -> str:
        if not self:
            return ""
        ours = (
            f"Ours: {self[0].parameters.line}. Harms are means per world in m²/s²; in brackets or"
            " below a value: its 95 % interval; decreases are relative to full braking."
        )
        return "\n\n".join([ours, *(text for _, text in self.notes())])

    def notes(self) -> list[tuple[str, str]]:
        """What must be told beside the table: ``quiet`` or ``note`` (it must not be overlooked), and the sentences.

        Which worlds no row counts, that a table of best known harm lacks some of these worlds, where the horizon cut a
        motion off, who exploits what harm does not count, who met no impact at all, the limits, who knows what, and the
        conditions of the paper's rows.
        """
        if not self:
            return []
        row = self[0]
        left_out = LeftOut.line([str(left) for left in row.left_out], row.episodes + len(row.left_out))
        moving = ", ".join(f"{each.agent} {each.horizon_ends:,}" for each in self if each.horizon_ends)
        cut_off = (
            f"At the horizon ({row.parameters['horizon_s']:g} s) something still moved; harm after it is not counted."
            f" Worlds, of {row.episodes:,}: {moving}."
        )
        paper = [("quiet", f"Paper, {name}: {told}.") for name, told in PAPER_PARAMETERS.items()]
        told = [
            ("note", left_out if row.left_out else ""),
            ("note", f"WARNING: {row.warning}." if row.warning else ""),
            ("note", cut_off if moving else ""),
            ("note", Exploits.sentence({each.agent: each.exploits for each in self})),
            ("note", self._nothing_seen_line()),
            ("quiet", self.limit_line()),
            ("note", self._knowledge_line()),
            *([*paper, ("note", PAPER_NOTE)] if row.beside_paper else []),
        ]
        return [(kind, text) for kind, text in told if text]

    def limit_line(self) -> str:
        """What nobody could avoid here and the best known harm, as sentences; empty where nothing is proven."""
        first, total = (
            (self[0][f"best_known_{name}_harm"] for name in ("first_impact", "total")) if self else (None, None)
        )
        if first is None or total is None:
            return ""
        row = self[0]
        driven = row.parameters.get("controlled_vehicle")
        command = f"command of {str(driven).replace('vehicle_', 'Vehicle ')}" if driven else "joint command"
        share = Column("", digits=1, scale=100.0, unit=" %")
        contact, impact = (share.show(row[name]).in_words for name in ("unavoidable_rate", "impact_proven_rate"))
        if row["unavoidable_rate"] is None:
            text = f"In {impact} of these worlds no {command} avoids an impact (proven)."
        else:
            text = f"In {contact} of these worlds no {command} avoids contact, in {impact} none avoids an impact (both"
            text += f" proven).{row.between.text if row.between else ''}"
        proven = row["proven_harm"]
        least = 0.0 if proven is None else proven.value
        gaps = []
        for best in (first.value, total.value):
            part = f"{100 * (best - least) / best:.1f} %" if best > 0.0 else DASH
            gaps.append(f"{best - least:.2f} ({part})")
        text += (
            f" Best known harm: {first.value:.2f} first-impact, {total.value:.2f} total; proven: no less than"
            f" {least:.2f}; gap: {' and '.join(gaps)}."
        )
        known = row.known_best_share
        if known is not None and known < 1.0:
            text += (
                f" Found beforehand in {100 * known:.1f} % of the worlds; in the others it is the best of"
                " the agents above, so that regrets are lower bounds and no share of the possible reduction is stated."
            )
        below = [
            f"{each.agent} in {count_of(each.below_best_known, 'world')}" for each in self if each.below_best_known
        ]
        return text + (f" Less harm than the best known before: {', '.join(below)}." if below else "")

    def _nothing_seen_line(self) -> str:
        """What may be said of agents that met no impact in any world, as a sentence; empty without one."""
        unhurt = ", ".join(row.agent for row in self if not row.collisions)
        if not unhurt:
            return ""
        row = next(row for row in self if not row.collisions)
        most = 100 * row.collision_rate.ends[1]
        return (
            f"No impact in {count_of(row.episodes, 'world')}: {unhurt}. With 95 % confidence at most {most:.2g} % of"
            " all such worlds have one; how much harm these would do is not known."
        )

    def identity_line(self) -> str:
        """By which hashes this result is recognised, as a sentence; empty without rows."""
        if not self:
            return ""
        policies = [f"{row.agent} ({', '.join(row.policy_sha256.values())})" for row in self if row.policy_sha256]
        text = f"SHA-256 of the worlds {self[0].worlds_sha256}, of the scenario {self[0].scenario_sha256}"
        return f"{text}{', of policies: ' + '; '.join(policies) if policies else ''}."

    def _knowledge_line(self) -> str:
        """Who sees through the channel, and who does not say, as sentences; empty where the channel hides nothing."""
        hidden = self[0].hidden_share
        if not hidden:
            return ""
        text = (
            f"In {100 * hidden:.1f} % of these worlds the channel hides something of the line from a driven vehicle at"
            " its first decision: news that has not arrived, or how late another vehicle will react."
        )
        through = ", ".join(row.agent for row in self if row.sees_through)
        if through:
            text += (
                f" {SEES_THROUGH.strip()} {through}: drives by the line as it is all the same. That is a limit to"
                " compare with, and nothing that a vehicle on this channel could do."
            )
        silent = ", ".join(row.agent for row in self if Source.UNSTATED in row.knows)
        return text + (f" Not stated what it knows: {silent}." if silent else "")


def summarise(evaluation: Evaluation, *, baseline: str = BASELINE, paper: bool = False) -> SummaryTable:
    """One row per agent, in the order of the evaluation.

    Args:
        evaluation: of the agents.
        baseline: agent to compare with, where it was evaluated.
        paper: print the rows of the paper's tables below; ``InvalidInput`` where they are about another test.

    """
    limits, regrets = evaluation.limits, evaluation.regrets
    return SummaryTable.of_tallies(
        evaluation.tally(baseline=baseline),
        evaluation.conditions,
        evaluation.task,
        {name: outcome.knows for name, outcome in evaluation.outcomes.items()},
        {name: outcome.policies for name, outcome in evaluation.outcomes.items()},
        baseline=baseline,
        paper=paper,
        between=None if regrets is None else regrets.between,
        warning=limits.warning if isinstance(limits, Limits) else "",
        left_out=evaluation.left_out,
        hidden_share=float(evaluation.hidden.mean()),
        worlds_sha256=worlds_sha256(evaluation.worlds, evaluation.index),
        scenario_sha256=scenario_sha256(evaluation.scenario),
        versions=result_versions(),
    )


# An evaluation by group: the worlds of each scenario of a mixture, or those in which a vehicle is of one type.

NO_TYPE = "no type"  # of a vehicle of a mixture's member without types


def summarise_by(evaluation: Evaluation, by: str, *, baseline: str = BASELINE) -> dict[str, SummaryTable]:
    """Rows as ``summarise`` for each group of worlds, by the group's name, sorted.

    Args:
        evaluation: of a mixture, or of a scenario with types of vehicles.
        by: ``scenario``, or whose type: ``vehicle_2_type``.
        baseline: as in ``summarise``.

    Raises ``InvalidInput`` for worlds that were drawn without such, ``UnknownName`` for another column.

    >>> import ethbrake_marl as eb
    >>> delays = eb.load_scenario("mixture-delays")
    >>> agents = {"full_brake": eb.make_agent("full_brake")}
    >>> found = eb.summarise_by(eb.evaluate(delays.sample(30, seed=7), agents, scenario=delays), "scenario")
    >>> {name: rows[0].episodes for name, rows in found.items()}
    {'paper-delay-high': 11, 'paper-delay-low': 8, 'paper-delay-middle': 11}

    """
    Evaluation.check_group(evaluation.kinds, by)
    column = evaluation.kinds[by]
    return {
        name or NO_TYPE: summarise(evaluation.take(column == name), baseline=baseline)
        for name in np.unique(column).tolist()
    }
