"""Settings of a reproduction of the paper, and types for items and results.

An *item* is a figure or a table of the paper.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

from matplotlib.figure import Figure
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as model

from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.extensions.report.page import Part
from ethbrake_marl.extensions.reproduction.trainings import Group, groups
from ethbrake_marl.extensions.reproduction.verdicts import (
    LIST_SEED,
    MOST_EPISODES,
    WRITTEN,
    Mode,
    Verdict,
    summarise_verdicts,
)
from ethbrake_marl.files.sheet import Estimate, Sheet, Shown, csv_text as csv_of
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.progress import OnProgress

SETTINGS, RESULT = "reproduction.json", "result.json"

FORMAT = {"format": "ethbrake-reproduction", "format_version": 2}

LIMIT_BYTES = 16 << 20  # size limit of a figure file that is read


@dataclass(frozen=True, slots=True, eq=False)
class Reproduction:
    """Settings of a reproduction of the paper's figures and tables."""

    mode: Mode  # ``quick``: train nothing, use shipped policies; ``full``: also use trainings
    folder: Path  # folder of all results, and of the trainings
    episodes: int = MOST_EPISODES  # largest number of worlds for a figure or table; the paper has 10,000
    tell: OnProgress = lambda progress: None  # function that receives the progress
    machine: str = ""  # description of the machine, which is stored with the results

    def seeds_of(self, wanted: Collection[str]) -> list[tuple[Group, str, list[Path]]]:
        """Return the training runs of some groups, for each recipe as (group, name of the recipe, folder of each seed).

        ``wanted`` are the names of the groups. In mode ``quick`` the result is empty.
        """
        return [
            (
                group,
                name,
                [self.folder / "trainings" / group.name / f"{name}-seed{seed}" for seed in range(group.seeds)],
            )
            for group in groups().values()
            if group.name in wanted and self.mode == "full"
            for name in group.trained
        ]

    def trained(self, wanted: Collection[str]) -> dict[str, list[Path]]:
        """Return the recipes of which all training runs are finished: ``group/recipe`` -> folder of each seed.

        ``wanted`` are the names of the groups.
        """
        return {
            f"{group.name}/{name}": paths
            for group, name, paths in self.seeds_of(wanted)
            if all(RunDirectory(path).is_finished for path in paths)
        }

    def seconds_left(self, wanted: Collection[str]) -> float:
        """Estimate the time (s) in which one core does all unfinished training runs of the groups ``wanted``.

        A run that has begun counts with its whole time.
        """
        return sum(
            group.trained[name][0].decisions / group.trained[name][0].per_s
            for group, name, paths in self.seeds_of(wanted)
            for path in paths
            if not RunDirectory(path).is_finished
        )

    def train(self, wanted: Collection[str]) -> bool:
        """Do the unfinished training runs of the groups ``wanted``. Return False if Ctrl-C stopped one."""
        from ethbrake_marl.extensions.reproduction.learning_curves import LearningCurves

        for group in groups().values():
            if group.name in wanted:
                plan = [(recipe, group.seeds) for _, recipe in group.trained.values()]
                place = self.folder / "trainings" / group.name
                if not LearningCurves(load_scenario(group.scenario), plan, place).train(tell=self.tell):
                    return False
        return True

    def cost(self, items: Sequence[Item]) -> str:
        """Return a message that says how much work is left for ``items``, and how long it takes."""
        wanted = {group for item in items for group in item.trained} if self.mode == "full" else set()
        cost = (
            f"to do: {count_of(len(items), 'item')}, at most about {sum(item.most_s for item in items)} s of one core"
        )
        training_s = self.seconds_left(wanted)
        return f"{cost}; trainings before them about {training_s / 60.0:.0f} min of one core" if wanted else cost


@model(frozen=True, config=WRITTEN)
class Parameter:
    """Quantity that affects an item, its value, and the origin of this value."""

    name: str  # name of the quantity
    value: str  # its value as text, with unit
    origin: str = "our default"  # origin of the value: our default, or the place where the paper states it


def stated(name: str, value: str, where: str) -> Parameter:
    """Return a parameter that the paper states at ``where``; if ``where`` is empty, the value is our default."""
    return Parameter(name, value, f"stated in the paper ({where})") if where else Parameter(name, value)


@model(frozen=True, config=WRITTEN)
class Table:
    """A table in the stored result of an item: headings, and cells as text."""

    title: str  # title above the table
    head: Sequence[str]  # headings of the columns
    rows: Sequence[Sequence[Shown]]  # cells of each row; a cell is a value, with an interval if it has one
    note: str = ""  # text below the table


@model(frozen=True, config=WRITTEN)
class Drawn:
    """Name, title and description of a figure in a result."""

    stem: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,63}$")]  # name of the figure's files without ending
    title: str  # title above the figure
    text: str  # description of the figure in words


@dataclass(frozen=True, slots=True)
class Made:
    """Reproduction of an item, before it is written to files."""

    verdicts: Sequence[Verdict]  # verdict on each comparison with the paper
    parameters: Sequence[Parameter]  # quantities that affect the result
    tables: Sequence[Sheet] = ()  # tables to show
    figures: Mapping[Drawn, Figure] = field(default_factory=dict)  # figures to show, by name and description
    data: Mapping[str, str] = field(default_factory=dict)  # name of a CSV file without ending -> content of the file
    notes: Sequence[str] = ()  # sentences that say what was run and what was not


