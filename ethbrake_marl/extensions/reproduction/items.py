"""Reproduce the paper's figures and tables, and write them to a folder."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from ethbrake_marl import __version__
from ethbrake_marl.errors import count_of, unknown_name
from ethbrake_marl.extensions.report.style import write_picture
from ethbrake_marl.extensions.reproduction.changes import reproduce_changes
from ethbrake_marl.extensions.reproduction.curves import reproduce_delays, reproduce_distance, reproduce_illustration
from ethbrake_marl.extensions.reproduction.learning import (
    DENSE,
    HIGH,
    LOW,
    RANDOM,
    STOPPED,
    check_trainings,
    reproduce_curves,
    seconds_left,
    train_groups,
    trained_runs,
)
from ethbrake_marl.extensions.reproduction.made import PAPER_EPISODES, DrawnFigure, Item, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.register import reproduce_gaps
from ethbrake_marl.extensions.reproduction.tables import reproduce_hybrid_table, reproduce_random_table
from ethbrake_marl.extensions.reproduction.trajectories import reproduce_accelerations, reproduce_trajectories
from ethbrake_marl.extensions.reproduction.verdicts import paper_texts, sentences_sheet
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.files.store import check_folder, write_output
from ethbrake_marl.motion.digest import physics_digest
from ethbrake_marl.progress import Progress

PROCESS = (RANDOM,)  # trainings that most items show, where there are some
PROCESS_S = 10.0  # processor time of an item for the policies of the paper's process

CHANGES = Item(
    "changes", (), "Which one change makes a claim true?",
    "Claims that differ here, the one change that makes each true or possible, and our numbers before and after.",
    reproduce_changes, 20,
)  # fmt: skip

ITEMS = (
    CHANGES,
    Item(
        "random-table", ("Table:Random",), "Four strategies in 10,000 random episodes",
        "Collisions, harm and its decrease of the non-ethical strategy, E-V2X-BM and the hybrids of SAC and PPO; the"
        " paper's two contributions.", reproduce_random_table, 40, PROCESS,
    ),
    Item(
        "hybrid-table", ("Table:hybrid",), "E-V2X-BM, DRL and hybrid in 5,000 episodes",
        "Collisions and harm of E-V2X-BM, of a policy that has not converged, and of the hybrid.",
        reproduce_hybrid_table, 5, (STOPPED,),
    ),
    Item(
        "learning-high", ("fig:ppo_sac_high_latency",), "Learning curves at high delay",
        "Returns of PPO and SAC in training under large communication delays.",
        partial(reproduce_curves, HIGH), 1, (HIGH, LOW),
    ),
    Item(
        "learning-low", ("fig:ppo_sac_low_latency",), "Learning curves at low delay",
        "Returns of PPO and SAC in training under small communication delays.",
        partial(reproduce_curves, LOW), 1, (HIGH, LOW, DENSE),
    ),
    Item(
        "harm-distance", ("Fig:Harm-ivds",), "Harm over total distance",
        "Harm of the non-ethical strategy, E-V2X-BM, SAC and PPO against the sum of both gaps.", reproduce_distance, 10,
        PROCESS,
    ),
    Item(
        "harm-delays", ("Fig:harm-delay",), "Harm at three delays",
        "Harm of the four strategies at three communication delays, gaps of 7 m.", reproduce_delays, 3, PROCESS,
    ),
    Item(
        "trajectories", ("Fig:pic5sim",), "Trajectories of Scenarios 1 and 2",
        "Positions of the three vehicles under PPO and SAC.", reproduce_trajectories, 2, PROCESS,
    ),
    Item(
        "accelerations", ("Fig:pic5act",), "Acceleration profiles of Scenarios 1 and 2",
        "Commands of Vehicle 2 under PPO and SAC.", reproduce_accelerations, 2, PROCESS,
    ),
    Item(
        "hybrid-illustration", ("Fig:hybrid illu",), "Illustration of the hybrid",
        "Harm of E-V2X-BM, of a policy that has not converged, and of the hybrid of both, against total distance.",
        reproduce_illustration, 8, (STOPPED,),
    ),
    Item(
        "gaps", (), "What the paper leaves open",
        "Every quantity that the paper leaves open, our default, and the random test with another value.",
        reproduce_gaps, 12,
    ),
)  # fmt: skip

RESULTS_FILE = "README.md"

QUICK_NOTE = "Rows that were not run need --full, or trainings of an earlier --full in the same folder."


def choose_items(names: Sequence[str]) -> list[Item]:
    items_by_name = {item.name: item for item in ITEMS}
    for name in names:
        if name not in items_by_name:
            raise unknown_name("item", name, items_by_name)
    return [item for item in ITEMS if not names or item.name in names]


def groups_of(settings: ReproductionSettings, items: Sequence[Item]) -> list[str]:
    every = (name for item in items for name in item.trained)
    return [name for name in dict.fromkeys(every) if settings.full or name == STOPPED]


def cost(settings: ReproductionSettings, items: Sequence[Item]) -> str:
    training_s = seconds_left(settings.folder, groups_of(settings, items))
    process_s = PROCESS_S if settings.full or trained_runs(settings.folder, RANDOM) else 0.0
    seconds = sum(item.most_s + process_s * (RANDOM in item.trained) for item in items)
    text = f"to do: {count_of(len(items), 'item')}, at most about {seconds:.0f} s of one core"
    return f"{text}; trainings before them about {training_s / 60.0:.1f} min of one core" if training_s else text


def reproduce(
    settings: ReproductionSettings, items: Sequence[Item], machine: str, *, force: bool = False
) -> dict[Item, Made] | None:
    """``machine``: description of the computer, for the page. Raises ``AlreadyExists`` if the folder has results and
    ``force`` is false, and ``InvalidInput`` if a training there is not as planned.
    """
    folder, results = settings.folder, {}
    check_folder(folder, (RESULTS_FILE,), force=force)
    check_trainings(folder)
    if not train_groups(settings, groups_of(settings, items)):
        return None
    for number, item in enumerate(items):
        settings.tell(Progress(f"items: {item.name}", number, len(items)))
        results[item] = result = item.make(settings)
        write_item(folder / item.name, result.sheets, result.figures)
    write_item(folder, [overview(results)])
    today = datetime.now(UTC).date().isoformat()
    made_by = (
        f"`{command_line(settings, items)}` on {today} ({machine}; version {__version__}, physics {physics_digest()})"
    )
    write_output(folder / RESULTS_FILE, page(made_by, results, settings).encode(), force=True)
    return results


def command_line(settings: ReproductionSettings, items: Sequence[Item]) -> str:
    names = [item.name for item in items] if len(items) < len(ITEMS) else []
    full = ["--full"] if settings.full else []
    limit = ["--episodes", str(settings.episodes)] if settings.episodes < PAPER_EPISODES else []
    return shlex.join(["ethbrake", "reproduce", *names, *full, *limit])


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
            "claims": overview({item: result}).json(),
            "tables": {sheet.title: sheet.json() for sheet in result.sheets},
            "notes": list(result.notes),
            "version": __version__,
            "physics_digest": physics_digest(),
        }
        for item, result in results.items()
    ]


def overview(results: Mapping[Item, Made]) -> Sheet:
    claims = {item.name: {claim.name: claim for claim in result.claims} for item, result in results.items()}
    return sentences_sheet(claims)


def page(made_by: str, results: Mapping[Item, Made], settings: ReproductionSettings) -> str:
    """``made_by``: command, date, computer and versions."""
    lead = f"Numbers, statements and figures of the paper *How to Brake?*, and ours. Made by {made_by}."
    parts = ["# The paper, reproduced", lead, *([] if settings.full else [QUICK_NOTE])]
    table = ["## The paper, sentence by sentence", paper_texts()["lead"], markdown(overview(results))]
    if CHANGES not in results:
        parts += table
    for item, result in results.items():
        labels = f" In the paper's source: {', '.join(f'`{label}`' for label in item.labels)}." if item.labels else ""
        parts += [f"## {item.title}", f"{item.what}{labels} Command: `ethbrake reproduce {item.name}`.", *result.notes]
        parts += [f"![{picture.title}. {picture.text}]({item.name}/{picture.stem}.svg)" for picture in result.figures]
        for sheet in result.sheets:
            parts += [f"### {sheet.title}", markdown(sheet), *filter(None, [sheet.note])]
        if item is CHANGES:
            parts += table
    return "\n\n".join(parts).replace("H*", r"H\*").replace("a*", r"a\*") + "\n"
