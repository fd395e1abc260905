"""Results as files: what ``evaluate``, ``shield`` and ``run`` write, and how it is read again."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ethbrake_marl.agents.protocol import knowledge_text
from ethbrake_marl.defaults import HARM_COUNTS
from ethbrake_marl.errors import AlreadyExists, EthBrakeError, InvalidInput, count_of, naming_extras, need, unknown_name
from ethbrake_marl.evaluation.inputs import Kind
from ethbrake_marl.evaluation.measures import COLUMN, Regrets, assess
from ethbrake_marl.evaluation.outcome import Evaluation, Outcome
from ethbrake_marl.evaluation.statistics import Estimate, estimates_to_json, paired_difference, unpaired_difference
from ethbrake_marl.evaluation.summary import Rescored, SummaryRow
from ethbrake_marl.files.store import check_writable, parse_strict_json, read_plain, write_file
from ethbrake_marl.harm import Declared, scored
from ethbrake_marl.physics import Floats
from ethbrake_marl.scenario.fields import quantity, quantity_rules

# One row per agent and world: its columns, and its file, written whole and never over another by accident.


def check_target(path: str | Path, *, force: bool = False) -> Path:
    """Refuse a file that exists (``AlreadyExists``, unless ``force``) or cannot be written (``InvalidInput``).

    Even ``force`` replaces plain files only: no folder, device, pipe or symbolic link. Call it before long work whose
    result goes there.
    """
    target = Path(path)
    try:
        _check_place(target)
        if os.path.lexists(target) and not force:
            raise AlreadyExists(f"{target}: is there already; give another name or use force (--force)")
        check_writable(target.parent)
    except (InvalidInput, AlreadyExists):
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InvalidInput(f"{target!s:.200}: cannot be written ({reason})") from None
    return target


def _check_place(target: Path) -> None:
    if target.is_symlink():
        raise InvalidInput(f"{target}: is a symbolic link; give the file it points to")
    if target.is_dir():
        raise InvalidInput(f"{target}: is a folder; give the name of a file")
    if target.exists() and not target.is_file():
        raise InvalidInput(f"{target}: is a device or a pipe, not a plain file; give another name")
    if not target.parent.is_dir():
        raise InvalidInput(f"{target}: there is no folder {target.parent}; make it first")


def write_output(path: str | Path, data: bytes, *, force: bool = False) -> None:
    """Write ``data`` in one step; raises as ``check_target``."""
    write_file(check_target(path, force=force), data)


Columns = dict[str, list[Any]]

REGRET_COLUMNS = (
    "avoidable",
    "unavoidable_reason",
    "best_known_first_impact_harm",
    "best_known_total_harm",
    "best_known_source",
    "impact_proven",
    "proven_harm",
    "regret_first_impact_harm",
    "regret_total_harm",
)

PER_WORLD = "per_world.csv"  # its name in the folder of a run

_ALWAYS = ("gaps_m", "speeds_mps", "obstacle_gap_m")


def write_per_world_csv(
    path: str | Path, evaluation: Evaluation, *, objectives: Sequence[Declared] = (), force: bool = False
) -> None:
    """Write one row per agent and world; docs/evaluation.md lists the columns. ``objectives`` adds theirs.

    A world that was left out has a row with nothing but its number and, in ``ended``, why.

    The file appears whole or not at all. Raises ``AlreadyExists`` unless ``force``, ``InvalidInput`` without a folder.
    """
    check_target(path, force=force)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    columns = per_world_columns(evaluation, objectives)
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_output(path, text.getvalue().encode(), force=force)


def per_world_columns(evaluation: Evaluation, objectives: Sequence[Declared] = (), *, limits: bool = True) -> Columns:
    """The columns of ``write_per_world_csv``, agent by agent, then world by world; None where there is no value.

    Without ``limits`` those of the best known harm are left out, every quantity is told, and no world that was left
    out: the rows of a shard, which have the same columns as those of any other.
    """
    found: Columns = {}
    initial, regrets = initial_columns(evaluation, every=not limits), assess(evaluation) if limits else None
    hidden: Columns = {"hidden": evaluation.hidden.astype(int).tolist()}
    for agent, outcome in evaluation.outcomes.items():
        columns = {"agent": [agent] * evaluation.worlds.n, **initial, **outcome_columns(outcome)}
        columns |= (regret_columns(outcome, regrets) if limits else {}) | objective_columns(outcome, objectives)
        columns |= {"knows": [knowledge_text(outcome.knows)] * evaluation.worlds.n, **hidden}
        for left in evaluation.left_out if limits else ():
            told = {"agent": agent, "world": left.world, "ended": f"left out: {left.agent}: {left.reason}"}
            columns = {name: [*values, told.get(name)] for name, values in columns.items()}
        found = {name: [*found.get(name, ()), *values] for name, values in columns.items()}
    return found


def initial_columns(evaluation: Evaluation, *, every: bool = False) -> Columns:
    """World number and its initial state: gaps, speeds, and any other quantity that differs between worlds, or every.

    Where there is such, also the scenario of a mixture, and each vehicle's type. Quantities are named
    as in a table of initial states: ``gap_1_m``, ``speed_1_mps``, ``latency_2_s``, ``restitution``.
    """
    columns: Columns = {"world": evaluation.index.tolist()}
    columns |= {name: column.tolist() for name, column in evaluation.kinds.items()}
    for field, rule in quantity_rules(evaluation.worlds).items():
        values = quantity(evaluation.worlds, field)
        if every or field in _ALWAYS or np.ptp(values, axis=0).any():
            columns |= {rule.column_of(i): values[:, i].tolist() for i in range(values.shape[1])}
    return columns


def regret_columns(outcome: Outcome, regrets: Regrets | None) -> Columns:
    """What was avoidable and the best known in each world; empty where nothing is proven."""
    if regrets is None:
        return {name: [None] * len(outcome.collided) for name in REGRET_COLUMNS}
    n, proof = len(outcome.collided), regrets.limits.proof
    columns = (
        np.full(n, None) if proof.avoidable is None else proof.avoidable.astype(int),
        np.full(n, None) if proof.reason is None else proof.reason,
        regrets.first_impact_harm,
        regrets.total_harm,
        regrets.source,
        proof.impact.astype(int),
        proof.harm,
        regrets.regret(outcome, "first"),
        regrets.regret(outcome, "total"),
    )
    return {name: column.tolist() for name, column in zip(REGRET_COLUMNS, columns, strict=True)}


def objective_columns(outcome: Outcome, objectives: Sequence[Declared]) -> Columns:
    """What each objective is for each vehicle under both counts (m2/s2): ``social:45_first_2``."""
    return {
        f"{objective}_{harm_count}_{i + 1}": values[:, i].tolist()
        for objective in objectives
        for harm_count in HARM_COUNTS
        for values in scored(outcome.ledger, harm_count, [objective]).values()
        for i in range(values.shape[1])
    }


def vehicle_columns(outcome: Outcome) -> Columns:
    """What each vehicle bears under both counts (m2/s2): ``total_harm_2``."""
    harms = {"first_impact_harm": outcome.vehicle_harm("first"), "total_harm": outcome.vehicle_harm("total")}
    return {f"{name}_{i + 1}": harm[:, i].tolist() for name, harm in harms.items() for i in range(harm.shape[1])}


def outcome_columns(outcome: Outcome) -> Columns:
    """What happened in each world; a column that the agent says nothing about is empty."""
    n = len(outcome.collided)
    columns: Columns = {"collided": outcome.collided.astype(int).tolist(), "impacts": outcome.impacts.tolist()}
    columns |= vehicle_columns(outcome)
    columns |= {"first_impact_harm": outcome.first_impact_harm.tolist(), "total_harm": outcome.total_harm.tolist()}
    for name, column in (("sampled_harm", outcome.sampled_harm), ("vehicle_1_shoved_m", outcome.shoved_m)):
        columns[name] = [None] * n if column is None else column.tolist()
    final = outcome.final
    if np.isfinite(final.obstacle_gap_m).all():  # of the harm above, what Vehicle 1's impacts with the obstacle did
        columns |= {"obstacle_first_impact_harm": outcome.ledger.obstacle_harm("first").tolist()}
        columns |= {"obstacle_total_harm": outcome.ledger.obstacle_harm("total").tolist()}
        columns |= {"final_obstacle_gap_m": final.obstacle_gap_m.tolist()}
    columns |= {f"final_gap_{p + 1}_m": final.gaps_m[:, p].tolist() for p in range(final.N - 1)}
    columns |= {f"final_speed_{i + 1}_mps": final.speeds_mps[:, i].tolist() for i in range(final.N)}
    columns |= {"end_s": final.time_s.tolist(), "ended": outcome.ended.tolist()}
    predicted, chosen = outcome.predicted_harm, outcome.chosen_policy
    columns["predicted_harm"] = [None] * n if predicted is None else predicted.tolist()
    columns["chosen_policy"] = [None] * n if chosen is None else chosen.astype(int).tolist()
    columns |= {COLUMN + name: (column + 0).tolist() for name, column in outcome.metrics.items()}  # truths as 0 and 1
    return columns


# One row per agent and world as a data frame, and as a Parquet file.

CSV, PARQUET = ".csv", ".parquet"
COLUMNS = "columns"
LIBRARIES = ("pandas", "polars")  # in the order of preference
_HARMS = ("agent", "world", "first_impact_harm", "total_harm")
_TEXTS = {"agent", "scenario", "unavoidable_reason", "best_known_source", "ended", "knows"}


def is_text(column: str) -> bool:
    """Whether a column with every world holds texts."""
    return column in _TEXTS or (column.startswith("vehicle_") and column.endswith("_type"))


def typed_columns(evaluation: Evaluation, objectives: Sequence[Declared] = ()) -> dict[str, NDArray[Any]]:
    """The columns of ``per_world_columns`` as arrays: NaN for no number, the empty text for no text."""
    return {name: _typed(name, values) for name, values in per_world_columns(evaluation, objectives).items()}


def _typed(name: str, values: list[Any]) -> NDArray[Any]:
    if is_text(name):
        return np.array([value or "" for value in values])
    return np.array([np.nan if value is None else value for value in values])


def make_frame(evaluation: Evaluation, library: str | None = None) -> Any:
    """``Evaluation.to_frame``."""
    columns = typed_columns(evaluation)
    if library is None:
        library = next((name for name in LIBRARIES if find_spec(name) is not None), COLUMNS)
    if library not in (*LIBRARIES, COLUMNS):
        raise unknown_name("library", library, (*LIBRARIES, COLUMNS))
    if library == COLUMNS:
        return columns
    if find_spec(library) is None:
        raise InvalidInput(f"to_frame: {library} is not installed: {sys.executable} -m pip install {library}")
    return import_module(library).DataFrame(columns)


def write_per_world(
    path: str | Path, evaluation: Evaluation, *, objectives: Sequence[Declared] = (), force: bool = False
) -> None:
    """Write one row per agent and world: Parquet where the name ends in ``.parquet``, else CSV.

    Raises as ``write_per_world_csv``, and as ``check_per_world``.
    """
    check_per_world(path)
    if Path(path).suffix.lower() != PARQUET:
        write_per_world_csv(path, evaluation, objectives=objectives, force=force)
        return
    arrow, parquet = _import_extra("pyarrow"), _import_extra("pyarrow.parquet")
    columns = typed_columns(evaluation, objectives)
    buffer = io.BytesIO()
    table = arrow.table({name: arrow.array(values, from_pandas=True) for name, values in columns.items()})
    parquet.write_table(table, buffer)
    write_output(path, buffer.getvalue(), force=force)


def check_per_world(path: str | Path) -> None:
    """Refuse a file that ``write_per_world`` cannot write, before work whose result goes there.

    Raises ``InvalidInput`` for another ending than .csv or .parquet, ``MissingExtra`` without pyarrow for Parquet.
    """
    ending = Path(path).suffix.lower()
    if ending not in (CSV, PARQUET):
        raise InvalidInput(f"{path}: must end in {CSV} or {PARQUET}")
    if ending == PARQUET:
        need("pyarrow")


def read_harms(path: Path, data: bytes) -> dict[str, dict[int, tuple[float, ...]]]:
    """Agent -> world -> harm (m2/s2) under both counts, of ``data``, what ``write_per_world`` wrote to ``path``.

    Worlds that were left out are not among them. Raises ``InvalidInput`` for a file without these columns.
    """
    try:
        if path.suffix.lower() == PARQUET:
            table = _import_extra("pyarrow.parquet").read_table(io.BytesIO(data), columns=list(_HARMS)).to_pydict()
            rows = list(zip(*(table[name] for name in _HARMS), strict=True))
        else:
            lines = csv.DictReader(data.decode("utf-8").splitlines())
            rows = [tuple(line[name] for name in _HARMS) for line in lines]
        found: dict[str, dict[int, tuple[float, ...]]] = {}
        for agent, world, *harms in rows:
            if harms[0] not in (None, ""):
                values = tuple(map(float, harms))
                if not all(0.0 <= value <= _MOST_HARM for value in values):
                    raise ValueError(f"world {world}: harm {harms}")
                found.setdefault(agent, {})[int(world)] = values
        return found
    except (KeyError, TypeError, ValueError, NotImplementedError, OSError, csv.Error) as error:
        raise InvalidInput(f"{path}: is no file of --per-world: {error}") from None


def _import_extra(module: str) -> Any:
    """A module of an extra; raises ``MissingExtra``."""
    with naming_extras():
        return import_module(module)


HARMS = ("first_impact_harm", "total_harm")
USUAL: Mapping[str, str | None] = {"harm_count": "first", "uncertainty": None}  # settings of agents
_COMPARED: dict[Kind, tuple[str, ...]] = {  # harms of each
    "evaluate": HARMS,
    "shield": ("harm",),
    "evaluate-shards": HARMS,
}
_LIMIT_BYTES, _MOST_BYTES = 64 << 20, 4 << 30  # of a results file, and of one with every world
_MOST_EPISODES = 10**12
_MOST_HARM = 1e100  # m2/s2; a number that can be squared
_HASHES = {"worlds_sha256": "another list of worlds", "scenario_sha256": "another scenario"}
SAME = {  # all but the hashes: where they are told
    "kind": "another kind of results",
    "worlds_sha256": _HASHES["worlds_sha256"],
    "controlled_vehicle": "another driven vehicle",
    "scenario_sha256": _HASHES["scenario_sha256"],
    "harm_count": "another harm",
}
_NEEDED = {"agent": str, "episodes": int, **dict.fromkeys(_HASHES, str), "policy_sha256": dict, "versions": dict}


def results_to_json(
    rows: Sequence[SummaryRow],
    *,
    told: Sequence[Rescored] = (),
    groups: Mapping[str, Sequence[SummaryRow]] | None = None,
    per_world: Path | None = None,
    settings: Mapping[str, str | None] = USUAL,
) -> list[dict[str, Any]]:
    """What a results file holds: one object per row, with what was ``told`` of it under other objectives.

    ``settings`` are those of all agents: the harm that they minimise, what a robust shield does not know.

    ``groups``, by name, are rows of the same agents on parts of the worlds (``summarise_by``).
    ``per_world`` is the file with one row per world, written before; its name and hash go into every object.
    """
    found = [row.to_json() | {"agent_settings": dict(settings)} for row in rows]
    if told:
        found = [row | {"objectives": [t.to_json() for t in told if t.agent == row["agent"]]} for row in found]
    for row in found if groups else ():
        row["groups"] = {
            name: each.to_json() for name, part in (groups or {}).items() for each in part if each.agent == row["agent"]
        }
    if per_world is None:
        return found
    beside = {"file": per_world.name, "sha256": hashlib.sha256(per_world.read_bytes()).hexdigest()}
    return [row | {"per_world": beside} for row in found]


@dataclass(frozen=True, slots=True)
class Result:
    """One results file."""

    path: Path
    rows: Mapping[str, Mapping[str, Any]]  # by agent; of ``ethbrake shield`` by agent and mode

    @property
    def harm_names(self) -> tuple[str, ...]:
        """The harms that its rows tell."""
        return _COMPARED[self.about["kind"]]

    @property
    def about(self) -> Mapping[str, Any]:
        """Any of the rows: what they say of the worlds is the same in all."""
        return next(iter(self.rows.values()))

    def estimate(self, agent: str, harm: str) -> Estimate:
        """The mean of a harm, with its interval."""
        row = self.rows[agent]
        mean, interval = row[harm], row.get(f"{harm}_interval")
        return Estimate(float(mean), None if interval is None else (float(interval[0]), float(interval[1])))

    def harms(self) -> dict[str, dict[int, tuple[float, ...]]]:
        """Those of every world; raises ``InvalidInput`` where the file that holds them is not to be had."""
        beside = self.about.get("per_world")
        if not isinstance(beside, dict) or not isinstance(beside.get("file"), str):
            raise InvalidInput(f"{self.path} has none (--per-world)")
        file = self.path.parent / Path(beside["file"]).name
        if not file.is_file():
            raise InvalidInput(f"{file} is not there")
        data = read_plain(file, _MOST_BYTES)
        if hashlib.sha256(data).hexdigest() != beside.get("sha256"):
            raise InvalidInput(f"{file} is not the one that was written with {self.path}")
        return read_harms(file, data)


def read_result(path: Path) -> Result:
    """Read what ``evaluate`` or ``shield`` printed with ``--json``, or ``ethbrake run`` wrote.

    Raises ``InvalidInput`` for anything else, also for other kinds of results, in which no agents stand beside each
    other, and for a result without hashes.
    """
    try:
        content = parse_strict_json(read_plain(path, _LIMIT_BYTES))
    except ValueError as error:
        if isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"{path}: is no JSON, or was not written to its end: {error}") from None
    rows = _rows_of(path, content)
    for row in rows:
        for key, kind in _NEEDED.items():
            if not isinstance(row.get(key), kind):
                raise InvalidInput(f"{path}: {key} is missing or no {kind.__name__}: evaluate again")
        _check_numbers(path, row)
    if len({tuple(told_of(row, key) for key in SAME) for row in rows}) > 1:
        raise InvalidInput(f"{path}: its agents drove different worlds; each test needs a file of its own")
    named = [_name_of(row) for row in rows]
    if twice := {name for name in named if named.count(name) > 1}:
        raise InvalidInput(f"{path}: {min(twice)} stands in it twice")
    return Result(path, dict(zip(named, rows, strict=True)))


def told_of(row: Mapping[str, Any], key: str) -> str | None:
    """What a row says of itself, or its parameters do; None for neither."""
    parameters = row.get("parameters")
    told = row.get(key, parameters.get(key) if isinstance(parameters, dict) else None)
    return None if told is None else str(told)


def _check_numbers(path: Path, row: Mapping[str, Any]) -> None:
    """Refuse what is no number of episodes, and no mean harm with an interval around it."""
    who = f"{path}: {row['agent']}"
    if not 1 <= row["episodes"] <= _MOST_EPISODES or isinstance(row["episodes"], bool):
        raise InvalidInput(f"{who}: episodes = {row['episodes']!s:.40}: must be 1 to {_MOST_EPISODES:,}")
    for harm in _COMPARED[row["kind"]]:
        if not _is_mean(row.get(harm), row.get(f"{harm}_interval"), row["episodes"]):
            raise InvalidInput(f"{who}: {harm} is no mean with an interval [low, high] around it")


def _is_mean(mean: Any, interval: Any, episodes: int) -> bool:
    """Whether these are a mean harm and its interval, which no single episode has."""
    ends = [mean, mean] if interval is None else interval
    if not isinstance(ends, list) or len(ends) != 2 or (interval is not None and episodes == 1):
        return False
    low, high = ends
    are_numbers = all(type(each) in (int, float) for each in (low, mean, high))
    return are_numbers and -_MOST_HARM <= low <= mean <= high <= _MOST_HARM and mean >= 0


def _rows_of(path: Path, content: Any) -> list[dict[str, Any]]:
    """The objects of a results file, one for each agent; ``InvalidInput`` where it is none, or of a kind without."""
    several = [content] if isinstance(content, dict) else content
    if not isinstance(several, list) or not several or not all(isinstance(row, dict) for row in several):
        raise InvalidInput(f"{path}: is no results file, as ethbrake evaluate --json prints one")
    for row in several:
        kind = row.get("kind")
        if not isinstance(kind, str):
            raise InvalidInput(f"{path}: is no results file, as ethbrake evaluate --json prints one (kind is missing)")
        if kind not in get_args(Kind):
            raise InvalidInput(f"{path}: {unknown_name('kind of results', kind, get_args(Kind))}")
        if kind not in _COMPARED:
            raise InvalidInput(f"{path}: results of {kind} cannot be compared; those of {', '.join(_COMPARED)} can")
    if not isinstance(content, dict):
        return several
    about = {key: value for key, value in content.items() if key != "agents"}
    agents = content.get("agents")
    if not isinstance(agents, list) or not agents or not all(isinstance(row, dict) for row in agents):
        raise InvalidInput(f"{path}: agents is missing or no list of objects: it is not whole")
    return [row | about for row in agents]


def _name_of(row: Mapping[str, Any]) -> str:
    return f"{row['agent']} ({row['mode']})" if row["kind"] == "shield" and "mode" in row else str(row["agent"])


# Two results compared: the same worlds of the same scenario, or no comparison.


@dataclass(frozen=True, slots=True)
class Difference:
    """What one agent does more in the second result than in the first, mean per world (m2/s2)."""

    agent: str
    policy: Literal["same", "other", "none"]  # whether both drove by the same one
    harms: Mapping[str, Estimate]  # by the name of the harm

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        harms = {f"{name}_difference": estimate for name, estimate in self.harms.items()}
        return {"agent": self.agent, "policy": self.policy, **estimates_to_json(harms)}


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two results on the same worlds, the second minus the first, agent by agent."""

    differences: tuple[Difference, ...]
    unpaired_because: str | None  # None: intervals are paired by world
    left_over: tuple[tuple[str, ...], tuple[str, ...]]  # agents of the first alone, and of the second
    other_settings: Mapping[
        str, tuple[str | None, str | None]
    ]  # of the agents of the first and of the second, likewise
    other_versions: Mapping[str, tuple[str | None, str | None]]  # of the first and of the second, where they differ

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "intervals": "paired" if self.unpaired_because is None else "unpaired",
            "unpaired_because": self.unpaired_because,
            "agents": [difference.to_json() for difference in self.differences],
            "only_in_first": list(self.left_over[0]),
            "only_in_second": list(self.left_over[1]),
            "other_settings": {name: list(both) for name, both in self.other_settings.items()},
            "other_versions": {name: list(both) for name, both in self.other_versions.items()},
        }


