"""Row of a results table: the estimates of all measures of one agent, and the conditions of the evaluation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.agents.protocol import Knowledge
from ethbrake_marl.first_edition.evaluation.conditions import Conditions
from ethbrake_marl.first_edition.evaluation.exploits import MARK, Exploits
from ethbrake_marl.first_edition.evaluation.measure_sets import EPISODE, MEASURE_SETS, MeasureSet, RegisteredMeasures
from ethbrake_marl.first_edition.evaluation.outcome import COLUMN, UNSTATED, LeftOut
from ethbrake_marl.first_edition.evaluation.own_measures import heading_of


@dataclass(frozen=True, slots=True)
class SummaryRow:
    """Results of one agent over all worlds of an evaluation. Harms are means per world, m2/s2.

    ``row[name]`` is the estimate of a measure, by the measure's name in JSON, such as ``row["harm_decrease_total"]``.
    The estimate is None if the measure is not defined in the evaluated worlds.

    >>> import ethbrake_marl.first_edition as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> agents = {name: eb.make_agent(name) for name in ("full_brake", "coast")}
    >>> rows = eb.summarise(eb.evaluate(scenario.sample(3, seed=7), agents, scenario=scenario))
    >>> rows[0].agent, rows[0].collisions, round(rows[0].total_harm.value, 2), rows[0]["predicted_harm"]
    ('full_brake', 2, 36.99, None)

    """

    agent: str
    episodes: int  # number of worlds
    estimates: Mapping[str, Estimate | None]  # value and 95 % interval of every measure, by its name in JSON
    collisions: int  # number of worlds with at least one impact
    horizon_ends: int  # number of worlds in which a vehicle still moves at the horizon
    parameters: Conditions  # scenario, seed, controlled vehicles and quantities of the worlds
    # Fraction of worlds in which ``Outcome.chosen_policy`` is true; None: the agent has no shield.
    policy_share: float | None = None
    # Name of a set of measures -> fields that the set adds to the JSON object (``MeasureSet.row``).
    more: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    bounds: frozenset[str] = frozenset()  # names of measures whose means are lower bounds of the true means
    left_out: tuple[LeftOut, ...] = ()  # worlds left out because the simulation failed; no number counts them
    knows: Knowledge = UNSTATED  # what the agent says that it knows about the line
    hidden_share: float = 0.0  # fraction of worlds in which the V2X channel hides something from a controlled vehicle
    worlds_sha256: str = ""  # hash of the worlds; equal for results on the same worlds
    scenario_sha256: str = ""  # hash of everything in the scenario that affects an episode
    policy_sha256: Mapping[str, str] = field(default_factory=dict)  # vehicle's name -> SHA-256 of its policy
    versions: Mapping[str, str] = field(default_factory=dict)  # name of a package -> version that computed the result

    def __getitem__(self, measure: str) -> Estimate | None:
        return self.estimates[measure]

    @property
    def collision_rate(self) -> Estimate:
        """Fraction (0 to 1) of worlds with at least one impact."""
        return self.estimates["collision_rate"]  # type: ignore[return-value]  # every agent has it in every world

    @property
    def first_impact_harm(self) -> Estimate:
        """Mean first-impact harm per world (m2/s2)."""
        return self.estimates["first_impact_harm"]  # type: ignore[return-value]  # all have it in all worlds

    @property
    def total_harm(self) -> Estimate:
        """Mean total harm per world (m2/s2)."""
        return self.estimates["total_harm"]  # type: ignore[return-value]  # all have it in all worlds

    @property
    def metrics(self) -> dict[str, Estimate]:
        """Estimates of the measures that the user registered, by name.

        A measure with one value per vehicle has the names ``NAME_1``, ``NAME_2`` and so on.
        """
        registered = {
            name.removeprefix(COLUMN): each for name, each in self.estimates.items() if name.startswith(COLUMN)
        }
        return {name: each for name, each in registered.items() if each is not None}

    @property
    def sees_through(self) -> bool:
        """Whether the agent is omniscient: it reads values that the V2X channel hides in these worlds."""
        return self.hidden_share > 0.0 and self.knows.sees_through

    @property
    def exploits(self) -> Exploits:
        """The agent's exploits (shoving Vehicle 1, moving at the horizon), which do not add to the harm."""
        shoved = self.estimates["vehicle_1_shoved_m"]
        return Exploits(None if shoved is None else shoved.value, self.horizon_ends / self.episodes)

    @property
    def marked(self) -> str:
        """Name of the agent, followed by ‡ if it has exploits."""
        return f"{self.agent} {MARK}" if self.exploits.names else self.agent

    def to_json(self) -> dict[str, Any]:
        """Return the row as an object for JSON; missing values are null, and intervals are ``[low, high]``."""
        registered = RegisteredMeasures(n.removeprefix(COLUMN) for n in self.estimates if n.startswith(COLUMN))
        more: dict[str, Any] = {}
        for name, each in MEASURE_SETS.items():
            more |= {**self._estimates_of(each), **self.more.get(name, {})}
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
            **self._estimates_of(EPISODE),
            **self._estimates_of(registered),
            **({"policy_share": self.policy_share} if self.policy_share is not None else {}),
            **more,
            "left_out": [left._asdict() for left in self.left_out],
            "worlds_sha256": self.worlds_sha256,
            "scenario_sha256": self.scenario_sha256,
            "policy_sha256": dict(self.policy_sha256),
            "versions": dict(self.versions),
            **({"metrics": {name: heading_of(name) for name in self.metrics}} if self.metrics else {}),
            "parameters": self.parameters,
        }

    def _estimates_of(self, of: MeasureSet) -> dict[str, Any]:
        """Return the estimates of a set for JSON, such as ``{"total_harm": 37, "total_harm_interval": [30, 44]}``."""
        there = {m.name: self.estimates[m.name] for m in of.measures if m.name in self.estimates}
        optional = {measure.name for measure in of.measures if not measure.always}
        return Estimate.side_by_side({name: each for name, each in there.items() if each or name not in optional})
