"""The folder of a reproduction: its settings, and for each item its result, figures and data, each written whole.

``ITEMS`` is the one table of what can be made; ``reproduce`` makes items and writes a folder and its page;
``write_docs`` shows the folder as Markdown.
"""

from __future__ import annotations

import base64
import json
import re
import textwrap
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple
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
from ethbrake_marl.studies.reproduction.item import (
    MOST_EPISODES,
    TOLERANCE,
    WIDE,
    Item,
    Made,
    Result,
    Settings,
    Table,
    Verdict,
    summarise_verdicts,
)
from ethbrake_marl.studies.reproduction.lists import (
    reproduce_delays,
    reproduce_distance,
    reproduce_gaps,
    reproduce_hybrid_table,
    reproduce_illustration,
    reproduce_random_table,
)
from ethbrake_marl.studies.reproduction.trainings import (
    CURVES,
    HIGH,
    LOW,
    OPEN,
    STOPPED,
    reproduce_curves,
    seconds_left,
    train_groups,
    trained_names,
)
from ethbrake_marl.studies.reproduction.two_scenarios import reproduce_accelerations, reproduce_trajectories

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

    @property
    def fits(self) -> bool:
        """Whether every world has an episode of every agent, whole pieces in each."""
        width, episodes = 8 * (1 + 3 * self.vehicles), [each for world in self.worlds for each in world.episodes]
        try:
            sizes = [len(base64.b64decode(episode.pieces, validate=True)) for episode in episodes]
        except ValueError:
            return False
        return (
            all(k < len(self.agents) for k in self.shown)
            and all(len(world.episodes) == len(self.agents) for world in self.worlds)
            and all(size > 0 and size % width == 0 for size in sizes)
            and all(i < self.vehicles for episode in episodes for i in episode.driven)
        )


def kept_player(folder: Path) -> Part | None:
    """The player of the episodes that are kept in the folder of an item; None where there are none.

    Raises ``InvalidInput`` for a file that does not hold what an item gives.
    """
    file = folder / EPISODES
    if not file.is_file():
        return None
    try:
        content = _Content.model_validate_json(read_plain(file, _EPISODE_LIMIT_BYTES))
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"])) or "no JSON"
        raise _damaged(file, shown(where)) from None
    if not content.fits:
        raise _damaged(file, "worlds")
    return player_of(_as_text(content.model_dump()))


