"""Sweeps and files of named worlds as strangers write them: changed as every YAML file, and in their own keys."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path

from ethbrake_marl.evaluation.inputs import NamedWorld, NamedWorlds, states_of
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.sweep import SweepPlan
from tests.hostile.case import NASTY, Case, damaged, write
from tests.hostile.yaml_changes import CERTAIN, encoded
from tests.hostile.yaml_parts import NOT_FINITE, quoted, replaced

# Of the ways that a scenario or recipe is changed, those that need no number at the top level of the file.
OF_EVERY_FILE = (
    "unknown key",
    "misspelt key",
    "key twice",
    "tag",
    "tag on the document",
    "billion laughs",
    "merge key",
    "directive",
    "second document",
    "deep, in brackets",
    "deep, open",
    "deep, by indents",
    "deep, by dashes",
    "wide mapping",
    "many keys",
    "key that is no text",
    "long key",
    "long quoted key",
    "nasty key",
    "nasty quoted key",
    "look-alike key",
    "UTF-16 or UTF-32",
    "not text",
    "NUL",
    "control character",
    "broken syntax",
    "no mapping",
    "a dump of something else",
)
EACH = 4
LINE_ENDS = ("\u2028line", "\u2029", "\x85")  # of YAML 1.1, so that nothing stands there, or one line of text

SWEEP = """title: Two jobs and one
set: {total_steps: 256}
grid:
  scenario: [paper-random]
  recipe: [quick]
  seed: {first: 0, count: 2}
  set:
    gamma: [0.99, 0.995]
jobs:
  - {scenario: paper-random, recipe: ppo, seed: 0}
