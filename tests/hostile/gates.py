"""How much the attack holds: the tables of docs/security.md, counted from the cases themselves."""

from __future__ import annotations

from collections.abc import Iterator

from tests.hostile.cage import CPU_LIMIT_S, LINE_LIMIT, MEMORY_LIMIT_BYTES
from tests.hostile.case import Case
from tests.hostile.command_cases import WORDS
from tests.hostile.kinds import KINDS, cases_of
from tests.hostile.place_cases import LONG
from tests.hostile.yaml_changes import NOBODY
from tests.hostile.yaml_parts import SPECS
from tests.pages.hostile import HOSTILE

YAML = ("scenario", "recipe", "sweep", "worlds", "tuning")


def kind_rows(seed: int = 0) -> Iterator[str]:
    """One row per kind of case, then their sum."""
    total = 0
    for kind, generator in KINDS.items():
        cases = cases_of(kind, generator, seed, None)
        total += len(cases)
        yield f"| {kind} | {len({case.category for case in cases})} | {len(cases):,} |"
    yield f"| in all | | {total:,} |"


def gate_rows() -> list[str]:
    """What there must be at least, or at most, and what there is."""
    files, categories = bad_yaml()
    names = {*HOSTILE, *WORDS, *SPECS, *NOBODY, *LONG}
    bundles = certain("bundle")
    return [
        f"| YAML files that are refused, each different | at least 400 | {files:,} |",
        f"| categories of them | at least 40 | {categories} |",
        f"| bundles that are refused | at least 80 | {len(bundles)} |",
        f"| names of files, agents, vehicles, settings and in pages, each different | at least 100 | {len(names)} |",
        f"| processor time of one case | | at most {CPU_LIMIT_S} s |",
        f"| memory of one case | | at most {MEMORY_LIMIT_BYTES >> 30} GiB |",
        f"| a line that it prints | | at most {LINE_LIMIT:,} characters |",
    ]


def certain(kind: str) -> list[Case]:
    """The cases of a kind that must be refused."""
    return [case for case in cases_of(kind, KINDS[kind], 0, None) if case.certain]


def bad_yaml() -> tuple[int, int]:
    """Different files among those that must be refused, and their categories; one of two kinds of file counts twice."""
    cases = [(kind, case) for kind in YAML for case in certain(kind)]
    contents = {
        (kind, case.content.encode("utf-8", "surrogatepass") if isinstance(case.content, str) else case.content)
        for kind, case in cases
    }
    return len(contents), len({case.category for _, case in cases})