def _as_text(value: Any) -> Any:
    """The same data with every text as a page shows it."""
    if isinstance(value, dict):
        return {key: _as_text(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_as_text(each) for each in value]
    return shown(value) if isinstance(value, str) else value


def _damaged(file: Path | str, where: str) -> InvalidInput:
    return InvalidInput(f"{file}: {where}: is not what a reproduction writes; make it again (--force)")


# The table of everything that ``ethbrake reproduce`` makes: one entry per figure and table of the paper.

_CURVES = tuple(group for groups in CURVES.values() for group in groups)

ITEMS = (
    Item(
        "learning-high",
        ("fig:ppo_sac_high_latency",),
        "Learning curves at high delay",
        "Returns of PPO and SAC in training under large communication delays.",
        partial(reproduce_curves, HIGH),
        10,
        _CURVES,
    ),
    Item(
        "learning-low",
        ("fig:ppo_sac_low_latency",),
        "Learning curves at low delay",
        "Returns of PPO and SAC in training under small communication delays.",
        partial(reproduce_curves, LOW),
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


# The folder: ``reproduction.json`` says what was asked for, ``index.html`` shows everything, each item has a folder.

PAGE = "index.html"
_SETTINGS, _RESULT = "reproduction.json", "result.json"
_FORMAT = {"format": "ethbrake-reproduction", "format_version": 1}
_LIMIT_BYTES = 16 << 20  # of a figure that is read again


def open_folder(settings: Settings, *, force: bool = False) -> None:
    """Make the folder, or go on in it.

    Raises ``InvalidInput`` for one that cannot be made or written to; ``AlreadyExists`` for one that holds something
    else, or a reproduction with other settings, unless ``force``, which replaces its results and keeps its trainings.
    """
    folder, wanted = settings.folder, {"episodes": settings.episodes, "version": __version__}
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InvalidInput(f"{folder}: is no plain folder; give another (--output)")
    if (folder / _SETTINGS).is_file():
        kept = read_object(folder / _SETTINGS)
        if kept.get("format") != _FORMAT["format"]:
            raise AlreadyExists(f"{folder / _SETTINGS}: is not of a reproduction; give another folder (--output)")
        other = [
            f"{name} {kept.get(name)!s:.40}, here {value}" for name, value in wanted.items() if kept.get(name) != value
        ]
        if other and not force:
            raise AlreadyExists(
                f"{folder}: holds a reproduction with other settings ({'; '.join(other)}); give another folder"
                " (--output), or replace it with force (--force)"
            )
    elif folder.is_dir() and any(each.name != "trainings" for each in folder.iterdir()):
        raise AlreadyExists(f"{folder}: is there already and holds no reproduction; give another (--output)")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
    except OSError as error:
        raise InvalidInput(f"{folder}: cannot be written to ({error.strerror}); give another (--output)") from None
    if force:
        for item in ITEMS:  # figures and data are replaced as they are made again
            (folder / item.name / _RESULT).unlink(missing_ok=True)
    write_file(folder / _SETTINGS, _text({**_FORMAT, **wanted}))


def _text(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def _write_item(place: Path, made: Made, result: Result) -> None:
    """Write figures and data of an item, then its result, which makes them count."""
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise InvalidInput(f"{place}: is no plain folder; move it away")
    place.mkdir(exist_ok=True)
    for drawn, figure in made.figures.items():
        for ending in (".svg", ".png"):
            file = place / f"{drawn.stem}{ending}"
            write_output(file, picture_bytes(figure, file), force=True)
    for stem, text in made.data.items():
        write_output(place / f"{stem}.csv", text.encode(), force=True)
    (place / EPISODES).unlink(missing_ok=True)
    if made.episodes is not None:
        write_output(place / EPISODES, json.dumps(made.episodes, allow_nan=False).encode(), force=True)
    write_output(place / _RESULT, _text(asdict(result)), force=True)


def read_results(folder: Path) -> list[Result]:
    """The results that are there, in the order of the paper.

    Raises ``InvalidInput`` for one that is damaged, or another item's.
    """
    return [result for item in ITEMS if (result := _read_result(folder, item)) is not None]


def _read_result(folder: Path, item: Item) -> Result | None:
    file = folder / item.name / _RESULT
    if not file.is_file():
        return None
    result = checked_result(read_object(file), file)
    if result.name != item.name:
        raise _damaged(file, "name")
    return result


def checked_result(content: Mapping[str, Any], where: Path | str) -> Result:
    """The result in a file; raises ``InvalidInput`` where what pages show is not there or of another kind."""
    try:
        result = TypeAdapter(Result).validate_json(json.dumps(content))
    except ValidationError as error:
        raise _damaged(where, ": ".join(map(str, error.errors()[0]["loc"]))) from None
    if any(Path(name).name != name for name in result.data):
        raise _damaged(where, "data")
    if any(
        not table.head or len(row) != len(table.head) for table in result.tables for row in [table.head, *table.rows]
    ):
        raise _damaged(where, "tables: rows")
    if result.verdict != summarise_verdicts(result.comparisons):
        raise _damaged(where, "verdict")
    return result


# A reproduction: train what is asked for, make item after item, and keep the page up to date as they are finished.


def tell_cost(items: Sequence[Item], settings: Settings) -> str:
    """What is left to do and about how long it takes, in one line."""
    wanted = {group for item in items for group in item.trained} if settings.mode == "full" else set()
    training_s = seconds_left(settings.folder, wanted)
    told = f"to do: {count_of(len(items), 'item')}, at most about {sum(item.most_s for item in items)} s of one core"
    return f"{told}; trainings before them about {training_s / 60.0:.0f} min of one core" if wanted else told


def reproduce(items: Sequence[Item], settings: Settings, *, force: bool = False) -> tuple[list[Result], bool]:
    """Make the items; gives every result that the folder then holds, and whether nothing stopped the trainings.

    Items that need no training come first. One whose result is there, with the same trainings behind it, is kept. After
    each item the page is written anew. Ctrl-C during a training ends all trainings, and the items are made of those
    that are finished; a second one stops at once. Raises what ``open_folder`` raises.
    """
    open_folder(settings, force=force)
    full, finished = settings.mode == "full", True
    for item in sorted(items, key=lambda each: len(each.trained) if full else 0):
        if full and finished:
            finished = train_groups(settings.folder, item.trained, settings.tell)
        trained = trained_names(settings.folder, item.trained) if full else []
        kept = _read_result(settings.folder, item)
        if kept is None or list(kept.trained) != trained:
            _make_item(item, settings, trained)
            write_file(settings.folder / PAGE, render_page(settings.folder, read_results(settings.folder)).encode())
    return read_results(settings.folder), finished


def _make_item(item: Item, settings: Settings, trained: Sequence[str]) -> None:
    started = time.process_time()
    made = item.make(settings)
    tables = [
        Table(
            each.title,
            each.headings,
            [[cell.in_words for cell in row] for row in each.shown() if not isinstance(row, str)],
            each.note,
        )
        for each in made.tables
    ]
    result = Result(
        name=item.name,
        labels=item.labels,
        title=item.title,
        what=item.what,
        mode=settings.mode,
        episodes=settings.episodes,
        trained=trained,
        processor_s=round(time.process_time() - started, 1),
        made_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=settings.machine,
        verdict=summarise_verdicts(made.verdicts),
        comparisons=made.verdicts,
        parameters=made.parameters,
        tables=tables,
        figures=list(made.figures),
        data=sorted(f"{stem}.csv" for stem in made.data),
        notes=made.notes,
    )
    _write_item(settings.folder / item.name, made, result)


# What every page of results tells.

_TITLE = "The paper, made again"
_LEAD = (
    " of How to Brake? Ethical Emergency Braking with Deep Reinforcement Learning, with the"
    " paper's numbers and statements. Every verdict is computed: a number agrees where it is within the chance between"
    f" two lists of worlds or {100.0 * TOLERANCE:g} % of what is printed, is undecided where that chance alone makes"
    f" more than {100.0 * WIDE:g} %, and cannot agree where a bound that holds for every strategy excludes it."
    " Statements are those of the paper's text; its figures hold no printed numbers."
)
_LOAD = r", load [0-9.]+"  # of the machine, which differs from item to item
_NUMBER = re.compile(r"[-+−]?\d[\d,.]*( ?%)?|–|")


class _Account(NamedTuple):
    """All results in a few sentences."""

    lead: str  # what a page of them is about
    command: str  # that makes them
    made: str  # dates, machines with versions, and processor time
    few: str  # that lists are shorter than the paper's; empty where they are not

    @classmethod
    def of(cls, results: Sequence[Result]) -> _Account:
        """Of these results."""
        every = len(results) == len(ITEMS)
        most = max((result.episodes for result in results), default=MOST_EPISODES)
        names = [] if every else [result.name for result in results]
        mode = "--full" if any(result.mode == "full" for result in results) else "--quick"
        fewer = ["--episodes", str(most)] if most < MOST_EPISODES else []
        machines = (f"{each.made_utc[:10]}, {re.sub(_LOAD, '', each.machine)}" for each in results)
        seconds = sum(each.processor_s for each in results)
        few = f"At most {most:,} worlds of each list are driven here; the paper has {MOST_EPISODES:,}."
        return cls(
            f"Every figure and table{_LEAD}" if every else f"{len(results)} of the {len(ITEMS)} items{_LEAD}",
            " ".join(["ethbrake reproduce", *names, mode, *fewer]),
            f"{'; '.join(dict.fromkeys(machines))}; {seconds:.0f} s of one core without the trainings",
            few if fewer else "",
        )


# The page of a reproduction: one HTML file that holds its figures and loads nothing from anywhere.


def render_page(folder: Path, results: Sequence[Result]) -> str:
    """The page as HTML; whatever the results say is shown as text.

    Raises ``InvalidInput`` for a figure that is not there or holds more than a figure of ours does.
    """
    account, (_, *names) = _Account.of(results), anchors(["Overview", *(result.title for result in results)])
    rows = [
        [Markup('<a href="#{}">{}</a>').format(name, shown(result.title)), _told(result.verdict)]
        for name, result in zip(names, results, strict=True)
    ]
    told = Markup("<p>Made by <code>{}</code> ({}).</p>\n").format(shown(account.command), shown(account.made))
    few = [paragraph(account.few, "note")] if account.few else []
    overview = Section("Overview", [Part(told), *few, table(["Item", "Verdict"], rows, caption="Verdict on each item")])
    return page(_TITLE, [overview, *(_section(folder / each.name, each) for each in results)], lead=account.lead)


def _section(place: Path, result: Result) -> Section:
    code, link = Markup("<code>{}</code>"), Markup('<a href="./{}/{}">{}</a>')
    data = [
        link.format(quote(result.name, ""), quote(file, ""), shown(f"{result.name}/{file}")) for file in result.data
    ]
    account = {
        "Verdict": _outcome(result.verdict),
        "Because": result.verdict.because,
        "In the paper's source": Markup(", ").join(code.format(shown(label)) for label in result.labels),
        "Data": Markup(", ").join(data),
    }
    body: list[str | Part] = [result.what, facts({name: value for name, value in account.items() if value})]
    body += result.notes
    for drawn in result.figures:
        file = place / f"{drawn.stem}.svg"
        body.append(kept_drawing(read_plain(file, _LIMIT_BYTES), drawn.title, drawn.text, str(file)))
    played = kept_player(place)
    body += [heading("Episodes"), played] if played else []
    for each in result.tables:
        body.append(table(each.head, _rows(each.rows), caption=each.title))
        body += [paragraph(each.note, "quiet")] if each.note else []
    compared = [[each.what, _told(each)] for each in result.comparisons]
    comparisons = table(["What", "Verdict"], compared, caption="Comparisons with the paper")
    rows = [[each.name, Cell(each.value, words=True), Cell(each.origin, words=True)] for each in result.parameters]
    parameters = table(["Parameter", "Value", "Origin"], rows, caption="What shapes the item")
    body += [opened(f"Comparisons: {len(compared)}", [comparisons]), opened(f"Parameters: {len(rows)}", [parameters])]
    return Section(result.title, body)


def _told(verdict: Verdict) -> Cell:
    """The outcome, and the numbers that it follows from below it."""
    return Cell(_outcome(verdict), verdict.because, words=True)


def _outcome(verdict: Verdict) -> Markup:
    """The word of a verdict, with a sign and a colour."""
    kind = verdict.outcome.replace(" ", "-")
    return Markup('<span class="outcome {}">{}</span>').format(kind, verdict.outcome)


def _rows(rows: Sequence[Sequence[str]]) -> list[list[str | Cell]]:
    """Rows of a page's table: intervals below their values, and columns of more than numbers as words."""
    split = [[re.fullmatch(r"(.*?)(?: \[([^][]*)\])?", text, re.DOTALL) for text in row] for row in rows]
    values = [[(found[1], found[2] or "") for found in row if found] for row in split]
    words = [not all(_NUMBER.fullmatch(value) for value, _ in column) for column in zip(*values, strict=True)]
    return [
        [row[0], *(Cell(*cell, words=wordy) for cell, wordy in zip(cells[1:], words[1:], strict=True))]
        for row, cells in zip(rows, values, strict=True)
    ]


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


def write_docs(file: Path, folder: Path, results: Sequence[Result]) -> None:
    """Write the page, the results as ``.json`` beside it, and the figures into ``figures/``; all are replaced.

    Raises as ``check_docs``.
    """
    check_docs(file)
    figures = file.parent / FIGURES
    figures.mkdir(exist_ok=True)
    for result in results:
        for drawn in result.figures:
            data = read_plain(folder / result.name / f"{drawn.stem}.svg", _LIMIT_BYTES)
            write_output(figures / f"{PREFIX}{drawn.stem}.svg", data, force=True)
    content = json.dumps([asdict(each) for each in results], indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_output(file.with_suffix(".json"), content.encode(), force=True)
    write_output(file, docs_page(results).encode(), force=True)


def docs_page(results: Sequence[Result]) -> str:
    """The page of these results."""
    account = _Account.of(results)
    verdicts = [
        (f"[{_escaped(each.title)}](#{_escaped(each.name)})", each.verdict.outcome, _escaped(each.verdict.because))
        for each in results
    ]
    blocks = [
        f"# {_TITLE}",
        "What comes out where the paper's experiments are made again, and where it cannot?",
        _wrapped(account.lead),
        _wrapped(f"Made by `{account.command} {_PLACES}` ({_escaped(account.made)})."),
        _wrapped(
            "The page, its figures and `reproduction.json`, which holds the same as data, are written by that command"
            " and not by hand; `ethbrake reproduce` makes them again without training. [The paper, line by line]"
            "(paper.md) has the account of every equation."
        ),
        *([_wrapped(account.few)] if account.few else []),
        "## Overview",
        _table(("Item", "Verdict", "Because"), verdicts),
        *(block for each in results for block in _item(each)),
    ]
    return "\n\n".join(blocks) + "\n"


def _item(result: Result) -> list[str]:
    """The section of one item."""
    labels = ", ".join(_escaped(label) for label in result.labels)
    what = f"**{_escaped(result.title)}**. {_escaped(result.what)}"
    blocks = [f"## {_escaped(result.name)}", _wrapped(f"{what} ({labels})" if labels else what)]
    blocks.append(_wrapped(f"**{result.verdict.outcome}**: {_escaped(result.verdict.because)}"))
    blocks += [_wrapped(_escaped(note)) for note in result.notes]
    for drawn in result.figures:
        blocks.append(f"![{_escaped(drawn.title)}. {_escaped(drawn.text)}]({FIGURES}/{PREFIX}{drawn.stem}.svg)")
    compared = [(each.what, each.outcome, each.because) for each in result.comparisons]
    found = [(each.name, each.value, each.origin) for each in result.parameters]
    for part in (
        *result.tables,
        Table("Comparisons with the paper", ("What", "Verdict", "Because"), compared),
        Table("Parameters", ("Parameter", "Value", "Origin"), found),
    ):
        head, *rows = [[_escaped(cell) for cell in row] for row in (part.head, *part.rows)]
        lines = _table(head, rows)
        if len(rows) > _LONG_TABLE:
            lines = f"<details>\n<summary>{len(rows)} rows</summary>\n\n{lines}\n\n</details>"
        blocks += [f"### {_escaped(part.title)}", lines, *([_wrapped(_escaped(part.note))] if part.note else [])]
    return blocks


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
