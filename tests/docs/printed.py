"""Where each printed block, table of figures and picture of the pages is made again and compared.

A block is known by its first command (or first line), a table by how its header begins, a picture by its name; what is
in none of these tables, or no longer in a page, turns `tests/docs/test_printed.py` red. `docs/tests.md` shows them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

SUITE = "in the suite"  # compared by `make test`
NIGHTLY = "`make figures`"  # made again and compared there
TRAINING = "a training"  # minutes to hours, other on another machine: said with date and machine
SEARCH = "a long search"  # as long
SPEED = "a speed"  # of one machine
BY_HAND = "nothing to compare"  # a file to copy, something that waits for a person, a table of words


class How(NamedTuple):
    """Where it is compared, by which test or commands; and the figures in it that somebody else printed."""

    where: str
    by: tuple[str, ...] = ()
    quoted: tuple[str, ...] = ()


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
    "First-impact        Total Sampled": _by(TRAINING, "make run"),
    "resume, ppo: 20/20": _by(TRAINING, "make test-resume"),
    "ethbrake doctor speed": _by(SPEED),
    "make bench-peers": _by(SPEED),
    ".venv/bin/python docs/studies/threads.py": _by(SPEED),
    "gap_1_m,gap_2_m,speed_1_mps": _by(BY_HAND),
    "paper-random full_brake        backward": EXACT,
}

_SHIPPED = (
    "full_brake,e_v2x_bm,ppo@shipped,counterfactual@shipped,counterfactual@shipped+refined:profile+episode,best_harm"
)
_TOTAL = "full_brake,e_v2x_bm,ppo@shipped/ppo,ppo@shipped,ppo@shipped+refined+episode,best_harm"
_THREE = "full_brake,e_v2x_bm,ppo@shipped/ppo,ppo@shipped,ppo@shipped+episode,ppo@shipped+refined+episode,best_harm"


def _evaluate(scenario: str, agents: str, more: str = "") -> str:
    return f"ethbrake evaluate --scenario {scenario} --agents {agents} --episodes 2000 --seed 7 --json{more}"


TABLES: dict[str, How] = {
    # the three tests
    "| who drives Vehicle 2 | knows | collisions": _by(
        NIGHTLY,
        _evaluate("paper-random", _SHIPPED),
        _evaluate("paper-random-brake-only", _SHIPPED),
        _evaluate("paper-random-obstacle", _TOTAL, " --harm-count total"),
    ),
    "| who drives Vehicle 2 | collisions | first-impact harm | total harm | sampled harm": _by(
        NIGHTLY,
        _evaluate("paper-random", _THREE),
        _evaluate("paper-random-brake-only", _THREE),
        _evaluate("paper-random-obstacle", _THREE, " --harm-count total"),
    ),
    "| test | full braking | E-V2X-BM coupled | PPO trained for it": _by(
        NIGHTLY,
        *(
            _evaluate(f"paper-random{test}", "full_brake,e_v2x_bm,ppo@shipped,best_harm")
            for test in ("", "-brake-only")
        ),
        _evaluate("paper-random-obstacle", "full_brake,e_v2x_bm,ppo@shipped,best_harm", " --harm-count total"),
    ),
    "| test, harm | alone | episode | step": _by(
        NIGHTLY,
        "ethbrake shield --scenario paper-random-brake-only --agents ppo@shipped --json",
        "ethbrake shield --scenario paper-random-obstacle --harm-count total --agents ppo@shipped --json",
    ),
    "| what | first-impact harm | of the best known": TRAINED,
    "| training seed | default, tuning": TRAINED,
    "| what the vehicles do | first-impact harm": TRAINED,
    "| list | above B, interior": _by(SEARCH, "make test-shield"),
    "| channel | `": _by(NIGHTLY, "python docs/studies/price.py price-of-not-knowing.png"),
    "| level | who proposes | alone": _by(SEARCH),
    "| robust mode | worlds | above": _by(SEARCH, "make test-shield"),
    "| intervals | mode | above": _by(SEARCH, "make test-shield"),
    "| agents | worlds | processor time": _by(SPEED),
    # lists of worlds
    "| Agent | Knows | Collisions": _by(
        NIGHTLY, "ethbrake evaluate --agents full_brake,e_v2x_bm,e_v2x_bm:pairwise --episodes 10000 --seed 7 --json"
    ),
    "| agent | collisions | avoidable ones": _by(
        NIGHTLY, "ethbrake evaluate --agents ladder --scenario paper-random --episodes 10000 --seed 7 --json"
    ),
    "| scenario | unavoidable | `full_brake` collides": _by(
        NIGHTLY,
        *(
            _evaluate(scenario, "full_brake,e_v2x_bm")
            for scenario in (
                "stress-wide",
                *(f"realistic-{name}" for name in ("motorway", "platoon", "truck", "mixed")),
            )
        ),
    ),
    "| reading | full braking | E-V2X-BM pairwise": _by(
        NIGHTLY,
        "ethbrake evaluate --scenario paper-distance --agents full_brake,e_v2x_bm:pairwise --episodes 5000 --json",
        "ethbrake evaluate --scenario paper-random --agents full_brake,e_v2x_bm:pairwise --json",
    )._replace(quoted=("85.26", "9.8514")),  # the paper's
    "| list | worlds | proven | best known, first": EXACT,
    "| level | driven | proven | best known": _by(SEARCH),
    "| list | unavoidable | front | rear": _by(SEARCH, "make test-physics"),
    "| d1, d2; v1, v2, v3; tau2, tau3": EXACT,
    "| agent | predicted | collisions": _by(SEARCH),
    "| agent | knows | collisions | first-impact | total": TRAINED,
    "| List | What | Vehicles | Driven": _by(SUITE, "tests/docs/test_pages.py"),
    "|  | Agent | Overall": _by(SUITE, "tests/docs/test_pages.py"),
    "| candidates per world and count": _by(SEARCH),
    "| controlled | first-impact | total": _by(SEARCH),
    "| list (seed 7) | worlds | first-impact, mean": _by(SEARCH),
    "| agent | 0.1, 0.3 s | 0.3, 0.6 s": _by(SEARCH),
    "| total gap (m) | 10-12": _by(SUITE, "tests/docs/test_pages.py"),
    "| step (s) | first-impact, mean": _by(SUITE, "tests/docs/test_studies.py"),
    "| width | shield | bound": _by(SEARCH),
    "| leak | first restart above": _by(SEARCH, "make test-shield"),
    "| gate | measured | at most": _by(SEARCH, "make test-physics"),
    # trainings
    "| who proposes | alone | episode": TRAINED,
    "| scheme | first-impact harm": TRAINED,
    "| level | collisions": TRAINED,
    "| level | first-impact harm: reached": TRAINED,
    "| level | first-impact harm: without": TRAINED,
    "| level | seed | collisions": TRAINED,
    "| step | first-impact harm": TRAINED,
    "| step | Vehicle 1": TRAINED,
    "| vehicles | all brake fully": TRAINED,
    "| who drives | learnt from": TRAINED,
    "| seed | processor time": TRAINED,
    "| changed | ": TRAINED,
    "| scenario | `quick` | `ppo`": TRAINED,
    "| scenario | `ppo` | `sac`": TRAINED,
    "| what learns | 10": TRAINED,
    "| who drives Vehicle 2 | collisions | first-impact | times": TRAINED,
    "| policy | processor time": TRAINED,
    "| trained for | policy": TRAINED,
    "| after | decisions | harm": TRAINED,
    "| scenario | policy | processor time": TRAINED,
    "| trained on | what": TRAINED,
    "| list | full braking | `universal-ppo`": TRAINED,
    "| list (seed 7) | alone": TRAINED,
    "| list (seed 7) | policy | hybrid": TRAINED,
    "| recipe | decisions, time": TRAINED,
    "| test | policy | trained for": TRAINED,
    "| | full braking | E-V2X-BM | this policy": _by(TRAINING, "make run"),
    "| library | version": _by(TRAINING, "make test-libraries"),
    # speeds
    "| what | processor time | a whole job": _by(SPEED),
    "| agent | knows | CPU, ms per world": _by(SPEED),
    "| agent | CPU time | first": _by(SPEED),
    "| | CPU-seconds per million worlds": _by(SPEED),
    "| what | measured | by": _by(SPEED),
    # words and settings
    "| preset | ": _by(SEARCH),
    "| licence | packages": _by(SUITE, "tests/programmes/test_programmes.py"),
    "| no. | label | the paper": _by(BY_HAND),
    "| planted | search | first found after": _by(SEARCH),
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
    "shield-operating.png": _by(TRAINING),
    "shield-modes.png": _by(TRAINING),
    "regimes.png": _by(NIGHTLY, "the program on its page"),
    "cooperation-ablation": _by(TRAINING),
    "learning-curves": _by(TRAINING),
    "explorer.png": _by(BY_HAND),
    "speed-scaling.png": _by(SPEED),
    "reproduction-trajectories": _by(SUITE, "tests/docs/test_pages.py"),
    "reproduction": _by(TRAINING, "ethbrake reproduce --full"),
}


def how(table: dict[str, How], begin: str) -> tuple[str, How] | None:
    """The longest entry that ``begin`` begins with, and what it says; None: there is none."""
    fitting = [key for key in table if begin.startswith(key)]
    return (key := max(fitting, key=len), table[key]) if fitting else None


def where_rows() -> Iterator[str]:
    """The table of docs/tests.md: one row for each place where something is compared, and how much."""
    for where in (SUITE, NIGHTLY, TRAINING, SEARCH, SPEED, BY_HAND):
        counts = (sum(each.where == where for each in table.values()) for table in (BLOCKS, TABLES, PICTURES))
        by = sorted(
            {
                by
                for table in (BLOCKS, TABLES, PICTURES)
                for each in table.values()
                if each.where == where
                for by in each.by
            }
        )
        named = ", ".join(f"`{each}`" for each in by if each.startswith(("tests/", "make ")))
        yield f"| {where} | {' | '.join(str(count) for count in counts)} | {named or '–'} |"
