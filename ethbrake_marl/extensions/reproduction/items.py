"""Reproduce the paper's figures and tables, and write them to a folder."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ethbrake_marl import __version__
from ethbrake_marl.errors import count_of, unknown_name
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.reproduction.curves import reproduce_delays, reproduce_distance
from ethbrake_marl.extensions.reproduction.made import PAPER_EPISODES, DrawnFigure, Item, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.tables import reproduce_hybrid_table, reproduce_random_table
from ethbrake_marl.extensions.reproduction.trajectories import reproduce_accelerations, reproduce_trajectories
from ethbrake_marl.extensions.reproduction.verdicts import (
    Judged,
    count_sheet,
    judge_sentences,
    paper_texts,
    recorded,
    sentences_sheet,
)
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.files.store import check_folder, write_output
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.progress import Progress


def show_recorded(settings: ReproductionSettings) -> Made:
    """Sentences whose results were measured once (``recorded.yaml``)."""
    return Made(notes=[f"Recorded: {recorded()['made by']}."])


ITEMS = (
    Item(
        "random-table", ("Table:Random",), "Four strategies in 10,000 random episodes",
        "Collisions and harm of the non-ethical strategy, E-V2X-BM and the hybrids of SAC and PPO; the paper's two"
        " contributions.", reproduce_random_table, 55,
    ),
    Item(
        "hybrid-table", ("Table:hybrid",), "E-V2X-BM, DRL and hybrid in 5,000 episodes",
        "Collisions and harm of E-V2X-BM, of a policy that has not converged, and of the hybrid.",
        reproduce_hybrid_table, 15,
    ),
    Item(
        "learning-curves", ("fig:ppo_sac_high_latency", "fig:ppo_sac_low_latency"), "Learning curves",
        "Returns of PPO and SAC in training under large and small communication delays.", show_recorded, 0,
    ),
    Item(
        "harm-distance", ("Fig:Harm-ivds", "Fig:hybrid illu"), "Harm over total distance",
        "Harm of the non-ethical strategy, E-V2X-BM, SAC, PPO and their hybrids against the sum of both gaps.",
        reproduce_distance, 25,
    ),
    Item(
        "harm-delays", ("Fig:harm-delay",), "Harm at three delays",
        "Harm of the four strategies at three communication delays, gaps of 7 m.", reproduce_delays, 10,
    ),
    Item(
        "trajectories", ("Fig:pic5sim",), "Trajectories of Scenarios 1 and 2",
        "Positions of the three vehicles under PPO and SAC.", reproduce_trajectories, 2,
    ),
    Item(
        "accelerations", ("Fig:pic5act",), "Acceleration profiles of Scenarios 1 and 2",
        "Commands of Vehicle 2 under PPO and SAC.", reproduce_accelerations, 2,
    ),
    Item(
        "elsewhere", (), "What the paper says in passing",
        "Sentences of which other pages of this project have the numbers.", show_recorded, 0,
    ),
)  # fmt: skip

RESULTS_FILE = "README.md"


def choose_items(names: Sequence[str]) -> list[Item]:
    items_by_name = {item.name: item for item in ITEMS}
    for name in names:
        if name not in items_by_name:
            raise unknown_name("item", name, items_by_name)
    return [item for item in ITEMS if not names or item.name in names]


def cost(items: Sequence[Item]) -> str:
    seconds = sum(item.most_s for item in items)
    return f"to do: {count_of(len(items), 'item')}, at most about {seconds:.0f} s of one core"


def reproduce(
    settings: ReproductionSettings, items: Sequence[Item], machine: str, *, force: bool = False
) -> dict[Item, Made]:
    """``machine``: description of the computer, for the page. Raises ``AlreadyExists`` if the folder has results and
    ``force`` is false.
    """
    folder, results = settings.folder, {}
    check_folder(folder, (RESULTS_FILE,), force=force)
    for number, item in enumerate(items):
        settings.tell(Progress(f"items: {item.name}", number, len(items)))
        results[item] = result = item.make(settings)
        write_item(folder / item.name, result.sheets, result.figures)
    write_item(folder, [sentences_sheet(judged(results))])
    today = datetime.now(UTC).date().isoformat()
    made_by = (
        f"`{command_line(settings, items)}` on {today} ({machine}; version {__version__}, physics {physics_digest()})"
    )
    write_output(folder / RESULTS_FILE, page(made_by, results).encode(), force=force)
    return results


def command_line(settings: ReproductionSettings, items: Sequence[Item]) -> str:
    names = [item.name for item in items] if len(items) < len(ITEMS) else []
    limit = ["--episodes", str(settings.episodes)] if settings.episodes < PAPER_EPISODES else []
    return shlex.join(["ethbrake", "reproduce", *names, *limit])


def write_item(place: Path, sheets: Sequence[Sheet], figures: Sequence[DrawnFigure] = ()) -> None:
    """SVG, PDF and CSV. Replaces existing files."""
    if figures or sheets:
        place.mkdir(parents=True, exist_ok=True)
    for picture in figures:
        for ending in (".svg", ".pdf"):
            write_picture(place / f"{picture.stem}{ending}", picture.figure, force=True)
    for sheet in sheets:
        stem = re.sub(r"[^a-z0-9]+", "-", sheet.title.lower()).strip("-") or "claims"
        write_output(place / f"{stem}.csv", sheet.csv().encode(), force=True)


def markdown(sheet: Sheet) -> str:
    """Without title and note."""
    rule = ["---" if column.text else "---:" for column in sheet.formats]
    rows = [
        [cell.in_words.replace("|", "\\|") for cell in row if not isinstance(cell, str)]
        for row in sheet.formatted_rows()
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in (sheet.headings, rule, *rows))


def plain_results(results: Mapping[Item, Made]) -> list[dict[str, Any]]:
    return [
        {
            "name": item.name,
            "labels": list(item.labels),
            "title": item.title,
            "claims": sentences_sheet(judged({item: result})).json(),
            "tables": {sheet.title: sheet.json() for sheet in result.sheets},
            "notes": list(result.notes),
            "version": __version__,
            "physics_digest": physics_digest(),
        }
        for item, result in results.items()
    ]


def judged(results: Mapping[Item, Made]) -> list[Judged]:
    return judge_sentences({item.name: {claim.name: claim for claim in made.claims} for item, made in results.items()})


def page(made_by: str, results: Mapping[Item, Made]) -> str:
    """``made_by``: command, date, computer and versions."""
    sentences = judged(results)
    lead = f"Numbers, statements and figures of the paper *How to Brake?*, and ours. Made by {made_by}."
    parts = ["# The paper, reproduced", lead, markdown(count_sheet(sentences))]
    parts += ["## The paper, sentence by sentence", paper_texts()["lead"], markdown(sentences_sheet(sentences))]
    for item, result in results.items():
        labels = f" In the paper's source: {', '.join(f'`{label}`' for label in item.labels)}." if item.labels else ""
        parts += [f"## {item.title}", f"{item.what}{labels} Command: `ethbrake reproduce {item.name}`.", *result.notes]
        parts += [f"![{picture.title}. {picture.text}]({item.name}/{picture.stem}.svg)" for picture in result.figures]
        for sheet in result.sheets:
            parts += [f"### {sheet.title}", markdown(sheet), *filter(None, [sheet.note])]
    return "\n\n".join(parts).replace("H*", r"H\*").replace("a*", r"a\*") + "\n"
