"""The folder of a reproduction: its settings, and for each item its result, figures and data, each written whole."""

from __future__ import annotations

import base64
import binascii
import json
import re
import textwrap
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from markupsafe import Markup
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError

from ethbrake_marl import __version__
from ethbrake_marl.errors import AlreadyExists, InvalidInput, count_of, plain_text, unknown_name
from ethbrake_marl.evaluation.results import check_target, write_output
from ethbrake_marl.figures.style import picture_bytes
from ethbrake_marl.files.store import check_writable, read_plain, write_file
from ethbrake_marl.learning.training import read_object
from ethbrake_marl.pages.frame import (
    Cell,
    Part,
    Section,
    anchors,
    facts,
    heading,
    opened,
    page,
    paragraph,
    shown,
    table,
)
from ethbrake_marl.pages.player import player_of
from ethbrake_marl.pages.vector import kept_drawing
from ethbrake_marl.studies.reproduction.gaps import reproduce_gaps
from ethbrake_marl.studies.reproduction.item import (
    FULL,
    MOST_EPISODES,
    OUTCOMES,
    TOLERANCE,
    WIDE,
    Item,
    Made,
    Settings,
    Verdict,
    summarise_verdicts,
)
from ethbrake_marl.studies.reproduction.tables import (
    reproduce_hybrid_table,
    reproduce_illustration,
    reproduce_random_table,
)
from ethbrake_marl.studies.reproduction.trainings import (
    CURVES,
    OPEN,
    STOPPED,
    reproduce_high,
    reproduce_low,
    seconds_left,
    train_groups,
    trained_names,
)
from ethbrake_marl.studies.reproduction.two_scenarios import (
    reproduce_accelerations,
    reproduce_delays,
    reproduce_distance,
    reproduce_trajectories,
)

# The episodes that an item lets one watch: kept beside its result as plain data, and read again with suspicion.

EPISODES = "episodes.json"
_EPISODE_LIMIT_BYTES = 4 << 20
_MOST = 64  # vehicles

_Index = Annotated[int, Field(ge=0, lt=_MOST)]
_Impact = Annotated[list[FiniteFloat], Field(min_length=7, max_length=7)]


class _Plain(BaseModel):
    """What ``player_content`` gives, and nothing else."""

    model_config = ConfigDict(strict=True, extra="forbid")


class _Episode(_Plain):
    pieces: str
    end: FiniteFloat
    impacts: list[_Impact]
    stepped: list[FiniteFloat]
    driven: list[_Index]
    obstacle: FiniteFloat | None
    rest: bool
    passport: str


class _World(_Plain):
    number: int
    title: str
    kind: str
    why: str
    conditions: str
    episodes: list[_Episode]


class _Content(_Plain):
    vehicles: Annotated[int, Field(ge=2, le=_MOST)]
    agents: Annotated[list[str], Field(min_length=1)]
    shown: Annotated[list[_Index], Field(min_length=1)]
    worlds: Annotated[list[_World], Field(min_length=1)]


def keep_episodes(folder: Path, content: Mapping[str, Any] | None) -> None:
    """Write what ``player_content`` gave into the folder of an item; None: what was there is deleted."""
    if content is None:
        (folder / EPISODES).unlink(missing_ok=True)
    else:
        write_output(folder / EPISODES, json.dumps(content, allow_nan=False).encode(), force=True)


def kept_player(folder: Path) -> Part | None:
    """The player of the episodes that were kept; None where there are none.

    Raises ``InvalidInput`` for a file that does not hold what ``keep_episodes`` writes.
    """
    file = folder / EPISODES
    if not file.is_file():
        return None
    try:
        content = _Content.model_validate_json(read_plain(file, _EPISODE_LIMIT_BYTES))
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"])) or "no JSON"
        raise _damaged_episode(file, where) from None
    if not _fits(content):
        raise _damaged_episode(file, "worlds")
    return player_of(_as_text(content.model_dump()))


def _fits(content: _Content) -> bool:
    """Whether every world has an episode of every agent, whole pieces in each."""
    agents, width = len(content.agents), 8 * (1 + 3 * content.vehicles)
    if not all(k < agents for k in content.shown):
        return False
    for world in content.worlds:
        if len(world.episodes) != agents:
            return False
        for episode in world.episodes:
            try:
                size = len(base64.b64decode(episode.pieces, validate=True))
            except (binascii.Error, ValueError):
                return False
            if not size or size % width or not all(i < content.vehicles for i in episode.driven):
                return False
    return True


