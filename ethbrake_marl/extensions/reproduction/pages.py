"""Output of a reproduction: one self-contained HTML page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from ethbrake_marl.extensions.report.page import Page, Part, Section, shown
from ethbrake_marl.extensions.reproduction.folder import LIMIT_BYTES, Result
from ethbrake_marl.extensions.reproduction.items import ITEMS
from ethbrake_marl.extensions.reproduction.verdicts import HOW_JUDGED, MOST_EPISODES
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.sheet import Column, Sheet, Shown

_TITLE = "The paper, made again"

_PAPER = "How to Brake? Ethical Emergency Braking with Deep Reinforcement Learning"

_LEAD = f" of {_PAPER}, with the paper's numbers and statements. {HOW_JUDGED}"

_NUMERAL = re.compile(r"[-+−]?\d[\d,.]*( ?%)?|–|")


def _account(results: Sequence[Result]) -> tuple[str, str, str, list[str]]:
    """Return the page's first sentence, the command line, the origin of the results, and remarks.

    The origin states dates, machines and processor time. There is one remark if the results use fewer worlds than the
    paper, otherwise none.
    """
    every = len(results) == len(ITEMS)
    most = max((result.episodes for result in results), default=MOST_EPISODES)
    fewer = most < MOST_EPISODES
    names = [] if every else [result.name for result in results]
    mode = "--full" if any(result.mode == "full" for result in results) else "--quick"
    command = ["ethbrake reproduce", *names, mode, *(["--episodes", str(most)] if fewer else [])]
    unloaded = [
        re.sub(r", load [0-9.]+", "", each.machine) for each in results
    ]  # without the load, which differs between items
    machines = (f"{each.made_utc[:10]}, {machine}" for each, machine in zip(results, unloaded, strict=True))
    seconds = sum(each.processor_s for each in results)
    return (
        f"Every figure and table{_LEAD}" if every else f"{len(results)} of the {len(ITEMS)} items{_LEAD}",
        " ".join(command),
        f"{'; '.join(dict.fromkeys(machines))}; {seconds:.0f} s of one core without the trainings",
        [f"At most {most:,} worlds of each list are driven here; the paper has {MOST_EPISODES:,}."] if fewer else [],
    )


def render_page(folder: Path, results: Sequence[Result]) -> str:
    """Return the page with all results as HTML text. ``folder`` contains their figures.

    Raises ``InvalidInput`` if a figure is missing.
    """
    lead, command, count, few = _account(results)
    _, *names = Page.anchors(["Overview", *(result.title for result in results)])
    link = Markup('<a href="#{}">{}</a>')
    rows = [
        [Shown(link.format(name, shown(each.title))), Shown(_outcome(each.verdict.outcome), each.verdict.because)]
        for name, each in zip(names, results, strict=True)
    ]
    overview = [
        Part(Markup("<p>Made by <code>{}</code> ({}).</p>\n").format(shown(command), shown(count))),
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
    facts = Part.facts({name: value for name, value in account.items() if value})
    body: list[str | Part] = [result.what, facts, *result.notes]
    for drawn in result.figures:
        picture = read_plain(folder / result.name / f"{drawn.stem}.svg", LIMIT_BYTES)
        body.append(Part.drawing(picture, drawn.title, drawn.text))
    for item in ITEMS:
        if item.name == result.name and item.play is not None:
            body += [Part.heading("Episodes"), item.play()]
    for each in result.tables:
        words = [not all(_NUMERAL.fullmatch(value) for value, _ in column) for column in zip(*each.rows, strict=True)]
        columns = [
            Column(name, text=wordy) for name, wordy in zip(each.head, words or [False] * len(each.head), strict=True)
        ]
        body.append(Part.table(Sheet(each.title, columns, [[row[0].in_words, *row[1:]] for row in each.rows])))
        body += [Part.paragraph(each.note, "quiet")] if each.note else []
    compared = [[each.what, Shown(_outcome(each.outcome), each.because)] for each in result.comparisons]
    comparisons = Part.table(Sheet("Comparisons with the paper", ["What", "Verdict"], compared))
    shaped = [[each.name, each.value, each.origin] for each in result.parameters]
    parameters = Part.table(Sheet("What shapes the item", ["Parameter", "Value", "Origin"], shaped))
    rest = (
        Part.opened(f"Comparisons: {len(compared)}", [comparisons]),
        Part.opened(f"Parameters: {len(shaped)}", [parameters]),
    )
    return Section(result.title, [*body, *rest])


def _outcome(word: str) -> Markup:
    """Return the outcome of a verdict, such as "agrees", as HTML with a symbol and a colour."""
    return Markup('<span class="outcome {}">{}</span>').format(word.replace(" ", "-"), word)
