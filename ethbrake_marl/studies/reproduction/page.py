"""The page of a reproduction: one HTML file that holds its figures and loads nothing from anywhere."""

from __future__ import annotations

import re
from collections.abc import Sequence
from urllib.parse import quote

from markupsafe import Markup

from ethbrake_marl.pages.frame import Part, Section, anchors, page, paragraph, shown
from ethbrake_marl.pages.parts import Cell, facts, heading, opened, table
from ethbrake_marl.pages.vector import kept_drawing
from ethbrake_marl.studies.reproduction.episodes import kept_player
from ethbrake_marl.studies.reproduction.folder import Json, ReproductionFolder, read_figure
from ethbrake_marl.studies.reproduction.item import FULL, MOST_EPISODES
from ethbrake_marl.studies.reproduction.items import ITEMS
from ethbrake_marl.studies.reproduction.verdicts import OUTCOMES, TOLERANCE, WIDE

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
