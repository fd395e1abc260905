"""Search the least harm of every world of a list, let agents improve on it, and save a table; or print shipped tables.

``python docs/studies/best_harm.py --scenario paper-random --episodes 1000 --output paper-random.npz`` searches a list.
With ``--output``, finished chunks are saved beside the file, and the same command continues after an interruption.
``--shipped`` prints proven and best known harm of every shipped table, and the gap between them.
"""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections.abc import Iterable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from ethbrake_marl.extensions.search.regret import Between
from ethbrake_marl.extensions.search.shipped import shipped_tables

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.search.best_harm import fold_episodes, search_list, task_problem
from ethbrake_marl.extensions.search.limits import Unproven, prove, unproven_because
from ethbrake_marl.extensions.search.tables import BestHarmTable
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.files.store import check_target
from ethbrake_marl.first_edition.agents.spec import split_specs
from ethbrake_marl.first_edition.evaluation.identity import result_identity
from ethbrake_marl.first_edition.evaluation.lineup import make_agents
from ethbrake_marl.first_edition.evaluation.trial import load_runnable
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS
from ethbrake_marl.first_edition.physics.left_out import leaving_out_failed
from ethbrake_marl.first_edition.physics.state import Ints, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.training.settings import read_settings


def main(words: list[str]) -> None:
    """Search a list and print the mean harms, or print the shipped tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--shipped", action="store_true", help="print the shipped tables instead")
    add("--scenario", default="paper-random")
    add("--episodes", type=int, default=10_000, help="worlds of the list")
    add("--seed", type=int, default=7, help="seed of the list")
    add("--harm-count", choices=HARM_COUNTS, help="harm to minimise; default: both")
    add("--vehicles", metavar="A,B,...", help="vehicles to control together; default: the learners")
    add("--budget", type=int, default=100_000, help="candidate profiles per world and count")
    add("--search-seed", type=int, default=0)
    add("--threads", type=int, help="worlds searched at the same time; changes no result")
    add("--start", type=Path, metavar="FILE.npz", help="a table to start from; no world gets more harm")
    add("--agents", default="", metavar="A,B,...", help="agents to try after the search; less harm counts")
    add("--output", type=Path, metavar="FILE.npz", help="the table to write")
    add("--set", action="append", metavar="KEY=VALUE", help="a changed value of the scenario; repeatable")
    given = parser.parse_args(words)
    if given.shipped:
        print(shipped_bounds()[1].markdown())
        return
    table, figures = search(given, " ".join(["docs/studies/best_harm.py", shlex.join(words)]))
    for name, value in figures.items():
        print(f"{name:36} {f'{value:.4f}' if isinstance(value, float) else value}")
    if given.output is not None:
        table.save(given.output)
        shutil.rmtree(parts_beside(given.output))
        print(f"every world: {given.output}", file=sys.stderr)


def parts_beside(output: Path) -> Path:
    """Return the folder of the finished chunks of a search."""
    return output.with_name(f".{output.name}.parts")


def search(given: argparse.Namespace, command: str) -> tuple[BestHarmTable, dict[str, object]]:
    """Return the table that the arguments ask for, and its mean harms and proven values by name."""
    if given.output is not None:
        check_target(given.output)
    chosen = load_runnable(given.scenario, read_settings(given.set).scenario)
    names = None if given.vehicles is None else [name.strip() for name in given.vehicles.split(",")]
    controlled = None if names is None else chosen.with_learners(names).learners
    if controlled is None and not chosen.learners:
        raise InvalidInput(f"scenario {chosen.name!r} has no learner; give vehicles to control: --vehicles vehicle_2")
    sample = chosen.sample(given.episodes, given.seed)
    counts = HARM_COUNTS if given.harm_count is None else (given.harm_count,)
    specs = [spec.strip() for spec in split_specs(given.agents)] if given.agents else []
    if specs and (len(chosen.learners) != 1 or controlled not in (None, chosen.learners)):
        raise InvalidInput("--agents need a scenario with exactly one learner, and no --vehicles")
    lineups = {each: make_agents(specs, chosen, harm_count=each) for each in counts}
    table = search_list(
        chosen, sample, chunks=None if given.output is None else parts_beside(given.output), counts=counts,
        vehicles=controlled, budget=given.budget, seed=given.search_seed, threads=given.threads,
        known=None if given.start is None else BestHarmTable.load(given.start),
    )  # fmt: skip
    for name in lineups[counts[0]]:
        table = fold_episodes(table, chosen, sample.worlds, name, {each: lineups[each][name] for each in counts})
    header = {**table.header, "episodes": given.episodes, "list_seed": given.seed, "command": command}
    table = replace(table, header=header)
    figures: dict[str, object] = {key: value for key, value in header.items() if key != "after"}
    for each, best in table.best.items():
        counted = "first_impact" if each == "first" else "total"
        figures[f"best_known_{counted}_harm"] = float(best.harm.mean())
        figures["harmless_rate"] = float((best.harm == 0.0).mean())
    proven = proven_of_table(sample.worlds, Task(chosen, controlled or chosen.learners), table)
    if proven is not None:
        inside = {f"between_{name}": value for name, value in (proven.pop("between") or {}).items()}
        figures |= {name: value for name, value in {**proven, **inside}.items() if value is not None}
    return table, figures


# The proven bounds of a list of worlds, beside the least harm known there.
#
# *Contact proven* is not *impact proven*. In the worlds between the two, every command leads to contact, but perhaps
# not to an impact. Either leaning without an impact is possible there, or the proof is loose. The harm of the best
# known profiles in these worlds shows which: almost no harm, or much harm.


def proven_of_table(worlds: Worlds, task: Task, table: BestHarmTable) -> dict[str, Any] | None:
    """Return what is proven about the worlds of a list; None if no harm is proven.

    The result has the mean proven harm (m2/s2, valid for both counts), the shares of worlds with proven contact and
    with proven impact, and ``Between``, which uses the least harms of the table. Undecided values are None. Worlds that
    cannot be advanced are left out.
    """

    def of(rows: Ints) -> dict[str, Any] | None:
        some = worlds.take(rows)
        proof, identity = prove(some, task), task_problem(some, task).identity
        if isinstance(proof, Unproven) or proof.harm is None or proof.impact is None:
            return None
        known = (table.harm(identity, harm_count) for harm_count in HARM_COUNTS)
        contact, impact = proof.contact, proof.impact
        return {
            "proven_harm": float(proof.harm.mean()),
            "contact_proven_rate": None if contact is None else float(contact.mean()),
            "impact_proven_rate": float(impact.mean()),
            "between": None if contact is None else asdict(Between.of(contact, impact, *known)),
        }

    return leaving_out_failed(of, np.arange(worlds.n))[0]


def shipped_bounds(tables: Iterable[BestHarmTable] | None = None) -> tuple[list[dict[str, Any]], Sheet]:
    """Return best known harm, proven harm and gap of every shipped table, as plain data and as a sheet of means.

    gap = (best known harm - proven harm) / best known harm. The header of a table names a shipped scenario and a list
    of its worlds. Raises ``InvalidInput`` if the table does not contain these worlds.
    """
    harm, share = partial(Column, digits=3), partial(Column, digits=1, scale=100.0, unit=" %")
    columns = (
        "list", Column("worlds"), harm("proven"), harm("best known, first"), share("gap"), harm("best known, total"),
        share("gap"), share("contact proven"), share("impact proven"), share("between"),
        harm("best known there, first"), share("next to none there"),
    )  # fmt: skip
    plain, rows = [], []
    for table in shipped_tables() if tables is None else tables:
        header = table.header
        scenario = load_scenario(header["scenario"])
        names, seed = tuple(header["vehicles"]), int(header["list_seed"])
        task = Task(scenario, tuple(scenario.vehicle_names.index(name) for name in names))
        sample = scenario.sample(int(header["episodes"]), seed)
        table.check_holds_any(task_problem(sample.worlds, task).identity)
        why = unproven_because(sample.worlds, task)
        proven = None if why is not None else proven_of_table(sample.worlds, task, table)
        known = {c: float(table.best[c].harm.mean()) if c in table.best else None for c in HARM_COUNTS}
        gaps: dict[str, float | None] = dict.fromkeys(known)
        for harm_count, best in known.items():
            if proven is not None and best is not None:
                gaps[harm_count] = 1.0 - proven["proven_harm"] / best if best > 0.0 else 0.0
        plain.append({
            **result_identity("best-harm", scenario, sample),
            "scenario": scenario.name,
            "vehicles": names,
            "list_seed": seed,
            "worlds": len(table.identity),
            **{f"best_known_{harm_count}": best for harm_count, best in known.items()},
            "proven": proven,
            "nothing_proven_because": why,
            **{f"gap_{harm_count}": gap for harm_count, gap in gaps.items()},
        })  # fmt: skip
        means = proven or {}
        inside = means.get("between") or {}
        rows.append((
            f"{scenario.name} (seed {seed}){f': {why}' if why else ''}", f"{len(table.identity):,}",
            means.get("proven_harm"), known["first"], gaps["first"], known["total"], gaps["total"],
            means.get("contact_proven_rate"), means.get("impact_proven_rate"),
            inside.get("rate"), inside.get("mean_first"), inside.get("harmless_rate"),
        ))  # fmt: skip
    return plain, Sheet("", columns, rows)


if __name__ == "__main__":
    main(sys.argv[1:])