@model(frozen=True, config=WRITTEN, kw_only=True)
class Result:
    """Reproduction of an item, as stored in a file and shown on pages."""

    name: str  # name on the command line; also the name of the folder
    labels: Sequence[str]  # labels in the source of the paper
    title: str  # title of the result
    what: str  # description of the paper's figure or table, one sentence
    mode: Mode = "quick"  # ``quick`` or ``full`` (with trainings)
    episodes: int = MOST_EPISODES  # largest number of worlds for a figure or table
    trained: Sequence[str]  # trainings that were used, as ``group/recipe``
    processor_s: float  # processor time without the trainings, s
    made_utc: str  # date and time at which the result was made (UTC, ISO 8601)
    machine: str  # description of the machine
    verdict: Verdict  # summary of all verdicts
    comparisons: Sequence[Verdict]  # verdict on each comparison with the paper
    parameters: Sequence[Parameter]  # quantities that affect the result
    tables: Sequence[Table]  # tables to show
    figures: Sequence[Drawn]  # names and descriptions of the figures
    data: Sequence[str]  # names of the CSV files
    notes: Sequence[str]  # sentences that say what was run and what was not

    def in_words(self) -> dict[str, Any]:
        """Return the result as mappings, lists and texts, for a JSON file.

        A cell of a table becomes one text: the value, and its interval if it has one.
        """
        tables = [
            {**asdict(table), "rows": [[cell.in_words for cell in row] for row in table.rows]} for table in self.tables
        ]
        return asdict(self) | {"tables": tables}


@dataclass(frozen=True, slots=True)
class Item:
    """One item, and the function that reproduces it."""

    name: str  # name on the command line; also the name of the folder
    labels: tuple[str, ...]  # labels in the source of the paper
    title: str  # title of the item
    what: str  # description of the paper's figure or table, one sentence
    make: Callable[[Reproduction], Made]  # function that reproduces the item
    most_s: float  # upper estimate of the processor time (s) with as many worlds as in the paper
    trained: tuple[str, ...] = ()  # names of the groups of trainings that the item uses with ``--full``
    play: Callable[[], Part] | None = None  # function that returns a player of episodes for the page; None: no player


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return the content of a CSV file with the headings ``head``.

    An ``Estimate`` in a row fills three columns: value, lower and upper end of the interval.
    """
    parts = ([(e.value, *(e.interval or ("", ""))) if isinstance(e, Estimate) else (e,) for e in row] for row in rows)
    return csv_of([dict(zip(head, chain(*row), strict=True)) for row in parts], head)


_SETTING = "sec:result, text to Fig:Harm-ivds"

_QUANTITIES = (  # name, key of a scenario, unit, place where the paper states it
    ("braking capacities", "braking_capacity_mps2", "m/s²", _SETTING),
    ("driving capacities", "driving_capacity_mps2", "m/s²", _SETTING),
    ("masses", "mass_t", "t", _SETTING),
    ("gaps", "gaps_m", "m", "the item's text"),
    ("speeds", "speeds_mps", "m/s", "the item's text"),
    ("latencies (Vehicle 1, 2, 3)", "latency_s", "s", _SETTING),
    ("restitution e", "restitution", "", ""),
    ("time step", "time_step_s", "s", ""),
    ("horizon", "horizon_s", "s", ""),
    ("speed limit v_max", "speed_limit_mps", "m/s", ""),
)

POLICIES = "PPO and SAC are the shipped policies, trained on paper-random at 0.5 and 0.8 s"

FIRST_IMPACTS = stated("harm", "each pair's first impact", "sec:result, Experimental Set-Up")


def scenario_parameters(scenario: Scenario, **places: str) -> list[Parameter]:
    """Return the main quantities of a scenario, with the place where the paper states each.

    ``places`` maps keys of the scenario to places that replace the places in ``_QUANTITIES``. An empty place means that
    the paper does not state the value, which is then our default.
    """
    content = scenario.model_dump(mode="json", exclude_none=True)
    parameters = [
        stated(name, f"{_plain(content[key])}{f' {unit}' if unit else ''}", places.get(key, where))
        for name, key, unit, where in _QUANTITIES
        if key in content
    ]
    early = "worlds in which Vehicle 2 is hit before it may act are drawn again"
    return [*parameters, stated("early impacts", early, "sec:system_model, assumed away")]


def list_parameter(episodes: int, where: str = "") -> Parameter:
    """Return a parameter with the number of worlds (stated in the paper at ``where``) and the seed of their list.

    The seed is our choice, because the paper only says "a fixed random seed".
    """
    return stated("worlds", f"{episodes:,}, the first of the list of seed {LIST_SEED}", where)


def _plain(value: object) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{name} {_plain(each)}" for name, each in value.items())
    if isinstance(value, list):
        return "(" + ", ".join(_plain(each) for each in value) + ")"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


H_STAR = stated("H*", "realised (ours) and predicted pair by pair (the paper's)", "sec:baseline_drl, Hybrid DRL")

NOT_THEIRS = Parameter("policies", f"{POLICIES}; not the paper's")


def json_text(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def checked_result(content: Mapping[str, Any], where: Path | str, name: str) -> Result:
    """Check the content of a result file, and return the result.

    Raises ``InvalidInput`` if an entry is missing or wrong, or if the result belongs to an item other than ``name``.
    ``where`` is the path of the file, for the message.
    """
    try:
        result = TypeAdapter(Result).validate_json(json.dumps(content))
    except ValidationError as error:
        wrong = ": ".join(map(str, error.errors()[0]["loc"]))
    else:
        lines = [(each.head, row) for each in result.tables for row in [each.head, *each.rows]]
        checks = {
            "name": result.name == name,
            "data": all(Path(file).name == file for file in result.data),
            "tables: rows": all(head and len(row) == len(head) for head, row in lines),
            "verdict": result.verdict == summarise_verdicts(result.comparisons),
        }
        wrong = next((what for what, is_right in checks.items() if not is_right), "")
    if wrong:
        raise InvalidInput(
            f"{where}: the key {wrong} is missing or its value is wrong; reproduce the item again (--force)"
        )
    return result
