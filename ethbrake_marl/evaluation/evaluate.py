"""``eb.evaluate``: every team drives every world once, and measures turn episodes into columns.

The worlds are fixed in advance. Counting the episodes that finish first would favour short ones, often with impacts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agent_names import open_game, require_learner, teams_of
from ethbrake_marl.agents.team import CHUNK, Team, agents_measures, check_knows, play
from ethbrake_marl.episode.counts import HONEST, AnyCount, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import KNOWLEDGE, MODEL, UNSTATED
from ethbrake_marl.episode.state import ORIGIN, STEPS, TIME, State
from ethbrake_marl.errors import AgentFailed, InvalidInput, check_whole_number, count_of, naming_extras, unknown_name
from ethbrake_marl.evaluation.measure_registry import check_measure_name, measures_called
from ethbrake_marl.evaluation.measures import Measure, MeasureValues, Watch, measure_columns, naming, usual_measures
from ethbrake_marl.evaluation.provenance import about_scenario, policy_digests, versions, worlds_sha256
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.motion.layout import LATENCY, OWN_LATENCY, Bools
from ethbrake_marl.parallel import run_each
from ethbrake_marl.worlds.describe import ALIKE, LABELS, clusters_of, columns_of, first_alike
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.quantities import RECORDING
from ethbrake_marl.worlds.sampling import DrawnWorlds

Columns = dict[str, MeasureValues]

EPISODES, SEED = 10_000, 7  # the evaluation list
REPORTED = "What the agent, the shield or a layer reports of itself."  # meaning of its measures


@dataclass(frozen=True)
class Result:
    """Results of teams in the same n worlds. Entry k of every column belongs to world k.

    >>> import ethbrake_marl as eb
    >>> result = eb.evaluate("paper-random", "full_brake,coast", episodes=3)
    >>> result["full_brake"]["total_harm"].round(2), result["coast"]["collided"]
    (array([33.79, 77.19,  0.  ]), array([ True,  True,  True]))

    """

    columns: Mapping[str, Columns]  # team -> column -> [n]: `evaluation.measures`
    worlds: Columns  # column -> [n]: number, recording, quantities that differ, ``hidden`` (`hidden_from`)
    measures: tuple[Measure, ...]
    knows: Mapping[str, str]  # team -> what the team must know
    drivers: Mapping[str, Mapping[str, str]]  # team -> vehicle -> name of its agent
    policies: Mapping[str, Mapping[str, str]]  # team -> vehicle -> SHA-256 of its policy
    remarks: Mapping[str, Sequence[str]]  # team -> its other counts of harm, as in ``bounds total harm``
    about: Mapping[str, Any]  # plain data: scenario, seed, times, digests, versions

    @property
    def n(self) -> int:
        return len(self.worlds["world"])

    @property
    def clusters(self) -> NDArray[Any] | None:
        """Recording, or row of a table, or first equal world, of each world, [n]; None if all are independent."""
        return clusters_of(self.worlds)

    @property
    def independent(self) -> dict[str, int]:
        """Of what there are how many, on which intervals rest; empty if all worlds are independent."""
        if self.clusters is None:
            return {}
        kinds = {RECORDING: "recordings", **ALIKE}
        return {next(kinds[name] for name in kinds if name in self.worlds): len(np.unique(self.clusters))}

    def __getitem__(self, team: str) -> Columns:
        if team not in self.columns:
            raise unknown_name("agent in this result", team, self.columns)
        return self.columns[team]

    def __repr__(self) -> str:
        return f"Result({self.about['scenario']!r}, {count_of(self.n, 'world')}: {', '.join(self.columns):.200})"

    def measure_of(self, column: str) -> Measure:
        candidates = [
            measure for measure in self.measures if column == measure.name or column.startswith(f"{measure.name}_")
        ]
        return max(candidates, key=lambda measure: len(measure.name))

    def __iter__(self) -> Iterator[str]:
        return iter(self.columns)

    def __contains__(self, team: object) -> bool:
        return team in self.columns

    def take(self, rows: Any) -> Result:
        """Result of some worlds: ``rows`` are indices or a mask [n]. Raises ``InvalidInput`` if no world is left."""
        columns = {
            team: {name: values[rows] for name, values in team_columns.items()}
            for team, team_columns in self.columns.items()
        }
        worlds = {name: values[rows] for name, values in self.worlds.items()}
        if not len(worlds["world"]):
            raise InvalidInput("take: there is no world among these rows; choose at least one")
        about = {key: value for key, value in self.about.items() if key != "worlds_sha256"}
        about |= {"count": len(worlds["world"]), "rejected_draws": 0}
        return replace(self, columns=columns, worlds=worlds, about=about)

    def arrays(self) -> Columns:
        """Table with one row per team and world: column name -> [teams * n]. Missing numbers are NaN."""
        names = list(dict.fromkeys(name for team_columns in self.columns.values() for name in team_columns))
        table: Columns = {"agent": np.repeat([*self.columns], self.n)}
        table |= {name: np.tile(values, len(self.columns)) for name, values in self.worlds.items()}
        for name in names:
            kinds = [team_columns[name].dtype.kind for team_columns in self.columns.values() if name in team_columns]
            missing = np.full(self.n, "" if "U" in kinds else np.nan)
            table[name] = np.concatenate([team_columns.get(name, missing) for team_columns in self.columns.values()])
        return table | {"knows": np.repeat([self.knows[team] for team in self.columns], self.n)}

    def to_pandas(self) -> Any:
        """Table of ``arrays`` as a ``DataFrame``. Raises ``MissingExtra`` without pandas."""
        with naming_extras():
            from pandas import DataFrame

        return DataFrame(self.arrays())


def evaluate(
    worlds: AnyScenario | DrawnWorlds | State | None = None,
    agents: Any = "full_brake,e_v2x_bm",
    *,
    scenario: AnyScenario | None = None,
    episodes: int | None = None,
    seed: int | None = None,
    harm_count: AnyCount = HONEST,
    measures: Iterable[str] | str = (),
    jobs: int = 1,
    on_done: Callable[[int], None] | None = None,
) -> Result:
    """Let agents drive the same worlds, each agent once in every world.

    ``eb.evaluate("paper-random", "full_brake,ppo+step")`` is the shortest form. Results have the same bits for any
    number of processes.

    Args:
        worlds: a scenario, from whose evaluation list the worlds are taken (a shipped name, the path or content of a
            file, or a ``Scenario``); or worlds at the alert, together with ``scenario``.
        agents: names of agents; or a mapping whose keys name the rows of the result, and whose values are names,
            agents, or mappings from vehicles to agents: ``{"mine": agent, "both": {"vehicle_2": agent, "vehicle_3":
            "coast"}}``.
        scenario: scenario to which ``worlds`` belong, if they are worlds at the alert.
        episodes: number of worlds from the evaluation list; None: 10,000.
        seed: seed of the evaluation list; None: 7.
        harm_count: what optimising agents minimise: ``honest``, under which pushing hardly pays, ``first``, as in the
            paper, ``total``, or another count of harm (``episode.counts``).
        measures: names of further measures (``evaluation.measure_registry``).
        jobs: number of processes.
        on_done: function that is called with the number of worlds driven so far.

    Raises ``UnknownName`` for an unknown name, and ``InvalidInput`` for any other mistake.

    >>> import ethbrake_marl as eb
    >>> result = eb.evaluate("paper-random", "full_brake", episodes=3)
    >>> result["full_brake"]["total_harm"].round(2)
    array([33.79, 77.19,  0.  ])

    """
    test_worlds = None
    if isinstance(worlds, DrawnWorlds | State):
        test_worlds = worlds
    elif worlds is not None:
        if scenario is not None:
            raise InvalidInput("evaluate: scenario: is given twice; leave one of the two out")
        scenario = worlds
    if scenario is None:
        if test_worlds is not None:
            raise InvalidInput("evaluate: worlds need their scenario, for instance scenario='paper-random'")
        scenario = "paper-random"
    if test_worlds is not None and (episodes, seed) != (None, None):
        raise InvalidInput("evaluate: episodes and seed choose worlds of a list; leave them out if worlds are given")
    episodes, seed = EPISODES if episodes is None else episodes, SEED if seed is None else seed
    count = HarmCount.of(harm_count, "evaluate: harm_count")
    loaded, game = open_game(scenario, reward={"harm_count": count})
    require_learner(loaded)
    about = about_scenario(loaded, None if test_worlds is not None else seed)
    if test_worlds is None:
        check_whole_number("episodes", episodes, 1)
        test_worlds = loaded.draw(int(episodes), seed)
    teams = teams_of(agents, loaded, harm_count=count)
    about["agent_settings"] = {"harm_count": count.name}
    return evaluate_teams(test_worlds, teams, game, measures_called(measures or ()), jobs, about=about, on_done=on_done)


def evaluate_teams(
    worlds: DrawnWorlds | State,
    agents: Mapping[str, Team],
    game: Game,
    measures: Iterable[Measure] = (),
    jobs: int | None = 1,
    *,
    about: Mapping[str, Any] | None = None,
    on_done: Callable[[int], None] | None = None,
) -> Result:
    """Let every team drive every world once. ``about``: further entries of ``Result.about``; the rest as in
    ``evaluate``.

    Raises ``InvalidInput`` for worlds that are not at the alert, for worlds or a team that do not fit the game, for
    measures with the same name, and for bad commands of an agent; ``PhysicsError`` if a check of the physics fails.
    """
    if jobs is not None:
        check_whole_number("jobs", jobs, 1)
    draw = worlds if isinstance(worlds, DrawnWorlds) else DrawnWorlds.from_state(worlds)
    _check(draw.worlds, agents, game)
    chosen = (*usual_measures(), *measures)
    n, of_worlds, labels = draw.worlds.n, columns_of(draw), draw.worlds.memories.get(LABELS, {})
    memories = {name: memory for name, memory in draw.worlds.memories.items() if name != LABELS}
    alert = game.marked(draw.worlds._replace(memories=memories))
    for measure in chosen:
        if measure.name in of_worlds or any(name.startswith(f"{measure.name}_") for name in labels):
            raise InvalidInput(f"measure {measure.name!r}: is the name of a column of the worlds; give another name")
    owners: dict[str, Measure] = {}
    for measure in chosen:
        for statistic in measure.all_statistics():
            owner = owners.setdefault(statistic.key, measure)
            if owner != measure:
                raise InvalidInput(
                    f"measures {owner.name!r} and {measure.name!r}: both have the statistic {statistic.key!r}; give one"
                    " of them another key"
                )
    calls: Any = (
        (drive_chunk, alert.take(slice(first, first + CHUNK)), dict(agents), game, chosen)
        for first in range(0, n, CHUNK)
    )
    parts: list[dict[str, Driven]] = []
    for part in run_each(calls, jobs):
        parts.append(part)
        if on_done is not None:
            on_done(min(len(parts) * CHUNK, n))
    reported = dict.fromkeys(name for part in parts for driven in part.values() for name in driven.reported)
    learners = game.settings.learners.tolist()
    columns: Columns = {**of_worlds}
    alike = first_alike(draw.worlds)
    if (alike != np.arange(n)).any():
        columns["same_row_as" if draw.worlds.clock[:, ORIGIN].any() else "same_as"] = alike
    if (columns["world"] < 0).all():  # the user has made these worlds
        columns["world"] = np.arange(n)
    return Result(
        {team: _join_columns([part[team].columns for part in parts]) for team in agents},
        {**columns, "hidden": hidden_from(alert, game)},
        (*chosen, *(Measure(name, meaning=REPORTED) for name in reported)),
        {name: known_by(team, game) for name, team in agents.items()},
        {name: {f"vehicle_{i}": agent.name for i, agent in team.drivers.items()} for name, team in agents.items()},
        {name: policy_digests(team.drivers) for name, team in agents.items()},
        {name: team.remarks(game.settings.harm_count) for name, team in agents.items()},
        {
            "scenario": game.name,
            "seed": None,
            "count": n,
            "controlled_vehicles": [f"vehicle_{body}" for body in learners],
            "time_step_s": game.settings.time_step_s,
            "horizon_s": game.settings.horizon_s,
            "rejected_draws": draw.rejected,
            **(about or {}),
            "worlds_sha256": worlds_sha256(alert),
            "physics_digest": physics_digest(),
            "versions": versions(),
        },
    )


class Driven(NamedTuple):
    """Columns of a team in some worlds."""

    columns: Columns
    reported: tuple[str, ...]  # names of the measures that only the team itself knows


def drive_chunk(alert: State, agents: Mapping[str, Team], game: Game, measures: Sequence[Measure]) -> dict[str, Driven]:
    return {name: _drive_team(alert, name, team, game, measures) for name, team in agents.items()}


def _drive_team(alert: State, name: str, team: Team, game: Game, measures: Sequence[Measure]) -> Driven:
    full_game, start = team.game(game), alert.read_only()
    watches: list[tuple[Measure, Watch]] = []
    for measure in measures:
        with naming(measure):
            watch = None if measure.watch is None else measure.watch(full_game, start)
        if watch is not None:
            watches.append((measure, watch))
    before = alert
    with AgentFailed.naming(name, [script.name for script in game.scripts.values() if hasattr(script, "name")]):
        for step, state in play(game, alert, team, donate=not watches):
            for measure, watch in watches:
                with naming(measure):
                    watch.see(before.read_only(), step, state.read_only())
            before = state
    last, watched = before.read_only(), {measure.name: watch for measure, watch in watches}
    columns: Columns = {}
    reports = _reports_of(team, full_game, last)
    for measure in measures:
        with naming(measure):
            if measure.of is not None:
                value = measure.of(full_game, start, last)
            elif measure.watch is None:
                value = reports.pop(measure.name, None)
            else:
                value = watched[measure.name].result(last) if measure.name in watched else None
        columns |= measure_columns(measure, value, last)
    for reported, value in reports.items():
        if reported in columns or reported in [measure.name for measure in measures]:
            raise InvalidInput(
                f"team {name!r}: reports the measure {reported!r}, which is in use; its method measures must give"
                " another name"
            )
        check_measure_name(reported)
        columns |= measure_columns(Measure(reported), value, last)
    return Driven(columns, tuple(reports))


def _reports_of(team: Team, game: Game, last: State) -> dict[str, Any]:
    """Measures that layers, and the shield or else the agents of a team, report of themselves, name -> value."""
    reports: dict[str, Any] = {}
    for layer in game.layers:
        reports |= layer.measures(last)
    if team.shield is None:
        return reports | agents_measures(team.drivers, last, last.memories)
    return reports | (team.shield.measures(game, last) if hasattr(team.shield, "measures") else {})


def _join_columns(parts: Sequence[Columns]) -> Columns:
    """Columns of all worlds from those of consecutive chunks; a column that a chunk lacks is left out."""
    return {
        name: np.concatenate([part[name] for part in parts]) for name in parts[0] if all(name in part for part in parts)
    }


def hidden_from(alert: State, game: Game) -> Bools:
    """Whether the V2X channel hides something from a learner at its first decision, [n].

    Also true if another vehicle waits for a message, and so reacts later than the latency that it reports.
    """
    late, hidden = alert.car[:, LATENCY] > alert.car[:, OWN_LATENCY], np.zeros(alert.n, np.bool_)
    for i in game.settings.learners.tolist():
        unknown = alert.know[:, i] > alert.car[:, LATENCY, i, np.newaxis]
        for layer in game.layers:
            unknown |= layer.hides(alert, i)
        hidden |= np.delete(unknown | late, [0, i], axis=1).any(axis=1)
    return hidden


def known_by(team: Team, game: Game) -> str:
    """What a team must know, in words such as ``messages + true model``; with ``filtered`` if it does not say."""
    knowledge = _knowledge_of(team).values()
    silent = f"{UNSTATED}, filtered" if game.layers else UNSTATED
    return " + ".join([*(word for word in KNOWLEDGE if word in knowledge), *[silent] * (UNSTATED in knowledge)])


def _knowledge_of(team: Team) -> dict[str, str]:
    knowledge = {f"vehicle_{body}": getattr(agent, "knows", UNSTATED) for body, agent in team.drivers.items()}
    return knowledge if team.shield is None else {**knowledge, "shield": getattr(team.shield, "knows", MODEL)}


def _check(alert: State, agents: Mapping[str, Team], game: Game) -> None:
    if not isinstance(agents, Mapping) or not agents or not all(isinstance(team, Team) for team in agents.values()):
        raise InvalidInput(
            f"evaluate: agents = {agents!r:.80}: must be a mapping from names to teams, for instance"
            " {'mine': Team('mine', {2: agent})}"
        )
    vehicles = len(game.views) - 1
    if not alert.n or alert.vehicles != vehicles or alert.clock[:, [TIME, STEPS]].any():
        raise InvalidInput(
            f"evaluate: worlds: {count_of(alert.n, 'world')} of {alert.vehicles} vehicles; must be one or more worlds"
            f" of {vehicles} vehicles at the alert, for instance scenario.draw(100, seed=7)"
        )
    for team in agents.values():
        team.game(game)
        for who, knows in _knowledge_of(team).items():
            check_knows(knows, f"team {team.name!r}: {who}")
