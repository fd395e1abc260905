"""Results files: tables with one row per agent and world, and the JSON files that refer to them."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from ethbrake_marl.errors import EthBrakeError, InvalidInput, naming_extras, unknown_name
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.identity import Kind
from ethbrake_marl.evaluation.rescores import Rescored
from ethbrake_marl.evaluation.summary_row import SummaryRow
from ethbrake_marl.files.plain import parse_strict_json, read_plain
from ethbrake_marl.files.sheet import Estimate, parquet_file
from ethbrake_marl.files.store import check_target, write_output
from ethbrake_marl.game.objectives import Declared
from ethbrake_marl.scenario.fields import RECORDING

CSV, PARQUET = ".csv", ".parquet"

HARMS = ("first_impact_harm", "total_harm")

_HARMS = ("agent", "world", *HARMS)


def write_per_world(
    path: str | Path, evaluation: Evaluation, *, objectives: Sequence[Declared] = (), force: bool = False
) -> None:
    """Write a table with one row per agent and world: Parquet if the name ends in ``.parquet``, else CSV.

    docs/evaluate.md lists the columns. The row of a left-out world holds only its number and the reason, in ``ended``.
    The file is written completely or not at all.

    Args:
        path: the file to write.
        evaluation: results of the agents.
        objectives: objectives such as ``"social:45"``, which weigh a vehicle's own harm against the others'. Each adds
            columns with its value for every vehicle.
        force: replace an existing file.

    Raises ``AlreadyExists`` for an existing file unless ``force``, ``InvalidInput`` for a missing folder or another
    ending, ``MissingExtra`` for Parquet without pyarrow.

    """
    ending = Path(path).suffix.lower()
    if ending not in (CSV, PARQUET):
        raise InvalidInput(f"{path}: must end in {CSV} or {PARQUET}")
    if ending == PARQUET:
        with naming_extras():
            import pyarrow
        columns = evaluation.arrays(objectives)
        with parquet_file(check_target(path, force=force)) as write:
            write({name: pyarrow.array(values, from_pandas=True) for name, values in columns.items()})
        return
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    told = evaluation.per_world(objectives)
    writer.writerow(told)
    writer.writerows(zip(*told.values(), strict=True))
    write_output(path, text.getvalue().encode(), force=force)


Harms = dict[str, dict[int, tuple[float, ...]]]  # agent -> world -> (first-impact harm, total harm) in m2/s2


def read_harms(path: Path, data: bytes) -> tuple[Harms, dict[int, str]]:
    """Return the harms in a file of ``write_per_world``, and the recording of each world; empty without this column.

    Left-out worlds are omitted.

    Args:
        path: name of the file, whose ending decides the format; it is not opened.
        data: content of the file.

    Raises ``InvalidInput`` for a file without these columns.

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
        found: Harms = {}
        recordings: dict[int, str] = {}
        for agent, world, *harms in rows:
            told, harms = harms[2:], harms[:2]
            if harms[0] not in (None, ""):
                values = tuple(map(float, harms))
                if not all(0.0 <= value <= _MOST_HARM for value in values):
                    raise ValueError(f"world {world}: harm {harms}")
                found.setdefault(agent, {})[int(world)] = values
                recordings |= {int(world): name for name in told}
        return found, recordings
    except (KeyError, TypeError, ValueError, NotImplementedError, OSError, csv.Error) as error:
        raise InvalidInput(f"{path}: is no file of --per-world: {error}") from None


USUAL: Mapping[str, str] = {"harm_count": "first"}  # default settings of agents

COMPARED: dict[Kind, tuple[str, ...]] = {  # harms that are compared, by kind of results
    "evaluate": HARMS,
    "shield": ("harm",),
}

_LIMIT_BYTES, _MOST_BYTES = 64 << 20, 4 << 30  # size limits of a results file, and of a file with every world

_MOST_EPISODES = 10**12

_MOST_HARM = 1e100  # m2/s2; the square of a larger number could overflow

_HASHES = {"worlds_sha256": "another list of worlds", "scenario_sha256": "another scenario"}

