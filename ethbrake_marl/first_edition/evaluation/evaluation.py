"""``Evaluation``: the outcomes of several agents in the same worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.errors import InvalidInput, PhysicsError, count_of, naming_extras
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.evaluation.measure_sets import MEASURE_SETS, Silent, contexts_of, silent_because
from ethbrake_marl.first_edition.evaluation.outcome import LeftOut, Outcome, none_for_nan
from ethbrake_marl.first_edition.evaluation.rescores import Rescored, Rescores
from ethbrake_marl.first_edition.evaluation.statistics import mean, share_of
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.game.objectives import Declared, scored
from ethbrake_marl.first_edition.physics.messages import Messages
from ethbrake_marl.first_edition.physics.state import Bools, Ints, Worlds
from ethbrake_marl.first_edition.scenario.fields import QUANTITY, RECORDING
from ethbrake_marl.first_edition.scenario.sample import clusters_of
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task

_SHOWN_AGENTS = 5  # largest number of agents that ``repr`` names

Columns = dict[str, list[Any]]  # columns of a table with one row per agent and world, by name

# Names of columns that contain texts. Sets of measures add further ones (``MeasureSet.texts``).
_TEXTS = {"agent", "scenario", RECORDING, "ended", "knows"}

# Initial quantities that ``per_world`` lists even if all worlds have the same value.
_ALWAYS_SHOWN = ("gaps_m", "speeds_mps", "obstacle_gap_m")

T = TypeVar("T")


@dataclass(frozen=True)
class Evaluation:
    """Outcomes of several agents that drove the same vehicles in the same worlds.

    In ``worlds``, in ``index`` and in every array of the outcomes, entry k belongs to the same world.

    >>> import ethbrake_marl.first_edition as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> evaluation = eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario)
    >>> list(evaluation.outcomes), evaluation.vehicle, evaluation.index
    (['full_brake', 'coast'], 1, array([0, 1, 2]))

    """

    scenario: Scenario  # scenario of the worlds
    vehicles: tuple[int, ...]  # indices (0 = front) of the vehicles that the agents controlled
    worlds: Worlds  # the n worlds at the alert
    index: Ints  # [n] number of each world in the evaluation list, from 0
    seed: int | None  # seed of the evaluation list; None for worlds that the caller passed
    outcomes: dict[str, Outcome]  # by the agent's name
    left_out: tuple[LeftOut, ...] = ()  # worlds that could not be simulated with some agent; no array contains them
    # Names of the groups that each world belongs to, [n]: ``scenario`` if the scenario is a mixture,
    # ``vehicle_2_type`` and so on if it has vehicle types, ``recording`` if its worlds come from recordings.
    kinds: Mapping[str, NDArray[np.str_]] = field(default_factory=dict)
    rejected: int = 0  # number of drawn worlds that were rejected because of an early impact
    _computed: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)  # cache of ``once``

    def __repr__(self) -> str:
        drivers = [f"{agent!r:.42}" for agent in list(self.outcomes)[:_SHOWN_AGENTS]]
        more = len(self.outcomes) - len(drivers)
        drivers += [f"{more} more"] if more else []
        seed = "" if self.seed is None else f" of seed {self.seed}"
        return (
            f"Evaluation({self.scenario.name!r}, {count_of(self.worlds.n, 'world')}{seed}, {self.task.names:.80}"
            f" controlled by {', '.join(drivers)})"
        )

    @property
    def vehicle(self) -> int:
        """Index (0 = front) of the only controlled vehicle; raises ``InvalidInput`` unless there is exactly one."""
        return self.task.vehicle

    @property
    def task(self) -> Task:
        """Scenario and controlled vehicles."""
        return Task(self.scenario, self.vehicles)

    def once(self, compute: Callable[[Evaluation], T]) -> T:
        """Return ``compute(self)``; later calls with the same function return the stored result."""
        if compute not in self._computed:
            self._computed[compute] = compute(self)
        result: T = self._computed[compute]
        return result

    @classmethod
    def join(cls, parts: Sequence[Evaluation]) -> Evaluation:
        """Join evaluations of the same agents in consecutive chunks of worlds.

        Raises ``PhysicsError`` if every world was left out because of an error.
        """
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
            rejected=sum(part.rejected for part in parts),
            kinds={name: np.concatenate([part.kinds[name] for part in some]) for name in some[0].kinds},
        )

    def take(self, rows: Ints | Bools) -> Evaluation:
        """Return the evaluation restricted to some of its worlds, with empty ``left_out`` and with ``rejected`` 0.

        Args:
            rows: row numbers of the worlds to keep, or a mask [n] that is true for these worlds.

        """
        outcomes = {name: outcome.take(rows) for name, outcome in self.outcomes.items()}
        kinds = {name: column[rows] for name, column in self.kinds.items()}
        some = replace(self, worlds=self.worlds.take(rows), index=self.index[rows], outcomes=outcomes, kinds=kinds)
        return replace(some, left_out=(), rejected=0)

    @property
    def hidden(self) -> Bools:
        """For each world: whether the V2X channel hides something from a controlled vehicle, [n].

        The channel hides something if messages arrive late, only from time to time or not at all, if messages omit a
        quantity, or if another vehicle reacts later than its message says.
        """
        messages, hides = Messages.of(self.worlds), self.worlds.vehicles.hide_from
        from_each = [hides(i) | messages.periodic | messages.withhold_from(i) for i in self.vehicles]
        hidden: Bools = np.logical_or.reduce([np.zeros(self.worlds.n, np.bool_), *from_each])
        return hidden

    @property
    def clusters(self) -> NDArray[np.str_] | None:
        """Name of the cluster (recording) of each world, [n]; None: all worlds are independent."""
        return clusters_of(self.kinds, self.index)

    @property
    def recordings(self) -> int:
        """Number of recordings (clusters) that the worlds come from; 0: all worlds are independent."""
        return 0 if self.clusters is None else len(np.unique(self.clusters))

    @property
    def conditions(self) -> Conditions:
        """Scenario, seed, controlled vehicles and quantities, for captions and JSON."""
        because = silent_because(contexts_of(self))
        return Conditions.of_test(
            self.task, self.seed, self.worlds.n, because, Conditions.of(self.worlds),
            recordings=self.recordings, rejected=self.rejected,
        )  # fmt: skip

    def per_world(self, objectives: Sequence[Declared] = ()) -> Columns:
        """Return a table with one row per agent and world, as a dictionary: name of a column -> its values.

        docs/evaluate.md lists the columns. Columns of initial quantities have names such as ``gap_1_m``,
        ``speed_1_mps``, ``latency_2_s`` and ``restitution``. A missing value is None.

        Args:
            objectives: objectives such as ``"social:45"``, each of which adds columns with its value for every vehicle.

        """
        n, contexts = self.worlds.n, contexts_of(self)
        initial: Columns = {"world": self.index.tolist()}
        initial |= {name: column.tolist() for name, column in self.kinds.items()}
        for key, rule in QUANTITY.of(self.worlds).items():
            values = rule.of(self.worlds)
            if key in _ALWAYS_SHOWN or np.ptp(values, axis=0).any():
                initial |= {rule.column_of(i): none_for_nan(values[:, i]) for i in range(values.shape[1])}
        table: Columns = {}
        for agent, outcome in self.outcomes.items():
            measured = outcome.columns()
            for name, each in MEASURE_SETS.items():
                context = contexts[name]
                for column, of in each.per_world.items():
                    measured[column] = None if isinstance(context, Silent) else of(outcome, context)
            measured |= {name: column for name, column in outcome.borne(objectives).items() if name not in measured}
            columns: Columns = {
                "agent": [agent] * n,
                **initial,
                **{name: [None] * n if column is None else none_for_nan(column) for name, column in measured.items()},
                "knows": [outcome.knows.text] * n,
                "hidden": self.hidden.astype(int).tolist(),
            }
            for left in self.left_out:
                values_of = {"agent": agent, "world": left.world, "ended": f"left out: {left.agent}: {left.reason}"}
                columns = {name: [*values, values_of.get(name)] for name, values in columns.items()}
            table = {name: [*table.get(name, ()), *values] for name, values in columns.items()}
        return table

    def arrays(self, objectives: Sequence[Declared] = ()) -> dict[str, NDArray[Any]]:
        """Return the columns of ``per_world`` as arrays. A missing number is NaN, and a missing text is empty."""
        arrays, of_sets = {}, [each.texts for each in MEASURE_SETS.values()]
        for name, values in self.per_world(objectives).items():
            texts = name in _TEXTS.union(*of_sets) or (name.startswith("vehicle_") and name.endswith("_type"))
            arrays[name] = np.array([("" if texts else np.nan) if value is None else value for value in values])
        return arrays

    def to_pandas(self) -> Any:
        """Return the columns of ``arrays`` as a pandas ``DataFrame`` with one row per agent and world.

        docs/evaluate.md lists the columns. Raises ``MissingExtra`` if pandas is not installed.
        """
        with naming_extras():
            from pandas import DataFrame

        return DataFrame(self.arrays())

    def rescore(self, declared: Sequence[Declared] | None = None) -> Rescores:
        """Return the mean value of each objective over the worlds, for every agent, vehicle and count of harm.

        Args:
            declared: objectives such as ``"total"`` or ``"social:45"``; None: ``standard_objectives``.

        """
        return Rescores(
            [
                Rescored(agent, objective, harm_count, tuple(mean(column, self.clusters) for column in values.T))
                for agent, outcome in self.outcomes.items()
                for harm_count in HARM_COUNTS
                for objective, values in scored(outcome.ledger, harm_count, declared).items()
            ],
            self.recordings,
        )

    def _repr_html_(self) -> str:
        """Return the collisions and harm of each agent as an HTML table."""
        by, share = self.clusters, Column("Collisions", digits=1, scale=100.0, unit=" %")
        rows = [
            (agent, share_of(each.collided, by), mean(each.first_impact_harm, by), mean(each.total_harm, by))
            for agent, each in self.outcomes.items()
        ]
        note = f"Means per world in m²/s², with their 95 % intervals{self.conditions.by_recording}."
        note += " eb.summarise(...) shows all measures."
        return Sheet(repr(self), ("Agent", share, Column("First-impact harm"), Column("Total harm")), rows, note).html()

    def complete(self) -> Evaluation:
        """Return this evaluation; raise ``PhysicsError``, which lists the left-out worlds, if there are any."""
        if self.left_out:
            raise PhysicsError({left.world: f"{left.agent}: {left.reason}" for left in self.left_out})
        return self

    def outcome(self, agent: str) -> Outcome:
        """Return the results of an agent; raise ``InvalidInput`` if it was not evaluated."""
        if agent not in self.outcomes:
            raise InvalidInput(f"agent {agent!r} was not evaluated; evaluated agents: {', '.join(self.outcomes)}")
        return self.outcomes[agent]
