"""An item of the paper made again: verdicts, parameters, tables, figures and data, before anything is written."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

from ethbrake_marl.figures.style import Figure
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.studies.reproduction.verdicts import Verdict, summarise_verdicts

Shared = TypeVar("Shared")
Mode = Literal["quick", "full"]
QUICK: Mode = "quick"
FULL: Mode = "full"
LIST_SEED = 7
MOST_EPISODES = 10_000


@dataclass(frozen=True, slots=True)
class Settings:
    """What a reproduction is asked for."""

    mode: Mode
    folder: Path  # of everything; its trainings are read from there
    episodes: int = MOST_EPISODES  # the most worlds of any list; the paper has 10,000
    tell: OnProgress = lambda progress: None
    machine: str = ""  # in words
    shared: dict[tuple[object, ...], Any] = field(default_factory=dict)  # what several items show, made once

    def worlds(self, wanted: int) -> int:
        """How many worlds of a list that should have ``wanted``."""
        return min(wanted, self.episodes)

    def once(self, key: tuple[object, ...], make: Callable[[], Shared]) -> Shared:
        """What ``make`` gives, made by the first item that asks for it by this key."""
        if key not in self.shared:
            self.shared[key] = make()
        found: Shared = self.shared[key]
        return found

    def say(self, name: str, done: int, total: int) -> None:
        """Tell how far a part is."""
        self.tell(Progress(name, done, total))


@dataclass(frozen=True, slots=True)
class Parameter:
    """A quantity that shapes an item, and who says what it is."""

    name: str
    value: str
    stated: str  # where the paper says it; empty: it is ours

    @property
    def origin(self) -> str:
        """In words."""
        return f"stated in the paper ({self.stated})" if self.stated else "our default"


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {"title": self.title, "head": list(self.head), "rows": [list(r) for r in self.rows], "note": self.note}


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure; ``text`` says in words what it shows."""

    stem: str  # of its files
    title: str
    text: str
    figure: Figure


Column = Sequence[object]


@dataclass(frozen=True, slots=True)
class Made:
    """What became of an item."""

    verdicts: tuple[Verdict, ...]
    parameters: tuple[Parameter, ...]
    tables: tuple[Table, ...] = ()
    figures: tuple[Drawn, ...] = ()
    data: Mapping[str, str] | None = None  # stem of a CSV file -> its text
    notes: tuple[str, ...] = ()  # computed sentences: what was run, what was not

    @property
    def verdict(self) -> Verdict:
        """All in one line."""
        return summarise_verdicts(self.verdicts)


@dataclass(frozen=True, slots=True)
class Item:
    """One figure or table of the paper, and what makes it again."""

    name: str  # on the command line, and of its folder
    labels: tuple[str, ...]  # in the paper's source
    title: str
    what: str  # the paper's figure or table, in a sentence
    make: Callable[[Settings], Made]
    most_s: float  # processor seconds at the paper's numbers of worlds, and a little more
    trained: tuple[str, ...] = ()  # the groups of trainings that it shows with ``--full``


def csv_text(head: Sequence[str], rows: Iterable[Column]) -> str:
    """A CSV file."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return text.getvalue()


_SETTING = "sec:result, text to Fig:Harm-ivds"
_QUANTITIES = (  # name, key of a scenario, unit, where the paper states it
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


def scenario_parameters(scenario: Scenario, **stated: str) -> tuple[Parameter, ...]:
    """The quantities of a scenario, each with its origin.

    ``stated`` changes for a key where the paper states it; an empty text makes it ours.
    """
    content = scenario.model_dump(mode="json", exclude_none=True)
    found = [
        Parameter(name, f"{_plain(content[key])}{f' {unit}' if unit else ''}", stated.get(key, where))
        for name, key, unit, where in _QUANTITIES
        if key in content
    ]
    early = "worlds in which Vehicle 2 is hit before it may act are drawn again"
    found.append(Parameter("early impacts", early, "sec:system_model, assumed away"))
    return tuple(found)


def list_parameter(episodes: int, stated: str = "") -> Parameter:
    """How many worlds were drawn, and from which seed (which is ours: the paper says "a fixed random seed")."""
    return Parameter("worlds", f"{episodes:,}, the first of the list of seed {LIST_SEED}", stated)


def _plain(value: object) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{name} {_plain(each)}" for name, each in value.items())
    if isinstance(value, list):
        return "(" + ", ".join(_plain(each) for each in value) + ")"
    return f"{value:g}" if isinstance(value, int | float) else str(value)