def _as_text(value: Any) -> Any:
    """The same data with every text as a page shows it."""
    if isinstance(value, dict):
        return {key: _as_text(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_as_text(each) for each in value]
    return shown(value) if isinstance(value, str) else value


def _damaged_episode(file: Path, where: str) -> InvalidInput:
    return InvalidInput(f"{file}: {shown(where)}: is not what a reproduction writes; make it again (--force)")


# The table of everything that ``ethbrake reproduce`` makes: one entry per figure and table of the paper.

_CURVES = tuple(group for groups in CURVES.values() for group in groups)

ITEMS = (
    Item(
        "learning-high",
        ("fig:ppo_sac_high_latency",),
        "Learning curves at high delay",
        "Returns of PPO and SAC in training under large communication delays.",
        reproduce_high,
        10,
        _CURVES,
    ),
    Item(
        "learning-low",
        ("fig:ppo_sac_low_latency",),
        "Learning curves at low delay",
        "Returns of PPO and SAC in training under small communication delays.",
        reproduce_low,
        10,
        _CURVES,
    ),
    Item(
        "harm-distance",
        ("Fig:Harm-ivds",),
        "Harm over total distance",
        "Harm of the non-ethical strategy, E-V2X-BM, SAC and PPO against the sum of both gaps.",
        reproduce_distance,
        15,
    ),
    Item(
        "harm-delays",
        ("Fig:harm-delay",),
        "Harm at three delays",
        "Harm of the four strategies at three communication delays, gaps of 7 m.",
        reproduce_delays,
        15,
    ),
    Item(
        "trajectories",
        ("Fig:pic5sim",),
        "Trajectories of Scenarios 1 and 2",
        "Positions of the three vehicles under PPO and SAC, against the vehicle and against time.",
        reproduce_trajectories,
        5,
    ),
    Item(
        "accelerations",
        ("Fig:pic5act",),
        "Acceleration profiles of Scenarios 1 and 2",
        "Commands of Vehicle 2 under PPO and SAC.",
        reproduce_accelerations,
        5,
    ),
    Item(
        "hybrid-illustration",
        ("Fig:hybrid illu",),
        "Illustration of the hybrid",
        "Harm of E-V2X-BM, of a policy that has not converged, and of the hybrid of both, against total distance.",
        reproduce_illustration,
        20,
        (STOPPED,),
    ),
    Item(
        "hybrid-table",
        ("Table:hybrid",),
        "E-V2X-BM, DRL and hybrid in 5,000 episodes",
        "Collisions and harm of E-V2X-BM, of a policy that has not converged, and of the hybrid.",
        reproduce_hybrid_table,
        20,
        (STOPPED,),
    ),
    Item(
        "random-table",
        ("Table:Random",),
        "Four strategies in 10,000 random episodes",
        "Collisions, harm and its decrease of the non-ethical strategy, E-V2X-BM and the hybrids of SAC and PPO.",
        reproduce_random_table,
        60,
    ),
    Item(
        "gaps",
        (),
        "What the paper leaves open",
        "Every quantity that the paper leaves open, our default, and how far the headline moves when it changes.",
        reproduce_gaps,
        40,
        (OPEN,),
    ),
)


def choose_items(names: Sequence[str]) -> list[Item]:
    """The items of these names in the order of the paper, all of them for none.

    Raises ``UnknownName`` with a suggestion, ``InvalidInput`` for one that is given twice.
    """
    known = {item.name: item for item in ITEMS}
    for k, name in enumerate(names):
        if name not in known:
            raise unknown_name("item", name, known)
        if name in names[:k]:
            raise InvalidInput(f"item {name!r} is given twice")
    return [item for item in ITEMS if not names or item.name in names]


Json = dict[str, Any]

SETTINGS, RESULT, PAGE = "reproduction.json", "result.json", "index.html"
ENDINGS = (".svg", ".png")
_FORMAT = {"format": "ethbrake-reproduction", "format_version": 1}
_STEM = re.compile(r"[a-z0-9][a-z0-9-]{0,63}")
_LIMIT_BYTES = 16 << 20  # of a figure that is read again


@dataclass(frozen=True, slots=True)
class ReproductionFolder:
    """Names inside the folder."""

    path: Path

    @property
    def settings(self) -> Path:
        """What was asked for."""
        return self.path / SETTINGS

    @property
    def page(self) -> Path:
        """The page of everything."""
        return self.path / PAGE

    def result(self, name: str) -> Path:
        """What became of an item."""
        return self.path / name / RESULT

    def figure(self, name: str, stem: str, ending: str) -> Path:
        """A figure of an item; raises ``InvalidInput`` for a stem that is no plain name."""
        return self.path / name / f"{checked_stem(stem)}{ending}"


def checked_stem(stem: str) -> str:
    """The same name of a figure; raises ``InvalidInput`` for one that is no plain name."""
    if not _STEM.fullmatch(stem):
        raise InvalidInput(f"figure {stem!r:.60}: must be small letters, digits and -")
    return stem


def open_folder(settings: Settings, *, force: bool = False) -> ReproductionFolder:
    """Make the folder, or go on in it.

    Raises ``InvalidInput`` for one that cannot be made or written to; ``AlreadyExists`` for one that holds something
    else, or a reproduction with other settings, unless ``force``, which replaces its results and keeps its trainings.
    """
    folder, wanted = ReproductionFolder(settings.folder), _wanted(settings)
    if folder.path.is_symlink() or (folder.path.exists() and not folder.path.is_dir()):
        raise InvalidInput(f"{folder.path}: is no plain folder; give another (--output)")
    if folder.settings.is_file():
        kept = read_object(folder.settings)
        if kept.get("format") != _FORMAT["format"]:
            raise AlreadyExists(f"{folder.settings}: is not of a reproduction; give another folder (--output)")
        other = [
            f"{name} {kept.get(name)!s:.40}, here {value}" for name, value in wanted.items() if kept.get(name) != value
        ]
        if other and not force:
            raise AlreadyExists(
                f"{folder.path}: holds a reproduction with other settings ({'; '.join(other)}); give another folder"
                " (--output), or replace it with force (--force)"
            )
    elif folder.path.is_dir() and any(each.name != "trainings" for each in folder.path.iterdir()):
        raise AlreadyExists(f"{folder.path}: is there already and holds no reproduction; give another (--output)")
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        check_writable(folder.path)
    except OSError as error:
        raise InvalidInput(f"{folder.path}: cannot be written to ({error.strerror}); give another (--output)") from None
    if force:
        _forget(folder)
    write_file(folder.settings, _text({**_FORMAT, **wanted}))
    return folder


def _wanted(settings: Settings) -> Json:
    """What every result in a folder shares; the trainings behind a result stand in it."""
    return {"episodes": settings.episodes, "version": __version__}


def _forget(folder: ReproductionFolder) -> None:
    """Delete every result; figures and data are replaced as they are made again."""
    for item in ITEMS:
        folder.result(item.name).unlink(missing_ok=True)


def write_item(folder: ReproductionFolder, item: Item, made: Made, more: Mapping[str, Any]) -> Json:
    """Write figures and data of an item, then its result, which makes them count; gives the result."""
    place = folder.path / item.name
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise InvalidInput(f"{place}: is no plain folder; move it away")
    place.mkdir(exist_ok=True)
    for drawn in made.figures:
        for ending in ENDINGS:
            file = folder.figure(item.name, drawn.stem, ending)
            write_output(file, picture_bytes(drawn.figure, file), force=True)
    for stem, text in (made.data or {}).items():
        write_output(place / f"{stem}.csv", text.encode(), force=True)
    keep_episodes(place, made.episodes)
    result = item_json(item, made, more)
    write_output(folder.result(item.name), _text(result), force=True)
    return result


def item_json(item: Item, made: Made, more: Mapping[str, Any]) -> Json:
    """An item and what became of it as plain data."""
    return {
        "name": item.name,
        "labels": list(item.labels),
        "title": item.title,
        "what": item.what,
        **more,
        "verdict": made.verdict.to_json(),
        "comparisons": [verdict.to_json() for verdict in made.verdicts],
        "parameters": [{"name": p.name, "value": p.value, "origin": p.origin} for p in made.parameters],
        "tables": [table.to_json() for table in made.tables],
        "figures": [{"stem": each.stem, "title": each.title, "text": each.text} for each in made.figures],
        "data": sorted(f"{stem}.csv" for stem in made.data or {}),
        "notes": list(made.notes),
    }


def read_results(folder: ReproductionFolder) -> list[Json]:
    """The results that are there, in the order of the paper; raises ``InvalidInput`` for one that is damaged."""
    return [read_result(folder, item) for item in ITEMS if folder.result(item.name).is_file()]


def read_result(folder: ReproductionFolder, item: Item) -> Json:
    """The result of an item that was made; raises ``InvalidInput`` for one that is damaged, or another item's."""
    file = folder.result(item.name)
    content = checked_result(read_object(file), str(file))
    if content["name"] != item.name:
        raise _damaged(f"{file}: name")
    if any(Path(name).name != name for name in content["data"]):
        raise _damaged(f"{file}: data")
    compared = [Verdict(**each) for each in content["comparisons"]]
    if any(each.outcome not in OUTCOMES for each in compared):
        raise _damaged(f"{file}: comparisons")
    if content["verdict"] != summarise_verdicts(compared).to_json():
        raise _damaged(f"{file}: verdict")
    if type(content.get("episodes", 2)) is not int:
        raise _damaged(f"{file}: episodes")
    return content


_TEXT, _TEXTS, _ROWS = TypeAdapter(str), TypeAdapter(list[str]), TypeAdapter(list[list[str]])
_VERDICT = {"what": _TEXT, "outcome": _TEXT, "because": _TEXT}
_PARTS: dict[str, dict[str, TypeAdapter[Any]]] = {  # of a result, each a list of such objects
    "comparisons": _VERDICT,
    "parameters": {"name": _TEXT, "value": _TEXT, "origin": _TEXT},
    "tables": {"title": _TEXT, "head": _TEXTS, "rows": _ROWS, "note": _TEXT},
    "figures": {"stem": _TEXT, "title": _TEXT, "text": _TEXT},
}
_WHOLE: dict[str, TypeAdapter[Any]] = {
    **dict.fromkeys(("name", "title", "what", "made_utc", "machine"), _TEXT),
    **dict.fromkeys(("labels", "data", "notes", "trained"), _TEXTS),
    "processor_s": TypeAdapter(float),
    "verdict": TypeAdapter(dict[str, str]),
    **dict.fromkeys(_PARTS, TypeAdapter(list[dict[str, Any]])),
}


def checked_result(content: Json, where: str) -> Json:
    """The same result; raises ``InvalidInput`` where what pages show is not there or of another kind."""
    _check_keys(content, _WHOLE, where)
    _check_keys(content["verdict"], _VERDICT, f"{where}: verdict")
    for name, keys in _PARTS.items():
        for each in content[name]:
            _check_keys(each, keys, f"{where}: {name}")
    for each in content["tables"]:
        if {len(row) for row in each["rows"]} - {len(each["head"])} or not each["head"]:
            raise _damaged(f"{where}: tables: rows")
    return content


def _check_keys(content: Json, keys: Mapping[str, TypeAdapter[Any]], where: str) -> None:
    for key, kind in keys.items():
        try:
            kind.validate_python(content.get(key), strict=True)
        except ValidationError:
            raise _damaged(f"{where}: {key}") from None


def _damaged(where: str) -> InvalidInput:
    return InvalidInput(f"{where}: is not what a reproduction writes; make it again (--force)")


def read_figure(folder: ReproductionFolder, name: str, stem: str, ending: str) -> bytes:
    """A figure that was written; raises ``InvalidInput`` where it is not there."""
    return read_plain(folder.figure(name, stem, ending), _LIMIT_BYTES)


def _text(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


# The page of a reproduction: one HTML file that holds its figures and loads nothing from anywhere.

TITLE = "The paper, made again"
_LEAD = (
    " of How to Brake? Ethical Emergency Braking with Deep Reinforcement Learning, with the"
    " paper's numbers and statements. Every verdict is computed: a number agrees where it is within the chance between"
    f" two lists of worlds or {100.0 * TOLERANCE:g} % of what is printed, is undecided where that chance alone makes"
    f" more than {100.0 * WIDE:g} %, and cannot agree where a bound that holds for every strategy excludes it."
    " Statements are those of the paper's text; its figures hold no printed numbers."
)
_OVERVIEW = "Overview"
_LOAD = r", load [0-9.]+"  # of the machine, which differs from item to item
_INTERVAL = re.compile(r"(.*) \[([^][]*)\]")
_NUMBER = re.compile(r"[-+−]?\d[\d,.]*( ?%)?|–|")


def render_page(folder: ReproductionFolder, results: Sequence[Json]) -> str:
    """The page as HTML; whatever the results say is shown as text.

    Raises ``InvalidInput`` for a figure that is not there or holds more than a figure of ours does.
    """
    _, *names = anchors([_OVERVIEW, *(result["title"] for result in results)])
    rows = [
        [Markup('<a href="#{}">{}</a>').format(name, shown(result["title"])), _verdict(result["verdict"])]
        for name, result in zip(names, results, strict=True)
    ]
    told = Markup("<p>Made by <code>{}</code> ({}).</p>\n").format(shown(command_of(results)), shown(made_in(results)))
    few = [paragraph(text, "note") for text in (few_worlds(results),) if text]
    body = [Part(told), *few, table(["Item", "Verdict"], rows, caption="Verdict on each item")]
    sections = [Section(_OVERVIEW, body), *(_section(folder, result) for result in results)]
    return page(TITLE, sections, lead=lead_of(results))


def lead_of(results: Sequence[Json]) -> str:
    """What a page of these results is about."""
    if len(results) == len(ITEMS):
        return f"Every figure and table{_LEAD}"
    return f"{len(results)} of the {len(ITEMS)} items{_LEAD}"


def command_of(results: Sequence[Json]) -> str:
    """The command that makes these results."""
    names = [] if len(results) == len(ITEMS) else [result["name"] for result in results]
    full = any(result.get("mode") == FULL for result in results)
    most = _most_worlds(results)
    few = [] if most is None else ["--episodes", str(most)]
    return " ".join(["ethbrake reproduce", *names, "--full" if full else "--quick", *few])


def made_in(results: Sequence[Json]) -> str:
    """Dates, machines with versions, and processor time of these results."""
    machines = (f"{each['made_utc'][:10]}, {re.sub(_LOAD, '', each['machine'])}" for each in results)
    seconds = sum(each["processor_s"] for each in results)
    return f"{'; '.join(dict.fromkeys(machines))}; {seconds:.0f} s of one core without the trainings"


def few_worlds(results: Sequence[Json]) -> str:
    """That lists are shorter than the paper's, as a sentence; empty where they are not, or where nobody noted it."""
    most = _most_worlds(results)
    return (
        ""
        if most is None
        else f"At most {most:,} worlds of each list are driven here; the paper has {MOST_EPISODES:,}."
    )


def _most_worlds(results: Sequence[Json]) -> int | None:
    """The most worlds of any list, where that is fewer than the paper's."""
    most = max((result.get("episodes", MOST_EPISODES) for result in results), default=MOST_EPISODES)
    return most if most < MOST_EPISODES else None


def _section(folder: ReproductionFolder, result: Json) -> Section:
    body: list[str | Part] = [result["what"], _account(result), *result["notes"]]
    body += [_figure(folder, result["name"], each) for each in result["figures"]]
    played = kept_player(folder.path / result["name"])
    body += [heading("Episodes"), played] if played else []
    for each in result["tables"]:
        body.append(table(each["head"], _rows(each["rows"]), caption=each["title"]))
        body += [paragraph(each["note"], "quiet")] if each["note"] else []
    compared = [[each["what"], _verdict(each)] for each in result["comparisons"]]
    comparisons = table(["What", "Verdict"], compared, caption="Comparisons with the paper")
    body.append(opened(f"Comparisons: {len(compared)}", [comparisons]))
    rows = [[p["name"], Cell(p["value"], words=True), Cell(p["origin"], words=True)] for p in result["parameters"]]
    parameters = table(["Parameter", "Value", "Origin"], rows, caption="What shapes the item")
    body.append(opened(f"Parameters: {len(rows)}", [parameters]))
    return Section(result["title"], body)


def _account(result: Json) -> Part:
    """Verdict, labels of the paper, and where the data are."""
    code, link = Markup("<code>{}</code>"), Markup('<a href="./{}/{}">{}</a>')
    labels = [code.format(shown(label)) for label in result["labels"]]
    name = result["name"]
    data = [link.format(quote(name, ""), quote(file, ""), shown(f"{name}/{file}")) for file in result["data"]]
    found = {
        "Verdict": _outcome(result["verdict"]["outcome"]),
        "Because": result["verdict"]["because"],
        "In the paper's source": Markup(", ").join(labels),
        "Data": Markup(", ").join(data),
    }
    return facts({name: value for name, value in found.items() if value})


def _figure(folder: ReproductionFolder, name: str, each: Json) -> Part:
    svg = read_figure(folder, name, each["stem"], ".svg")
    return kept_drawing(svg, each["title"], each["text"], str(folder.figure(name, each["stem"], ".svg")))


def _verdict(verdict: Json) -> Cell:
    """The outcome, and the numbers that it follows from below it."""
    return Cell(_outcome(verdict["outcome"]), verdict["because"], words=True)


def _outcome(outcome: str) -> Markup:
    """The word of a verdict, with a sign and a colour where it is one of ours."""
    kind = outcome.replace(" ", "-") if outcome in OUTCOMES else ""
    return Markup('<span class="outcome {}">{}</span>').format(kind, shown(outcome))


def _rows(rows: Sequence[Sequence[str]]) -> list[list[str | Cell]]:
    """Rows of a page's table: intervals below their values, and columns of more than numbers as words."""
    split = [[_cell(text) for text in row] for row in rows]
    words = [not all(_NUMBER.fullmatch(str(cell.value)) for cell in column) for column in zip(*split, strict=True)]
    return [
        [row[0], *(cell._replace(words=wordy) for cell, wordy in zip(cells[1:], words[1:], strict=True))]
        for row, cells in zip(rows, split, strict=True)
    ]


def _cell(text: str) -> Cell:
    """A value, and its interval below it."""
    match = _INTERVAL.fullmatch(text)
    return Cell(match[1], match[2]) if match else Cell(text)


# A reproduction: train what is asked for, make item after item, and keep the page up to date as they are finished.


def tell_cost(items: Sequence[Item], settings: Settings) -> str:
    """What is left to do and about how long it takes, in one line."""
    wanted = _groups(items) if settings.mode == FULL else set()
    training_s = seconds_left(settings.folder, wanted)
    told = f"to do: {count_of(len(items), 'item')}, at most about {sum(item.most_s for item in items)} s of one core"
    return f"{told}; trainings before them about {training_s / 60.0:.0f} min of one core" if wanted else told


def reproduce(items: Sequence[Item], settings: Settings, *, force: bool = False) -> tuple[list[Json], bool]:
    """Make the items; gives every result that the folder then holds, and whether nothing stopped the trainings.

    Items that need no training come first. One whose result is there, with the same trainings behind it, is kept. After
    each item the page is written anew. Ctrl-C during a training ends all trainings, and the items are made of those
    that are finished; a second one stops at once. Raises what ``open_folder`` raises.
    """
    folder, finished = open_folder(settings, force=force), True
    for item in sorted(items, key=lambda each: len(each.trained) if settings.mode == FULL else 0):
        if settings.mode == FULL and finished:
            finished = train_groups(settings.folder, item.trained, settings.tell)
        make_item(folder, item, settings)
    return read_results(folder), finished


def make_item(folder: ReproductionFolder, item: Item, settings: Settings) -> Json:
    """Make one item, or keep it, and bring the page up to date."""
    trained = trained_names(settings.folder, item.trained) if settings.mode == FULL else []
    kept = _kept(folder, item, trained)
    if kept is not None:
        return kept
    started = time.process_time()
    made = item.make(settings)
    more = {
        "mode": settings.mode,
        "episodes": settings.episodes,
        "trained": trained,
        "processor_s": round(time.process_time() - started, 1),
        "made_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": settings.machine,
    }
    result = write_item(folder, item, made, more)
    write_file(folder.page, render_page(folder, read_results(folder)).encode())
    return result


def _kept(folder: ReproductionFolder, item: Item, trained: list[str]) -> Json | None:
    """The result that is there already, if the same trainings stand behind it."""
    if not folder.result(item.name).is_file():
        return None
    content = read_result(folder, item)
    return content if content.get("trained") == trained else None


def _groups(items: Sequence[Item]) -> set[str]:
    return {group for item in items for group in item.trained}


# docs/reproduction.md: the results of a reproduction as Markdown, with its figures and its data beside it.

FIGURES, PREFIX = "figures", "reproduction-"  # of the figures beside the page
_WIDTH = 99  # characters of a line
_LONG_TABLE = 12  # rows
_PLACES = "--output runs/reproduction --docs docs/reproduction.md"


def check_docs(file: Path) -> None:
    """Raise ``InvalidInput`` for a page whose name does not end in ``.md``, or that cannot be written."""
    if file.suffix != ".md":
        raise InvalidInput(f"{file}: must end in .md")
    check_target(file, force=True)


def write_docs(file: Path, folder: ReproductionFolder, results: Sequence[Json]) -> None:
    """Write the page, the results as ``.json`` beside it, and the figures into ``figures/``; all are replaced.

    Raises as ``check_docs``.
    """
    check_docs(file)
    figures = file.parent / FIGURES
    figures.mkdir(exist_ok=True)
    for result in results:
        for each in result["figures"]:
            data = read_figure(folder, result["name"], each["stem"], ".svg")
            write_output(figures / f"{PREFIX}{each['stem']}.svg", data, force=True)
    content = json.dumps(list(results), indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_output(file.with_suffix(".json"), content.encode(), force=True)
    write_output(file, docs_page(results).encode(), force=True)


def docs_page(results: Sequence[Json]) -> str:
    """The page of these results."""
    few = few_worlds(results)
    blocks = [
        "# The paper, made again",
        "What comes out where the paper's experiments are made again, and where it cannot?",
        _wrapped(lead_of(results)),
        _wrapped(f"Made by `{command_of(results)} {_PLACES}` ({_escaped(made_in(results))})."),
        _wrapped(
            "The page, its figures and `reproduction.json`, which holds the same as data, are written by that command"
            " and not by hand; `ethbrake reproduce` makes them again without training. [The paper, line by line]"
            "(paper.md) has the account of every equation."
        ),
        *([_wrapped(few)] if few else []),
        "## Overview",
        _table(
            ("Item", "Verdict", "Because"),
            [(f"[{_escaped(each['title'])}](#{_escaped(each['name'])})", each["verdict"]["outcome"],
              _escaped(each["verdict"]["because"])) for each in results],
        ),
        *(block for each in results for block in _item(each)),
    ]  # fmt: skip
    return "\n\n".join(blocks) + "\n"


def _item(result: Json) -> list[str]:
    """The section of one item."""
    labels = ", ".join(_escaped(label) for label in result["labels"])
    what = f"**{_escaped(result['title'])}**. {_escaped(result['what'])}"
    blocks = [f"## {_escaped(result['name'])}", _wrapped(f"{what} ({labels})" if labels else what)]
    blocks.append(_wrapped(f"**{_escaped(result['verdict']['outcome'])}**: {_escaped(result['verdict']['because'])}"))
    blocks += [_wrapped(_escaped(note)) for note in result["notes"]]
    for each in result["figures"]:
        file = f"{FIGURES}/{PREFIX}{checked_stem(each['stem'])}.svg"
        blocks.append(f"![{_escaped(each['title'])}. {_escaped(each['text'])}]({file})")
    for part in result["tables"]:
        blocks += [f"### {_escaped(part['title'])}", _texts(part["head"], part["rows"])]
        blocks += [_wrapped(_escaped(part["note"]))] if part["note"] else []
    rows = [(each["what"], each["outcome"], each["because"]) for each in result["comparisons"]]
    blocks += ["### Comparisons with the paper", _texts(("What", "Verdict", "Because"), rows)]
    rows = [(each["name"], each["value"], each["origin"]) for each in result["parameters"]]
    return [*blocks, "### Parameters", _texts(("Parameter", "Value", "Origin"), rows)]


def _texts(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts, folded where it is long."""
    table = _table([_escaped(cell) for cell in head], [[_escaped(cell) for cell in row] for row in rows])
    if len(rows) <= _LONG_TABLE:
        return table
    return f"<details>\n<summary>{len(rows)} rows</summary>\n\n{table}\n\n</details>"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose cells are Markdown already."""
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))


def _wrapped(text: str) -> str:
    """A paragraph in lines of the pages' width; no line of it begins a list or a heading."""
    lines = textwrap.wrap(text, _WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join(re.sub(r"^(?=[-+#>] )", r"\\", line) for line in lines)


def _escaped(text: str) -> str:
    """Text that is no markup: what would be is escaped."""
    plain = plain_text(text, keep="\u00a0").replace("<", "&lt;")
    return re.sub(r"([\\|*_`])", r"\\\1", plain).replace("](", "]\\(")