"""
NOWHERE = ("[nobody]", "[/dev/zero]", "[../../x.yaml]", "[x.yaml]", "[]", "[7]", "{a: 1}", "null", '[""]', "[[a]]")

# Category -> what stands in the file, and what is put in its place; each is refused.
IN_SWEEP: dict[str, tuple[str, tuple[str, ...]]] = {
    "scenarios of a sweep": ("[paper-random]", (*NOWHERE, "[" + "x" * 9000 + "]", '["\\e[2J"]', "7", "[true]")),
    "recipes of a sweep": ("[quick]", (*NOWHERE, "[" + "x" * 9000 + "]", '["\\u202e"]', "7", "[quick:3]")),
    "seeds of a sweep": (
        "{first: 0, count: 2}",
        (
            "{first: -1, count: 2}",
            "{first: 0, count: 0}",
            "{first: 0, count: 200001}",
            "{first: 0, count: 1000000000000}",
            "{first: 0}",
            "{first: 0, count: 2, step: 1}",
            "{first: .nan, count: 2}",
            "[-1]",
            "[4294967296]",
            "[1.5]",
            "[true]",
            "[]",
            "seven",
            "null",
        ),
    ),
    "settings of a sweep": (
        "gamma: [0.99, 0.995]",
        (
            "gamma: 0.99",
            "gamma: []",
            "gama: [1]",
            "gamma: [2]",
            "gamma: [.nan]",
            "gamma: [{a: 1}]",
            "gamma.x: [1]",
            "seed: [1]",
            "recipe.seed: [1]",
            '"a=b": [1]',
            "total_steps: [300]",
            "__class__: [1]",
            "mass_t: [x]",
            "name: [x]",
            "7: [1]",
            "reward: [7]",
        ),
    ),
    "jobs of a sweep": (
        "  - {scenario: paper-random, recipe: ppo, seed: 0}",
        (
            "  - 7",
            "  - {}",
            "  - {scenario: paper-random}",
            "  - {recipe: ppo}",
            "  - {scenario: paper-random, level: 3-pair, recipe: ppo}",
            "  - {scenario: nobody, recipe: ppo}",
            "  - {scenario: ../x, recipe: ppo}",
            "  - {scenario: paper-random, recipe: ppo, seed: [0]}",
            "  - {scenario: paper-random, recipe: ppo, seed: 4294967296}",
            "  - {scenario: paper-random, recipe: ppo, set: [1]}",
            "  - {scenario: paper-random, recipe: ppo, set: {seed: 1}}",
            "  - {scenario: paper-random, recipe: ppo, work: x.py}",
            '  - {scenario: "\\e[2J", recipe: ppo}',
            "  x: 1",
        ),
    ),
    "more jobs than there may be": (
        "gamma: [0.99, 0.995]",
        tuple(
            f"{key}: [{', '.join(['0.5'] * 5000)}]\n    gae_lambda: [{', '.join(['0.5'] * 99)}]"
            for key in ("gamma", "restitution")
        ),
    ),
}


def sweeps(rng: random.Random) -> Iterator[Case]:
    """Files of sweeps: 4 of each way of every file, each of their own once, and damaged ones."""
    for category, content in of_every_file(rng, SWEEP):
        yield _sweep(category, content)
    yield from (_sweep("too large", SWEEP + "#" + "x" * size) for size in (1 << 16, 1 << 20, 10 << 20))
    for category, content in of_own_keys(SWEEP, IN_SWEEP):
        yield _sweep(category, content)
    for _ in range(40):
        yield _sweep("damaged", damaged(rng, SWEEP.encode()), certain=False)


def worlds_text() -> str:
    """A file of two named worlds that is in order; nobody does more harm than it says."""
    scenario = load_scenario("paper-random")
    states = states_of(scenario.sample(2, 7).worlds, scenario)
    return NamedWorlds.of(
        scenario,
        scenario="paper-random",
        settings=["restitution=0.1"],
        agent="full_brake",
        measure="harm",
        harm_count="first",
        found_by="ethbrake search falsify --measure harm",
        worlds=[NamedWorld(name=f"world-{k}", score=1e6, harm=1e6, state=state) for k, state in enumerate(states)],
    ).text


def _in_worlds() -> dict[str, tuple[str, tuple[str, ...]]]:
    """Category -> the beginning of a line of the file, and what stands there instead; each is refused."""
    code = ("mine.py:make", "/dev/zero:make", "ppo@/dev/zero", "__import__('os')", "$(touch pwned)", "")
    return {
        "format": ("format: ", ("7", "x", "null", "[ethbrake-worlds]", quoted(random.Random(0)))),
        "version": ("version: ", ("0", "2", "1.5", "-1", "true", '"1"', "9" * 400)),
        "scenario of worlds": (
            "scenario: ",
            ("nobody", "/dev/zero", "../x.yaml", "7", "stress-wide", '"\\e[2J"', "[]"),
        ),
        "hash of the scenario": ("scenario_sha256: ", ('"' + "0" * 64 + '"', "x", "7", "null", '"' + "A" * 64 + '"')),
        "settings of worlds": (
            "settings: ",
            ("[mass_t=99]", "[x]", "[a=b]", "[7]", "x", "[restitution=9]", "[name=x]"),
        ),
        "agent of worlds": (
            "agent: ",
            (*(f'"{each}"' for each in code), '"\\e[2J"', "7", "[]", '"planner:99999999999"'),
        ),
        "measure": ("measure: ", ("nobody", "7", "[harm]", "regrett", "difference", "null")),
        "count of harm": ("harm_count: ", ("both", "7", "null", "[first]")),
        "name of a world": (
            "  - name: ",
            ("../x", '""', "a b", "x" * 101, "7", "null", '"\\e[2J"', '"\\u202e"', "-x", '"a\\0b"', "[a]", "world-1"),
        ),
        "measured in a world": ("    score: ", (*NOT_FINITE, "x", "null", "[1]", "true")),
        "state of a world": (
            "    state: ",
            (
                "{}",
                "7",
                "[1, 2]",
                "null",
                "{gap_1_m: 7}",
                "{nobody: 7}",
                "{gap_1_m: .nan, gap_2_m: 7, speed_1_mps: 20, speed_2_mps: 20, speed_3_mps: 20}",
                "{gap_1_m: -7, gap_2_m: 7, speed_1_mps: 20, speed_2_mps: 20, speed_3_mps: 20}",
                "{gap_1_m: 7, gap_2_m: 7, speed_1_mps: 1e400, speed_2_mps: 20, speed_3_mps: 20}",
                "{gap_1_m: 7, gap_2_m: 7, speed_1_mps: -20, speed_2_mps: 20, speed_3_mps: 20}",
                "{gap_1_m: 7, gap_2_m: 7, speed_1_mps: 20, speed_2_mps: 20, speed_3_mps: twenty}",
                "{gap_1_m: 7, gap_2_m: 7, speed_1_mps: 20, speed_2_mps: 20, speed_9_mps: 20}",
                "{" + ", ".join(f"c{k}: 1" for k in range(1001)) + "}",
            ),
        ),
    }


def named_worlds(rng: random.Random) -> Iterator[Case]:
    """Files of named worlds: 4 of each way of every file, each of their own once, and damaged ones."""
    text = worlds_text()
    for category, content in of_every_file(rng, text):
        yield _worlds(category, content)
    for category, (begin, others) in _in_worlds().items():
        at = text.index(begin)
        line = text[at : text.index("\n", at)]
        for other in others:
            yield _worlds(category, text.replace(line, f"{begin}{other}", 1))
    head, _, worlds = text.partition("worlds:\n")
    for listed in ("worlds: []", "worlds: 7", "worlds:", "worlds: {a: 1}", f"worlds: [{', '.join(['7'] * 1001)}]"):
        yield _worlds("list of worlds", f"{head}{listed}\n")
    yield _worlds("list of worlds", text + worlds)
    yield _worlds("too large", text + "#" + "x" * (8 << 20))
    for _ in range(40):
        yield _worlds("damaged", damaged(rng, text.encode()), certain=False)


def of_every_file(rng: random.Random, text: str) -> Iterator[tuple[str, bytes | str]]:
    """(category, content) of every way in which any such file is changed."""
    for category in OF_EVERY_FILE:
        for _ in range(EACH):
            yield category, encoded(rng, category, CERTAIN[category](rng, text))
    for nasty in NASTY:
        if nasty not in LINE_ENDS:
            yield "nasty last line", f"{text}{nasty}\n"


def of_own_keys(text: str, changes: dict[str, tuple[str, tuple[str, ...]]]) -> Iterator[tuple[str, str]]:
    """(category, content) of each change of a value."""
    for category, (old, others) in changes.items():
        yield from ((category, replaced(text, old, other)) for other in others)


def _sweep(category: str, content: bytes | str, *, certain: bool = True) -> Case:
    # The output is taken: a sweep in order is refused for that, before anything is trained.
    def build(folder: Path) -> None:
        write(folder / "mine.yaml", content)
        write(folder / "taken", "precious")

    command = ("study", "sweep", "mine.yaml", "--output", "taken", "--jobs", "1")
    return Case("sweep", category, command, build, certain=certain, reader=_reader(certain, _planned), content=content)


def _planned() -> object:
    return SweepPlan.read("mine.yaml")


def _worlds(category: str, content: bytes | str, *, certain: bool = True) -> Case:
    return Case(
        "worlds",
        category,
        ("search", "falsify", "--again", "mine.yaml"),
        lambda folder: write(folder / "mine.yaml", content),
        content=content,
        certain=certain,
        # who drives, and where, is looked at when the worlds are driven
        reader=None
        if category in LATER
        else _reader(certain, lambda: NamedWorlds.read("mine.yaml").worlds_of(load_scenario("paper-random"), "x")),
    )


LATER = ("scenario of worlds", "settings of worlds", "agent of worlds", "measure")


def _reader(certain: bool, read: Callable[[], object]) -> Callable[[], object] | None:
    return read if certain else None
