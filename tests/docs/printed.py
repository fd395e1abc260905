"""What the pages show as the outcome of a command, and where each block, table and picture is made again.

A block is known by its first command (or first line), a table by how its header begins, a picture by its name; what is
in none of these tables, or no longer in a page, turns `tests/docs/test_printed.py` red. The tables of docs/results say
it themselves.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from tests.docs.site import DOCS, load

ROOT = DOCS.parent
BLOCK = re.compile(r"^```(\S*)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
FIGURE = re.compile(r"\d+\.\d+")
ANYTHING = re.compile(r"\s*(?:\.\.\.|…)\s*")


@dataclass(frozen=True)
class Shown:
    """One of them: its page, what it begins with (a command, a table's header, a picture's name), and its text."""

    page: str
    begin: str
    text: str


NOT_SCANNED = ("_build", "decisions", "reference", "results")  # made, or told as things were when they were decided


def pages() -> list[Path]:
    """README, every page that is written by hand, and the page of the commands."""
    written = [path for path in DOCS.rglob("*.md") if path.relative_to(DOCS).parts[0] not in NOT_SCANNED]
    return [ROOT / "README.md", *sorted(written), DOCS / "reference" / "cli.md"]


def printed_blocks() -> Iterator[Shown]:
    """Blocks with output: of commands (``$ ...``), and those without a language."""
    for page, text in _texts():
        for language, body in BLOCK.findall(text):
            lines = [line for line in body.splitlines() if line.strip()]
            if language == "console" and any(not _is_command(line) for line in _joined(lines)):
                yield Shown(page, commands_of(body)[0][0], body)
            elif not language and lines:
                yield Shown(page, lines[0].strip(), body)


def tables_of_figures() -> Iterator[Shown]:
    """Tables with a decimal fraction in two lines at least."""
    for page, text in _texts():
        for table in TABLE.findall(BLOCK.sub("", text)):
            if sum(bool(FIGURE.search(line)) for line in table.splitlines()[2:]) >= 2:
                yield Shown(page, table.partition("\n")[0], table)


def pictures() -> Iterator[Shown]:
    """Pictures of docs/figures, by name."""
    for page, text in _texts():
        for name in re.findall(r"!\[[^\]]*\]\([^)]*figures/([^)]+)\)", text):
            yield Shown(page, name, name)


def commands_of(block: str) -> list[tuple[str, list[str]]]:
    """(command, lines that it printed) of a block, in order."""
    found: list[tuple[str, list[str]]] = []
    for line in _joined(block.splitlines()):
        if _is_command(line):
            found.append((line[2:], []))
        elif found:
            found[-1][1].append(line.rstrip())
    return found


def agrees(shown: list[str], told: list[str]) -> bool:
    """Whether lines are as shown, where ``...`` stands for any number of lines, or for the rest of one."""
    pattern = ""
    for line in (each.rstrip() for each in shown):
        if ANYTHING.fullmatch(line):
            pattern += r"(.*\n)*?"
        else:  # one that ends in ``...`` goes on somehow
            pattern += re.escape(line.removesuffix("...")) + ".*\n" if line.endswith(" ...") else re.escape(line) + "\n"
    text = "".join(f"{line.rstrip()}\n" for line in told)
    return re.fullmatch(rf"{pattern}\n*", text) is not None or re.fullmatch(pattern, f"{text}\n") is not None


def missing_figures(table: str, told: str) -> list[str]:
    """Figures of a table, with their decimals, that no number of what was told is when it is rounded to as many."""
    numbers = {float(word) for word in re.findall(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", told)}
    table = re.sub(r"( %) \[(\S+), (\S+)\]", r"\1 [\2\1, \3\1]", table)  # an interval has the unit of what it is of
    figures = {(word, share) for word, share in re.findall(r"(?<![\w.])(\d+\.\d+)( %)?", table)}
    return sorted(
        word
        for word, share in figures
        if not any(abs(abs(each) * factor - float(word)) <= 0.5000001 * 10 ** -len(word.partition(".")[2])
                   for each in numbers for factor in ((1, 100) if share else (1,)))
    )  # fmt: skip


def _texts() -> Iterator[tuple[str, str]]:
    for page in pages():
        yield page.relative_to(ROOT).as_posix(), page.read_text("utf-8")


def _is_command(line: str) -> bool:
    return line.startswith("$ ")


def _joined(lines: list[str]) -> list[str]:
    """Commands that go over several lines, in one."""
    return re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines()


# ---------------------------------------------------------------- where each is made again


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
    "6.08 7.43 0": _by(SUITE, "tests/extensions/report/test_extending.py"),
    "ethbrake train --scenario cooperation-3-pair": TRAINED,
    "ethbrake agent export runs/early": TRAINED,
    "Agent,                           First-impact": _by(TRAINING, "make run"),
    "gap_1_m,gap_2_m,speed_1_mps": _by(BY_HAND),
}

_TESTS = tuple(
    f"ethbrake evaluate --scenario paper-random{test} --agents full_brake,e_v2x_bm,{agents},best_harm --episodes 2000"
    " --set measures=injury --json"
    for test, agents in (
        ("", "ppo,universal"),
        ("-brake-only", "ppo,universal"),
        ("-obstacle --set harm_count=total", "ppo,rollout-obstacle"),
        ("-buildup", "ppo,universal"),
    )
)

TABLES: dict[str, How] = {
    "| who drives Vehicle 2 | knows | collisions": _by(NIGHTLY, *_TESTS),
    "| agent and test | first-impact harm | harm / best known harm": TRAINED,
    "| who drives Vehicle 2 | collisions | first-impact harm": _by(
        NIGHTLY,
        "ethbrake evaluate --scenario recorded-openacc --agents full_brake,e_v2x_bm,idm,universal,best_harm --json",
    ),
    "| no. | label | the paper": _by(BY_HAND),
    "| `--draw` | harm of `full_brake`": _by(SUITE, "tests/extensions/recorded/test_recorded.py"),
    "| work | has | lacks": _by(BY_HAND),
    "| `--sweep` | values that are compared": _by(BY_HAND),
    "| agent | what it does | knows": _by(
        NIGHTLY, "ethbrake evaluate --agents ladder --scenario paper-random --episodes 10000 --seed 7 --json"
    ),
    "| trained for | recipe | scenario | settings that differ": _by(BY_HAND),
    "| Vehicle 2 minimises": _by(SEARCH),
    "| agent | ratio: equal weights": _by(SEARCH),
    "| who learns, objective": _by(SEARCH),
    "| trained with | processor time | hypervolume": _by(SEARCH),
}

PICTURES: dict[str, How] = {
    "emergency.png": _by(NIGHTLY, "ethbrake watch --agents full_brake,universal --output emergency.png"),
    "game-loop.svg": _by(BY_HAND),
    "front": _by(SEARCH),
    "model-": _by(SUITE, "tests/docs/test_studies.py"),
    "deceleration.png": _by(
        NIGHTLY,
        'python -c "import ethbrake_marl as eb; from ethbrake_marl.scenario import Task;'
        " from ethbrake_marl.extensions.report import deceleration_curve, deceleration_figure, write_picture;"
        " scenario = eb.load_scenario('paper-random');"
        " curve = deceleration_curve(scenario.sample(1, 7, first=5).worlds, Task(scenario, scenario.learners));"
        " figure = deceleration_figure(curve, title='paper-random, world 5 of the list of seed 7');"
        " write_picture('deceleration.png', figure)\"",
    ),
    "sampled-convergence.png": _by(NIGHTLY, "python docs/studies/sampling.py sampled-convergence.png"),
    "price-of-not-knowing.png": _by(NIGHTLY, "python docs/studies/price.py price-of-not-knowing.png"),
    "time-gaps.png": _by(NIGHTLY, "python docs/studies/time_gaps.py time-gaps.png"),
    "regimes.png": _by(NIGHTLY, "python docs/studies/regimes.py regimes.png"),
    "cooperation-ablation": _by(TRAINING),
    "learning-curves": _by(TRAINING),
    "team-curves.png": _by(TRAINING),
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
