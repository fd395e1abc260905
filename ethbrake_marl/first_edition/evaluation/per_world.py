"""Results files: JSON files with one object per agent, and tables with one row per agent and world."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from ethbrake_marl.errors import EthBrakeError, InvalidInput, naming_extras, unknown_name
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.sheet import Estimate, parquet_file
from ethbrake_marl.files.store import check_target, write_output
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.identity import Kind
from ethbrake_marl.first_edition.evaluation.rescores import Rescored
from ethbrake_marl.first_edition.evaluation.summary_row import SummaryRow
from ethbrake_marl.first_edition.game.objectives import Declared
from ethbrake_marl.first_edition.scenario.fields import RECORDING

CSV, PARQUET = ".csv", ".parquet"

HARMS = ("first_impact_harm", "total_harm")

_HARMS = ("agent", "world", *HARMS)


def write_per_world(
    path: str | Path, evaluation: Evaluation, *, objectives: Sequence[Declared] = (), force: bool = False
) -> None:
    """Write a table with one row per agent and world as CSV or Parquet.

    docs/evaluate.md lists the columns of the table. Each objective, such as ``"social:45"`` (docs/cooperation.md), adds
    columns with its value for each vehicle. The row of a world that was left out contains only the agent, the world's
    number and, in the column ``ended``, the reason. If writing fails, no incomplete file remains.

    Raises ``AlreadyExists`` if the file exists and ``force`` is false, ``InvalidInput`` if the folder is missing or
    ``path`` ends in neither ``.csv`` nor ``.parquet``, and ``MissingExtra`` for Parquet if pyarrow is not installed.
    """
    ending = Path(path).suffix.lower()
    if ending not in (CSV, PARQUET):
        raise InvalidInput(f"{path}: the name of the file must end in {CSV} or {PARQUET}")
    if ending == PARQUET:
        with naming_extras():
            import pyarrow
        columns = evaluation.arrays(objectives)
        with parquet_file(check_target(path, force=force)) as write:
            write({name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()})
        return
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    table = evaluation.per_world(objectives)
    writer.writerow(table)
    writer.writerows(zip(*table.values(), strict=True))
    write_output(path, text.getvalue().encode(), force=force)


Harms = dict[str, dict[int, tuple[float, ...]]]  # agent -> world -> (first-impact harm, total harm) in m2/s2


def read_harms(path: Path, data: bytes) -> tuple[Harms, dict[int, str]]:
    """Return the harms of each agent in each world, and each world's recording, from a file of ``write_per_world``.

    ``data`` is the content of the file ``path``, whose ending decides the format. The second dictionary, world ->
    recording, is empty if the file has no column ``recording``. Both dictionaries omit the worlds that were left out.
    Raises ``InvalidInput`` if the file lacks a column that is needed here, or has an invalid value.
    """
    try:
        if path.suffix.lower() == PARQUET:
            with naming_extras():
                from pyarrow.parquet import ParquetFile
            file = ParquetFile(io.BytesIO(data))
            names = [*_HARMS, *({RECORDING} & {*file.schema_arrow.names})]
            table = file.read(names).to_pydict()
            rows = list(zip(*(table[name] for name in names), strict=True))
        else:
            lines = csv.DictReader(data.decode("utf-8").splitlines())
            names = [*_HARMS, *({RECORDING} & {*(lines.fieldnames or ())})]
            rows = [tuple(line[name] for name in names) for line in lines]
        of_agents: Harms = {}
        recordings: dict[int, str] = {}
        for agent, world, *harms in rows:
            recording, harms = harms[2:], harms[:2]
            if harms[0] not in (None, ""):
                values = tuple(map(float, harms))
                if not all(0.0 <= value <= _MOST_HARM for value in values):
                    raise ValueError(f"harms of world {world} = {harms}: must be from 0 to {_MOST_HARM:g}")
                of_agents.setdefault(agent, {})[int(world)] = values
                recordings |= {int(world): name for name in recording}
        return of_agents, recordings
    except (KeyError, TypeError, ValueError, NotImplementedError, OSError, csv.Error) as error:
        raise InvalidInput(f"{path}: is not a file that --per-world wrote: {error}") from None


USUAL: Mapping[str, str] = {"harm_count": "first"}  # default settings of agents

COMPARED: dict[Kind, tuple[str, ...]] = {  # kind of results -> keys of the harms that are compared
    "evaluate": HARMS,
    "shield": ("harm",),
}

_LIMIT_BYTES, _MOST_BYTES = 64 << 20, 4 << 30  # size limits of a JSON results file, and of a file of --per-world

_MOST_EPISODES = 10**12

_MOST_HARM = 1e100  # m2/s2; the square of a larger number could overflow

_HASHES = {"worlds_sha256": "their worlds differ", "scenario_sha256": "their scenarios differ"}

# Keys whose values must agree for a comparison -> reason to refuse. All keys but the hashes may be missing.
SAME = {
    "kind": "their kinds of results differ",
    "worlds_sha256": _HASHES["worlds_sha256"],
    "controlled_vehicle": "their controlled vehicles differ",
    "scenario_sha256": _HASHES["scenario_sha256"],
    "harm_count": "their counts of harm differ",
}

_NEEDED = {
    "agent": str,
    "episodes": int,
    **dict.fromkeys(_HASHES, str),
    "policy_sha256": dict,
    "versions": dict,
    "horizon_ends": int,
}


def results_to_json(
    rows: Sequence[SummaryRow],
    *,
    rescored: Sequence[Rescored] = (),
    groups: Mapping[str, Sequence[SummaryRow]] | None = None,
    per_world: Path | None = None,
    settings: Mapping[str, str] = USUAL,
) -> list[dict[str, Any]]:
    """Return the content of a JSON results file: one object per agent, to which the other arguments are added.

    Args:
        rows: rows of the results table, one per agent.
        rescored: mean values of objectives (``Evaluation.rescore``).
        groups: name of a group of worlds -> results of the same agents in this group (``summarise_by``).
        per_world: existing file of ``write_per_world``, whose name and hash are added.
        settings: settings of all agents, such as ``{"harm_count": "first"}``.

    """
    objects = [row.to_json() | {"agent_settings": dict(settings)} for row in rows]
    if rescored:
        of = {row["agent"]: [each.to_json() for each in rescored if each.agent == row["agent"]] for row in objects}
        objects = [row | {"objectives": of[row["agent"]]} for row in objects]
    for row in objects if groups else ():
        row["groups"] = {
            name: each.to_json() for name, part in (groups or {}).items() for each in part if each.agent == row["agent"]
        }
    if per_world is None:
        return objects
    beside = {"file": per_world.name, "sha256": hashlib.sha256(per_world.read_bytes()).hexdigest()}
    return [row | {"per_world": beside} for row in objects]


@dataclass(frozen=True, slots=True)
class Result:
    """Content of one JSON results file, after the checks of ``read_result``."""

    path: Path
    # Name of an agent -> its JSON object. In results of ``ethbrake shield`` the names have the form ``AGENT (MODE)``.
    rows: Mapping[str, Mapping[str, Any]]

    @property
    def about(self) -> Mapping[str, Any]:
        """JSON object of the first agent, to read entries that are equal for all agents, such as the hashes."""
        return next(iter(self.rows.values()))

    def estimate(self, agent: str, harm: str) -> Estimate:
        """Return the mean harm of an agent with its interval, m2/s2; ``harm`` is a key of its JSON object."""
        row = self.rows[agent]
        mean, interval = row[harm], row.get(f"{harm}_interval")
        return Estimate(float(mean), None if interval is None else (float(interval[0]), float(interval[1])))

    def harms(self) -> tuple[Harms, dict[int, str]]:
        """Return the result of ``read_harms`` for the file of ``--per-world`` that belongs to this results file.

        Raises ``InvalidInput`` if there is no such file, or if it was changed later.
        """
        beside = self.about.get("per_world")
        if not isinstance(beside, dict) or not isinstance(beside.get("file"), str):
            raise InvalidInput(
                f"{self.path} was written without a file that has one row per world; evaluate again with --per-world"
            )
        file = self.path.parent / Path(beside["file"]).name
        if not file.is_file():
            raise InvalidInput(f"{file}, the file with one row per world of {self.path}, does not exist")
        data = read_plain(file, _MOST_BYTES)
        if hashlib.sha256(data).hexdigest() != beside.get("sha256"):
            raise InvalidInput(f"{file} was changed after {self.path} was written; evaluate again")
        return read_harms(file, data)


def read_result(path: Path) -> Result:
    """Read and check a JSON results file of ``ethbrake evaluate``, ``ethbrake shield`` or ``ethbrake run``.

    Raises ``InvalidInput`` if ``path`` is not a results file of these commands, if results of this kind cannot be
    compared, or if the hash of the worlds or of the scenario is missing.
    """
    try:
        content = parse_strict_json(read_plain(path, _LIMIT_BYTES))
    except ValueError as error:
        if isinstance(error, EthBrakeError):
            raise
        raise InvalidInput(f"{path}: must contain complete JSON: {error}") from None
    rows = _rows_of(path, content)
    for row in rows:
        for key, kind in _NEEDED.items():
            if not isinstance(row.get(key), kind):
                raise InvalidInput(
                    f"{path}: {key} is missing or not of type {kind.__name__}; run ethbrake evaluate again"
                )
        who = f"{path}: {row['agent']}"
        if not 1 <= row["episodes"] <= _MOST_EPISODES or isinstance(row["episodes"], bool):
            raise InvalidInput(f"{who}: episodes = {row['episodes']!s:.40}: must be from 1 to {_MOST_EPISODES:,}")
        if not 0 <= row["horizon_ends"] <= row["episodes"]:
            raise InvalidInput(
                f"{who}: horizon_ends = {row['horizon_ends']!s:.40}: must be the number of episodes in which a vehicle"
                f" still moves at the horizon, from 0 to {row['episodes']:,}"
            )
        draws = recorded_value(row, "recordings") or f"{row['episodes']}"
        if not (draws.isdecimal() and len(draws) < 14 and 1 <= int(draws) <= row["episodes"]):
            raise InvalidInput(
                f"{who}: recordings = {draws:.40}: must be the number of recordings from which the worlds come, from 1"
                f" to {row['episodes']:,}, or be missing"
            )
        shoved = row.get("vehicle_1_shoved_m")
        if shoved is not None and not (type(shoved) in (int, float) and abs(shoved) <= _MOST_HARM):
            raise InvalidInput(f"{who}: vehicle_1_shoved_m = {shoved!r:.40}: must be a number of metres, or null")
        for harm in COMPARED[row["kind"]]:
            if not _is_mean(row.get(harm), row.get(f"{harm}_interval"), int(draws)):
                raise InvalidInput(
                    f"{who}: {harm} = {row.get(harm)!s:.40}, {harm}_interval = {row.get(f'{harm}_interval')!s:.60}:"
                    " must be a mean harm, and an interval [low, high] that contains the mean"
                )
    if len({tuple(recorded_value(row, key) for key in SAME) for row in rows}) > 1:
        raise InvalidInput(
            f"{path}: the agents were evaluated in different worlds; write the results of each test to its own file"
        )
    named = [
        f"{row['agent']} ({row['mode']})" if row["kind"] == "shield" and "mode" in row else str(row["agent"])
        for row in rows
    ]
    if twice := {name for name in named if named.count(name) > 1}:
        raise InvalidInput(f"{path}: lists the agent {min(twice)} twice; evaluate each agent once")
    return Result(path, dict(zip(named, rows, strict=True)))


def recorded_value(row: Mapping[str, Any], key: str) -> str | None:
    """Return, as text, the value of ``key`` in an agent's JSON object or, if missing there, in its ``parameters``."""
    parameters = row.get("parameters")
    value = row.get(key, parameters.get(key) if isinstance(parameters, dict) else None)
    return None if value is None else str(value)