def compare_results(first: Result, second: Result) -> Comparison:
    """What agents of the same name did in both, the second minus the first.

    Paired by world where both have every world beside them. Raises ``InvalidInput`` for results of different kinds, on
    different worlds or scenarios, or without a common agent.
    """
    for key, what in SAME.items():
        one, other = (told_of(result.about, key) for result in (first, second))
        if one != other:
            raise InvalidInput(
                f"{second.path}: is about {what} than {first.path} ({key} {other!s:.12} and {one!s:.12}): no comparison"
            )
    common = [agent for agent in first.rows if agent in second.rows]
    left_over = [tuple(agent for agent in one.rows if agent not in common) for one in (first, second)]
    if not common:
        agents = " and ".join(f"{', '.join(names)}" for names in left_over)
        raise InvalidInput(f"{first.path} and {second.path} have no agent in common: {agents}")
    worlds, because = _worlds_of_both(first, second, common)
    differences = tuple(
        Difference(agent, _policies(first, second, agent), _differences(first, second, agent, worlds))
        for agent in common
    )
    return Comparison(differences, because, (left_over[0], left_over[1]), *_others(first, second))


Worlds = dict[str, tuple[Floats, Floats]]  # agent -> harms [n, 2] of the first and of the second, world by world


def _worlds_of_both(first: Result, second: Result, common: Sequence[str]) -> tuple[Worlds | None, str | None]:
    """The harms to pair, or why there are none."""
    try:
        one, other = first.harms(), second.harms()
    except InvalidInput as error:
        return None, f"one row per world is needed of both; {error}"
    found = {}
    for agent in common:
        worlds = sorted(one.get(agent, {}))
        if len(worlds) != first.rows[agent]["episodes"] or worlds != sorted(other.get(agent, {})):
            return None, f"the rows per world of {agent} are not those of {count_of(len(worlds), 'same world')}"
        found[agent] = tuple(np.array([side[agent][world] for world in worlds]) for side in (one, other))
        for result, harms in zip((first, second), found[agent], strict=True):
            _check_means(result, agent, harms)
    return found, None  # type: ignore[return-value]  # two of them each


