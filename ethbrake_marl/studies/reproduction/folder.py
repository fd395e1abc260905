"""A reproduction: items are made one by one into a folder, which a page shows, and ``docs/reproduction.md`` too."""

from __future__ import annotations

import json
import re
import textwrap
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup
from pydantic import TypeAdapter, ValidationError

from ethbrake_marl import __version__
from ethbrake_marl.errors import InvalidInput, count_of, plain_text, unknown_name
from ethbrake_marl.figures import write_picture
from ethbrake_marl.files.sheet import Column, Sheet, Shown
from ethbrake_marl.files.store import read_plain, write_file, write_output
from ethbrake_marl.learning import read_object
from ethbrake_marl.pages.page import Page, Part, Section, anchors, shown
from ethbrake_marl.studies.jobs import JobFolder
from ethbrake_marl.studies.reproduction.items import (
    HOW_JUDGED,
    ITEMS,
    MOST_EPISODES,
    Item,
    Result,
    Settings,
    Table,
    summarise_verdicts,
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
_FORMAT = {"format": "ethbrake-reproduction", "format_version": 2}
_LIMIT_BYTES = 16 << 20  # of a figure that is read again


def open_folder(settings: Settings, *, force: bool = False) -> JobFolder:
    """The folder, in which the same settings go on; with ``force`` its results go and its trainings stay.

    Raises ``InvalidInput`` for one that cannot be made or written to, or a reproduction with other settings unless
    ``force``; ``AlreadyExists`` for one that holds something else.
    """
    path, question = settings.folder, {"episodes": settings.episodes, "version": __version__}
    if path.is_symlink():
        raise InvalidInput(f"{path}: is no plain folder; give another (--output)")
    if force and (path / _SETTINGS).is_file() and read_object(path / _SETTINGS).get("format") == _FORMAT["format"]:
        for item in ITEMS:  # figures and data are replaced as they are made again
            (path / item.name / _RESULT).unlink(missing_ok=True)
        write_file(path / _SETTINGS, _text({**_FORMAT, **question}))
    advice = "give another folder (--output), or replace it with force (--force)"
    folder = JobFolder(
        path, "reproduction", question, record=_SETTINGS, more=_FORMAT, advice=advice, beside=("trainings",)
    )
    folder.check()
    return folder


def _text(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()


def read_results(folder: Path) -> list[Result]:
    """The results that are there, in the order of the paper.

    Raises ``InvalidInput`` for one that is damaged, or another item's.
    """
    files = {item.name: folder / item.name / _RESULT for item in ITEMS}
    return [checked_result(read_object(file), file, name) for name, file in files.items() if file.is_file()]


def checked_result(content: Mapping[str, Any], where: Path | str, name: str) -> Result:
    """The result in the file of an item.

    Raises ``InvalidInput`` where what pages show is not there or of another kind, or another item's.
    """
    wrong = ""
    try:
        result = TypeAdapter(Result).validate_json(json.dumps(content))
    except ValidationError as error:
        wrong = ": ".join(map(str, error.errors()[0]["loc"]))
    else:
        if result.name != name:
            wrong = "name"
        elif any(Path(file).name != file for file in result.data):
            wrong = "data"
        elif not all(
            each.head and len(row) == len(each.head) for each in result.tables for row in [each.head, *each.rows]
        ):
            wrong = "tables: rows"
        elif result.verdict != summarise_verdicts(result.comparisons):
            wrong = "verdict"
    if wrong:
        raise InvalidInput(f"{where}: {wrong}: is not what a reproduction writes; make it again (--force)")
    return result


def tell_cost(items: Sequence[Item], settings: Settings) -> str:
    """What is left to do and about how long it takes, in one line."""
    wanted = {group for item in items for group in item.trained} if settings.mode == "full" else set()
    told = f"to do: {count_of(len(items), 'item')}, at most about {sum(item.most_s for item in items)} s of one core"
    training_s = settings.seconds_left(wanted)
    return f"{told}; trainings before them about {training_s / 60.0:.0f} min of one core" if wanted else told


def reproduce(items: Sequence[Item], settings: Settings, *, force: bool = False) -> tuple[list[Result], bool]:
    """Make the items; gives every result that the folder then holds, and whether nothing stopped the trainings.

    Items that need no training come first. One whose result is there, with the same trainings behind it, is kept. After
    each item the page is written anew. Ctrl-C during a training ends all trainings, and the items are made of those
    that are finished; a second one stops at once. Raises what ``open_folder`` raises.
    """
    full, finished, folder = settings.mode == "full", True, settings.folder
    with open_folder(settings, force=force).work():
        for item in sorted(items, key=lambda each: len(each.trained) if full else 0):
            if full and finished:
                finished = settings.train(item.trained)
            trained = list(settings.trained(item.trained))
            kept = {result.name: list(result.trained) for result in read_results(folder)}
            if kept.get(item.name) != trained:
                _make_item(item, settings, trained)
                write_file(folder / PAGE, render_page(folder, read_results(folder)).encode())
        results = read_results(folder)
    if settings.docs is not None:
        write_docs(settings.docs, folder, results)
    return results, finished


def _make_item(item: Item, settings: Settings, trained: Sequence[str]) -> None:
    """Make an item, and write its figures and data, then its result, which makes them count."""
    place, started = settings.folder / item.name, time.process_time()
    made = item.make(settings)
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
        tables=[
            Table(each.title, each.headings, [row for row in each.shown() if not isinstance(row, str)], each.note)
            for each in made.tables
        ],
        figures=list(made.figures),
        data=sorted(f"{stem}.csv" for stem in made.data),
        notes=made.notes,
    )
    if place.is_symlink() or (place.exists() and not place.is_dir()):
        raise InvalidInput(f"{place}: is no plain folder; move it away")
    place.mkdir(exist_ok=True)
    for drawn, figure in made.figures.items():
        for ending in (".svg", ".png"):
            write_picture(place / f"{drawn.stem}{ending}", figure, force=True)
    for stem, text in made.data.items():
        write_output(place / f"{stem}.csv", text.encode(), force=True)
    write_output(place / _RESULT, _text(asdict(result)), force=True)


# The pages: one HTML file that holds its figures and loads nothing from anywhere, and Markdown with figures beside it.

_TITLE = "The paper, made again"
_PAPER = "How to Brake? Ethical Emergency Braking with Deep Reinforcement Learning"
_LEAD = f" of {_PAPER}, with the paper's numbers and statements. {HOW_JUDGED}"
_LOAD = r", load [0-9.]+"  # of the machine, which differs from item to item
_NUMBER = re.compile(r"[-+−]?\d[\d,.]*( ?%)?|–|")


def _account(results: Sequence[Result]) -> tuple[str, str, str, list[str]]:
    """What a page of these results is about; the command that makes them; when, where and in how much time they were.

    Then that lists are shorter than the paper's, where they are.
    """
    every = len(results) == len(ITEMS)
    most = max((result.episodes for result in results), default=MOST_EPISODES)
    fewer = most < MOST_EPISODES
    names = [] if every else [result.name for result in results]
    mode = "--full" if any(result.mode == "full" for result in results) else "--quick"
    command = ["ethbrake reproduce", *names, mode, *(["--episodes", str(most)] if fewer else [])]
    machines = (f"{each.made_utc[:10]}, {re.sub(_LOAD, '', each.machine)}" for each in results)
    seconds = sum(each.processor_s for each in results)
    return (
        f"Every figure and table{_LEAD}" if every else f"{len(results)} of the {len(ITEMS)} items{_LEAD}",
        " ".join(command),
        f"{'; '.join(dict.fromkeys(machines))}; {seconds:.0f} s of one core without the trainings",
        [f"At most {most:,} worlds of each list are driven here; the paper has {MOST_EPISODES:,}."] if fewer else [],
    )


def render_page(folder: Path, results: Sequence[Result]) -> str:
    """The page as HTML; whatever the results say is shown as text.

    Raises ``InvalidInput`` for a figure that is not there or holds more than a figure of ours does.
    """
    lead, command, made, few = _account(results)
    _, *names = anchors(["Overview", *(result.title for result in results)])
    link = Markup('<a href="#{}">{}</a>')
    rows = [
        [Shown(link.format(name, shown(each.title))), Shown(_outcome(each.verdict.outcome), each.verdict.because)]
        for name, each in zip(names, results, strict=True)
    ]
    overview = [
        Part(Markup("<p>Made by <code>{}</code> ({}).</p>\n").format(shown(command), shown(made))),
        *(Part.paragraph(text, "note") for text in few),
        Part.table(Sheet("Verdict on each item", ["Item", "Verdict"], rows)),
    ]
    return Page(_TITLE, [Section("Overview", overview), *(_section(folder, each) for each in results)], lead).html


def _section(folder: Path, result: Result) -> Section:
    code, link = Markup("<code>{}</code>"), Markup('<a href="./{}/{}">{}</a>')
    data = [
        link.format(quote(result.name, ""), quote(file, ""), shown(f"{result.name}/{file}")) for file in result.data
    ]
    account = {
        "Verdict": _outcome(result.verdict.outcome),
        "Because": result.verdict.because,
        "In the paper's source": Markup(", ").join(code.format(shown(label)) for label in result.labels),
        "Data": Markup(", ").join(data),
    }
    body: list[str | Part] = [result.what, Part.facts({name: value for name, value in account.items() if value})]
    body += result.notes
    for drawn in result.figures:
        file = folder / result.name / f"{drawn.stem}.svg"
        body.append(Part.drawing(read_plain(file, _LIMIT_BYTES), drawn.title, drawn.text, where=file))
    for item in ITEMS:
        if item.name == result.name and item.play is not None:
            body += [Part.heading("Episodes"), item.play()]
    for each in result.tables:
        words = [not all(_NUMBER.fullmatch(value) for value, _ in column) for column in zip(*each.rows, strict=True)]
        columns = [
            Column(name, text=wordy) for name, wordy in zip(each.head, words or [False] * len(each.head), strict=True)
        ]
        rows = [[row[0].in_words, *row[1:]] for row in each.rows]
        body.append(Part.table(Sheet(each.title, columns, rows)))
        body += [Part.paragraph(each.note, "quiet")] if each.note else []
    compared = [[each.what, Shown(_outcome(each.outcome), each.because)] for each in result.comparisons]
    comparisons = Part.table(Sheet("Comparisons with the paper", ["What", "Verdict"], compared))
    shaped = [[each.name, each.value, each.origin] for each in result.parameters]
    parameters = Part.table(Sheet("What shapes the item", ["Parameter", "Value", "Origin"], shaped))
    body.append(Part.opened(f"Comparisons: {len(compared)}", [comparisons]))
    body.append(Part.opened(f"Parameters: {len(shaped)}", [parameters]))
    return Section(result.title, body)


def _outcome(word: str) -> Markup:
    """The word of a verdict, with a sign and a colour."""
    return Markup('<span class="outcome {}">{}</span>').format(word.replace(" ", "-"), word)


FIGURES, PREFIX = "figures", "reproduction-"  # of the figures beside docs/reproduction.md
_WIDTH = 99  # characters of a line
_LONG_TABLE = 12  # rows
_PLACES = "--output runs/reproduction --docs docs/reproduction.md"


def write_docs(file: Path, folder: Path, results: Sequence[Result]) -> None:
    """Write the page, the results as ``.json`` beside it, and the figures into ``figures/``; all are replaced."""
    figures = file.parent / FIGURES
    figures.mkdir(exist_ok=True)
    for result in results:
        for drawn in result.figures:
            data = read_plain(folder / result.name / f"{drawn.stem}.svg", _LIMIT_BYTES)
            write_output(figures / f"{PREFIX}{drawn.stem}.svg", data, force=True)
    content = json.dumps([each.in_words() for each in results], indent=1, ensure_ascii=False, allow_nan=False) + "\n"
    write_output(file.with_suffix(".json"), content.encode(), force=True)
    write_output(file, docs_page(results).encode(), force=True)


def docs_page(results: Sequence[Result]) -> str:
    """The page of these results as Markdown."""
    lead, command, made, few = _account(results)
    verdicts = [
        (f"[{_escaped(each.title)}](#{_escaped(each.name)})", each.verdict.outcome, _escaped(each.verdict.because))
        for each in results
    ]
    blocks = [
        f"# {_TITLE}",
        "What comes out where the paper's experiments are made again, and where it cannot?",
        _wrapped(lead),
        _wrapped(f"Made by `{command} {_PLACES}` ({_escaped(made)})."),
        _wrapped(
            "The page, its figures and `reproduction.json`, which holds the same as data, are written by that command"
            " and not by hand; `ethbrake reproduce` makes them again without training. [The paper, line by line]"
            "(paper.md) has the account of every equation."
        ),
        *map(_wrapped, few),
        "## Overview",
        _table(("Item", "Verdict", "Because"), verdicts),
    ]
    for result in results:
        what = f"**{_escaped(result.title)}**. {_escaped(result.what)}"
        labels = f" ({', '.join(map(_escaped, result.labels))})" if result.labels else ""
        because = f"**{result.verdict.outcome}**: {_escaped(result.verdict.because)}"
        blocks += [f"## {_escaped(result.name)}", *map(_wrapped, (what + labels, because))]
        blocks += [_wrapped(_escaped(note)) for note in result.notes]
        for drawn in result.figures:
            blocks.append(f"![{_escaped(drawn.title)}. {_escaped(drawn.text)}]({FIGURES}/{PREFIX}{drawn.stem}.svg)")
        compared = [(each.what, each.outcome, each.because) for each in result.comparisons]
        found = [(each.name, each.value, each.origin) for each in result.parameters]
        tables: list[tuple[str, Sequence[str], Sequence[Sequence[str]], str]] = [
            *(
                (each.title, each.head, [[c.in_words for c in row] for row in each.rows], each.note)
                for each in result.tables
            ),
            ("Comparisons with the paper", ("What", "Verdict", "Because"), compared, ""),
            ("Parameters", ("Parameter", "Value", "Origin"), found, ""),
        ]
        for title, head, rows, note in tables:
            lines = _table([*map(_escaped, head)], [[*map(_escaped, row)] for row in rows])
            if len(rows) > _LONG_TABLE:
                lines = f"<details>\n<summary>{len(rows)} rows</summary>\n\n{lines}\n\n</details>"
            blocks += [f"### {_escaped(title)}", lines, *([_wrapped(_escaped(note))] if note else [])]
    return "\n\n".join(blocks) + "\n"


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