def _is_mean(mean: Any, interval: Any, draws: int) -> bool:
    """Return True if ``mean`` is a valid mean harm and ``interval`` is either None or ``[low, high]`` around it.

    With one draw (independent world or recording), ``interval`` must be None.
    """
    ends = [mean, mean] if interval is None else interval
    if not isinstance(ends, list) or len(ends) != 2 or (interval is not None and draws == 1):
        return False
    low, high = ends
    are_numbers = all(type(each) in (int, float) for each in (low, mean, high))
    return are_numbers and -_MOST_HARM <= low <= mean <= high <= _MOST_HARM and mean >= 0


def _rows_of(path: Path, content: Any) -> list[dict[str, Any]]:
    """Return the JSON objects of a results file, one for each agent; raise ``InvalidInput`` for other content."""
    several = [content] if isinstance(content, dict) else content
    if not isinstance(several, list) or not several or not all(isinstance(row, dict) for row in several):
        raise InvalidInput(f"{path}: is not a results file; give a file with the output of ethbrake evaluate --json")
    for row in several:
        kind = row.get("kind")
        if not isinstance(kind, str):
            raise InvalidInput(
                f"{path}: is not a results file, because the key kind is missing; give a file with the output of"
                " ethbrake evaluate --json"
            )
        if kind not in get_args(Kind):
            raise InvalidInput(f"{path}: {unknown_name('kind of results', kind, get_args(Kind))}")
        if kind not in COMPARED:
            raise InvalidInput(
                f"{path}: results of the kind {kind} cannot be compared; give results of the kind"
                f" {' or '.join(COMPARED)}"
            )
    if not isinstance(content, dict):
        return several
    about = {key: value for key, value in content.items() if key != "agents"}
    agents = content.get("agents")
    if not isinstance(agents, list) or not agents or not all(isinstance(row, dict) for row in agents):
        raise InvalidInput(f"{path}: the key agents must be a list of one or more objects; evaluate again")
    return [row | about for row in agents]