def _check_means(result: Result, agent: str, harms: Floats) -> None:
    """Refuse means that are not those of the file with every world [n, 2]."""
    for name, mean in zip(HARMS, harms.mean(axis=0), strict=True):
        told = result.rows[agent].get(name)
        if told is not None and not math.isclose(told, mean, rel_tol=1e-9, abs_tol=1e-9):
            raise InvalidInput(f"{result.path}: {agent}: {name} = {told:g}, but the mean of its worlds is {mean:g}")


def _differences(first: Result, second: Result, agent: str, worlds: Worlds | None) -> dict[str, Estimate]:
    """The second minus the first, by the name of the harm."""
    if worlds is not None:
        before, after = worlds[agent]
        return {name: paired_difference(after[:, k], before[:, k]) for k, name in enumerate(HARMS)}
    sizes = second.rows[agent]["episodes"], first.rows[agent]["episodes"]
    return {
        harm: unpaired_difference(second.estimate(agent, harm), sizes[0], first.estimate(agent, harm), sizes[1])
        for harm in first.harm_names
    }


def _policies(first: Result, second: Result, agent: str) -> Literal["same", "other", "none"]:
    one, other = (result.rows[agent]["policy_sha256"] for result in (first, second))
    if not one and not other:
        return "none"
    return "same" if one == other else "other"


def _others(first: Result, second: Result) -> list[dict[str, tuple[str | None, str | None]]]:
    """Settings of the agents, and versions, that are not the same in both."""
    found = []
    for key in ("agent_settings", "versions"):
        one, other = (each if isinstance(each := result.about.get(key), dict) else {} for result in (first, second))
        names = dict.fromkeys([*one, *other])
        found.append({name: (one.get(name), other.get(name)) for name in names if one.get(name) != other.get(name)})
    return found
