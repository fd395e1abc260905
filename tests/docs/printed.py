"""Where each printed block, table of figures and picture of the pages is made again and compared.

A block is known by its first command (or first line), a table by how its header begins, a picture by its name; what is
in none of these tables, or no longer in a page, turns `tests/docs/test_printed.py` red. The tables of docs/results say
it themselves. `docs/tests.md` counts them all.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from tests.docs.blocks import Shown
from tests.docs.site import load

MEASURED = load("results")
SUITE = "in the suite"  # compared by `make test`
NIGHTLY = "make figures"  # made again and compared there
TRAINING = "a training"  # minutes to hours, other on another machine: said with date and machine
SEARCH = "a long search"  # as long
SPEED = "a speed"  # of one machine
BY_HAND = "nothing to compare"  # a file to copy, something that waits for a person, a table of words


class How(NamedTuple):
    """Where it is compared, and by which test or commands."""

    where: str
    by: tuple[str, ...] = ()


def _by(where: str, *commands: str) -> How:
    return How(where, commands)


EXACT = _by(SUITE, "tests/docs/test_printed.py")
TUTORIAL = _by(SUITE, "tests/cli/test_scenarios.py")
TRAINED = _by(TRAINING)

BLOCKS: dict[str, How] = {
    "ethbrake evaluate --agents ful_brake": EXACT,
    "ethbrake scenario validate rainy.yaml": EXACT,
    "ethbrake train": _by(SUITE, "tests/test_imports.py"),
    "agent,world,impacts,first_impact_harm,total_harm": TUTORIAL,
    "-1.0 26.97": TUTORIAL,
    "Policy('ppo', 27 observations": _by(SUITE, "tests/docs/test_printed.py"),
    "ethbrake train --scenario cooperation-3-pair": TRAINED,
    "ethbrake agent export runs/early": TRAINED,
    "Agent,                           First-impact": _by(TRAINING, "make run"),
    "resume, ppo: 20/20": _by(TRAINING, "make test-resume"),
    "gap_1_m,gap_2_m,speed_1_mps": _by(BY_HAND),
    "paper-random full_brake        backward": EXACT,
}

_SHIPPED = "counterfactual@shipped,counterfactual@shipped+refined:profile+episode"
_TESTS = tuple(
    f"ethbrake evaluate --scenario paper-random{test} --agents full_brake,e_v2x_bm,{agents},best_harm --episodes 2000"
    " --seed 7 --json"
    for test, agents in (
        ("", f"ppo@shipped,{_SHIPPED}"),
        ("-brake-only", f"ppo@shipped,{_SHIPPED}"),
        ("-obstacle --harm-count total", "ppo@shipped/ppo,options@shipped"),
    )
)

TABLES: dict[str, How] = {
    "| who drives Vehicle 2 | knows | collisions": _by(NIGHTLY, *_TESTS),
    "| what | first-impact harm | of the best known": TRAINED,
    "| no. | label | the paper": _by(BY_HAND),
}

PICTURES: dict[str, How] = {
    "emergency.svg": _by(
        NIGHTLY, "ethbrake watch record --agents full_brake,counterfactual@shipped --output emergency.svg"
    ),
    "model-": _by(SUITE, "tests/docs/test_studies.py"),
    "criticality.png": _by(
        NIGHTLY,
        "ethbrake watch picture criticality --scenario paper-distance --agent e_v2x_bm --output criticality.png",
    ),
    "deceleration.png": _by(
        NIGHTLY, "ethbrake watch picture deceleration --scenario paper-random --world 5 --output deceleration.png"
    ),
    "sampled-convergence.png": _by(NIGHTLY, "python docs/studies/sampling.py sampled-convergence.png"),
    "shield-robustness.png": _by(
        SEARCH, "ethbrake watch picture robustness --agent ppo@shipped --episodes 300 --output shield-robustness.png"
    ),
    "price-of-not-knowing.png": _by(NIGHTLY, "python docs/studies/price.py price-of-not-knowing.png"),
    "shield-modes.png": _by(TRAINING),
    "regimes.png": _by(NIGHTLY, "python docs/studies/regimes.py regimes.png"),
    "cooperation-ablation": _by(TRAINING),
    "learning-curves": _by(TRAINING),
    "explorer.png": _by(BY_HAND),
    "speed-scaling.png": _by(SPEED),
}


def how(table: dict[str, How], begin: str) -> tuple[str, How] | None:
    """The longest entry that ``begin`` begins with, and what it says; None: there is none."""
    fitting = [key for key in table if begin.startswith(key)]
    return (key := max(fitting, key=len), table[key]) if fitting else None


def results() -> Iterator[tuple[Shown, How]]:
    """Every table of docs/results, by its anchor, and how it is compared."""
    for path in sorted(MEASURED.RESULTS.glob("*.json")):
        for table in MEASURED.read_tables(path.stem):
            yield (
                Shown(f"docs/results/{path.name}", table.id, table.markdown),
                How(table.compared, tuple(table.commands)),
            )


def where_rows() -> Iterator[str]:
    """The table of docs/tests.md: one row for each place where something is compared, and how much."""
    kinds = ([*BLOCKS.values()], [*TABLES.values(), *(place for _, place in results())], [*PICTURES.values()])
    for where in (SUITE, NIGHTLY, TRAINING, SEARCH, SPEED, BY_HAND):
        counts = (sum(each.where == where for each in kind) for kind in kinds)
        by = {" ".join(by.split()[:2]) for kind in kinds for each in kind if each.where == where for by in each.by}
        named = ", ".join(f"`{each}`" for each in sorted(by) if each.startswith(("tests/", "make ")))
        yield f"| {where} | {' | '.join(str(count) for count in counts)} | {named or '–'} |"
