"""Tables and pictures of the pages, and the commands with which ``make figures`` makes them again.

The beginning of its header identifies a table, the name of its file a picture. A section whose
table is compared names its commands itself.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.docs.site import DOCS

ROOT = DOCS.parent
BLOCK = re.compile(r"^```(\S*)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
PAGES = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md")),
    *sorted(ROOT.glob(".github/**/*.md")),
    *sorted(page for page in DOCS.rglob("*.md") if "_build" not in page.parts),
    *sorted((ROOT / "ethbrake_marl" / "shipped" / "policies").glob("*/card.md")),
]
COMPARED = "`make figures` compares the table"  # in a section with the commands


@dataclass(frozen=True)
class Shown:
    """A table or picture of a page, and the commands that make it."""

    page: str
    begin: str
    text: str
    commands: tuple[str, ...] = ()


_HONEST = tuple(
    f"ethbrake evaluate --scenario paper-random{test} --agents full_brake,e_v2x_bm,e_v2x_bm:pairwise,ppo,"
    "plan,best_harm --set measures=pushed_mps --json"
    for test in ("", "-brake-only", "-obstacle")
)
TABLES: dict[str, tuple[str, ...]] = {
    "| who drives Vehicle 2 | main test": _HONEST,
    "| who drives Vehicle 2 | knows | collisions | first-impact harm | total harm | honest cost": _HONEST,
    "| agent | what it does | knows": ("ethbrake evaluate --agents ladder --json",),
    "| Vehicle 2 minimises the cost of": ("python docs/studies/whose_harm.py whose-harm.png",),
}

PICTURES: dict[str, tuple[str, ...]] = {
    "emergency.gif": ("ethbrake watch --agents full_brake,plan --output emergency.gif",),
    "followed.gif": (
        "ethbrake watch --scenario standards-ccrs-followed --agents aeb,idm --world 26 --output followed.gif",
    ),
    **{
        f"gallery/{film.name}": (f"python docs/studies/gallery.py . --only {film.stem}",)
        for film in sorted((DOCS / "figures" / "gallery").glob("*.gif"))
    },
    "deceleration.png": (
        'python -c "import ethbrake_marl as eb;'
        " from ethbrake_marl.extensions.report import deceleration_figure, write_picture;"
        " scenario = eb.load_scenario('paper-random'); world = scenario.sample(1, seed=7, first=5);"
        " figure = deceleration_figure(world, scenario, title='paper-random, world 5 of the list of seed 7');"
        " write_picture('deceleration.png', figure)\"",
    ),
    **{
        f"{name}.png": (f"python docs/studies/{study}.py {name}.png",)
        for name, study in (
            ("latency", "paper/latency"),
            ("sampled-convergence", "sampling"),
            ("time-gaps", "time_gaps"),
            ("whose-harm", "whose_harm"),
            ("regimes", "regimes"),
        )
    },
}


def pages() -> list[Path]:
    """README and every page of docs/ that is no decision."""
    written = [path for path in DOCS.rglob("*.md") if path.relative_to(DOCS).parts[0] not in ("_build", "decisions")]
    return [ROOT / "README.md", *sorted(written)]


def tables() -> Iterator[Shown]:
    """Tables that ``make figures`` compares: those of ``TABLES``, and those of sections that say so."""
    for page in pages():
        for section in page.read_text("utf-8").split("\n## "):
            commands = tuple(re.findall(r"(?m)^\$ (.*)", section))
            for table in TABLE.findall(BLOCK.sub("", section)):
                begin = table.partition("\n")[0]
                if COMPARED in " ".join(section.split()):
                    yield Shown(_name(page), begin, table, commands)
                for key, known in TABLES.items():
                    if begin.startswith(key):
                        yield Shown(_name(page), key, table, known)


def pictures() -> Iterator[Shown]:
    """Pictures that ``make figures`` compares."""
    for page in pages():
        for name in re.findall(r"!\[[^\]]*\]\([^)]*figures/([^)]+)\)", page.read_text("utf-8")):
            if name in PICTURES:
                yield Shown(_name(page), name, name, PICTURES[name])


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


def rows(page: str, heading: str) -> list[list[str]]:
    """The cells of the first table below a heading of a page, header first, without the line below the header."""
    text = (DOCS / f"{page}.md").read_text("utf-8").partition(f"\n{heading}\n")[2]
    first, _, *others = [line for line in TABLE.search(text)[0].splitlines()]
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in (first, *others)]


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()