SAME = {  # keys that must agree for a comparison; all but the hashes may be missing
    "kind": "another kind of results",
    "worlds_sha256": _HASHES["worlds_sha256"],
    "controlled_vehicle": "another driven vehicle",
    "scenario_sha256": _HASHES["scenario_sha256"],
    "harm_count": "another harm",
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
    told: Sequence[Rescored] = (),
    groups: Mapping[str, Sequence[SummaryRow]] | None = None,
    per_world: Path | None = None,
    settings: Mapping[str, str] = USUAL,
) -> list[dict[str, Any]]:
    """Return the content of a results file: one object per row.

    Args:
        rows: rows of the results table, one per agent.
        told: mean harms under other objectives (``Evaluation.rescore``), added to each agent's object.
        groups: name of a group of worlds -> rows of the same agents on that group (``summarise_by``).
        per_world: existing file with one row per world; its name and hash go into every object.
        settings: settings of all agents by name: ``{"harm_count": "first"}`` is the harm that they minimise.

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
    """Content of one results file (JSON) that was read and checked."""

    path: Path  # the file
    # JSON object of each agent, by its name; for results of ``ethbrake shield``, by ``AGENT (MODE)``.
    rows: Mapping[str, Mapping[str, Any]]

    @property
    def about(self) -> Mapping[str, Any]:
        """JSON object of the first agent, from which to read entries that are the same for all, such as the hashes."""
        return next(iter(self.rows.values()))

    def estimate(self, agent: str, harm: str) -> Estimate:
        """Return the mean harm of an agent with its interval.

        Args:
            agent: key of ``rows``.
            harm: key of the harm in the JSON object: ``first_impact_harm``, ``total_harm`` or ``harm``.

        """
        row = self.rows[agent]
        mean, interval = row[harm], row.get(f"{harm}_interval")
        return Estimate(float(mean), None if interval is None else (float(interval[0]), float(interval[1])))

    def harms(self) -> tuple[Harms, dict[int, str]]:
        """Read the harms of every world from the file that was written beside this one with ``--per-world``.

        Returns them, and the recording of each world, as ``read_harms`` does. Raises ``InvalidInput`` if that file is
        missing or was changed.
        """
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
    """Read and check a results file (JSON) that ``ethbrake evaluate``, ``shield`` or ``run`` wrote or printed.

    Raises ``InvalidInput`` for any other file, including kinds of results that cannot be compared, and results without
    hashes.
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
        who = f"{path}: {row['agent']}"
        if not 1 <= row["episodes"] <= _MOST_EPISODES or isinstance(row["episodes"], bool):
            raise InvalidInput(f"{who}: episodes = {row['episodes']!s:.40}: must be 1 to {_MOST_EPISODES:,}")
        if not 0 <= row["horizon_ends"] <= row["episodes"]:
            raise InvalidInput(f"{who}: horizon_ends = {row['horizon_ends']!s:.40}: must be 0 to {row['episodes']:,}")
        draws = told_of(row, "recordings") or f"{row['episodes']}"
        if not (draws.isdecimal() and len(draws) < 14 and 1 <= int(draws) <= row["episodes"]):
            raise InvalidInput(f"{who}: recordings = {draws:.40}: must be 1 to {row['episodes']:,}, or left out")
        shoved = row.get("vehicle_1_shoved_m")
        if shoved is not None and not (type(shoved) in (int, float) and abs(shoved) <= _MOST_HARM):
            raise InvalidInput(f"{who}: vehicle_1_shoved_m = {shoved!r:.40}: must be metres, or null")
        for harm in COMPARED[row["kind"]]:
            if not _is_mean(row.get(harm), row.get(f"{harm}_interval"), int(draws)):
                raise InvalidInput(f"{who}: {harm} is no mean with an interval [low, high] around it")
    if len({tuple(told_of(row, key) for key in SAME) for row in rows}) > 1:
        raise InvalidInput(f"{path}: its agents drove different worlds; each test needs a file of its own")
    named = [
        f"{row['agent']} ({row['mode']})" if row["kind"] == "shield" and "mode" in row else str(row["agent"])
        for row in rows
    ]
    if twice := {name for name in named if named.count(name) > 1}:
        raise InvalidInput(f"{path}: {min(twice)} stands in it twice")
    return Result(path, dict(zip(named, rows, strict=True)))


def told_of(row: Mapping[str, Any], key: str) -> str | None:
    """Return the value of ``key`` in ``row`` (an agent's JSON object), or else in its ``parameters``, as text.

    None if it is in neither.
    """
    parameters = row.get("parameters")
    told = row.get(key, parameters.get(key) if isinstance(parameters, dict) else None)
    return None if told is None else str(told)


def _is_mean(mean: Any, interval: Any, draws: int) -> bool:
    """Return whether these JSON values are a mean harm and an interval ``[low, high]`` around it.

    ``interval`` may be None; for a single independent draw (``draws`` = 1) it must be.
    """
    ends = [mean, mean] if interval is None else interval
    if not isinstance(ends, list) or len(ends) != 2 or (interval is not None and draws == 1):
        return False
    low, high = ends
    are_numbers = all(type(each) in (int, float) for each in (low, mean, high))
    return are_numbers and -_MOST_HARM <= low <= mean <= high <= _MOST_HARM and mean >= 0


def _rows_of(path: Path, content: Any) -> list[dict[str, Any]]:
    """Return the objects of a results file, one for each agent; raise ``InvalidInput`` for other content.

    ``content`` is the parsed JSON; ``path`` is named in errors.
    """
    several = [content] if isinstance(content, dict) else content
    if not isinstance(several, list) or not several or not all(isinstance(row, dict) for row in several):
        raise InvalidInput(f"{path}: is no results file, as ethbrake evaluate --json prints one")
    for row in several:
        kind = row.get("kind")
        if not isinstance(kind, str):
            raise InvalidInput(f"{path}: is no results file, as ethbrake evaluate --json prints one (kind is missing)")
        if kind not in get_args(Kind):
            raise InvalidInput(f"{path}: {unknown_name('kind of results', kind, get_args(Kind))}")
        if kind not in COMPARED:
            raise InvalidInput(f"{path}: results of {kind} cannot be compared; those of {', '.join(COMPARED)} can")
    if not isinstance(content, dict):
        return several
    about = {key: value for key, value in content.items() if key != "agents"}
    agents = content.get("agents")
    if not isinstance(agents, list) or not agents or not all(isinstance(row, dict) for row in agents):
        raise InvalidInput(f"{path}: agents is missing or no list of objects: it is not whole")
    return [row | about for row in agents]
