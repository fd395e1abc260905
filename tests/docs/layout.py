"""``docs/internals/layout.md``: ``python -m tests.docs.layout`` makes it from the package, a test compares it."""

import argparse
import ast
import tomllib
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ethbrake_marl"
PAGE = ROOT / "docs" / "internals" / "layout.md"
BEGINNING = """# How the code is laid out

Which file does what? [Another page](reading.md) says in which order to read the core.

The core has everything that the paper's environment, training, scenarios and levels of cooperation
need. An extension is a folder whose table `parts.py` says what it adds; [no module of the core names
it](../decisions/README.md#the-core-never-names-an-extension). To delete one, delete its folder, its
folder in `tests/extensions/`, and every extension that uses it.

A module imports only from its own folder or from what this page lists below it; `make lint` checks
this. `python -m tests.docs.layout` makes this page from the code.

## Where to look

| question | file |
|---|---|
| How does one step of an episode go? | `episode/game.py`, `Game.step`; `episode/step.py`; [the game](../game.md) |
| What does one impact cost? | `motion/impact.py`; who bears it: `state.py`, `split_harm`; in infos: `infos.py` |
| How does a scenario become a game? | `worlds/`: `catalogue.py`, `game.py`; worlds are drawn in `sampling.py` |
| How do environments play it? | `faces/face.py`, on `faces/stream.py`: its episodes, drawn again when they end |
| What would happen? | `episode/play.py`: `price` (a plan); `episode/hold.py`: `hold` (constant commands) |
| Where does a number in a table come from? | `evaluation/`: `measures.py`, `statistics.py`, `summary.py` |
| Why did the shield replace an action? | `shields/step.py`: the proof, then the code; codes in `shields/shield.py` |
| What is a reward term? | `episode/terms.py` (formulas), `episode/reward.py` (weights, named rewards) |
| Which agents are there? | `parts.py`, `agents/`; what names mean: `names.py`; [add one](../extend.md#an-agent) |
| Who lets agents drive? | `agents/team.py`: `play`, `play_to_end` |
| What can a scenario file say? | `worlds/`: `scenario.py`, `quantities.py`; [scenarios](../scenarios.md) |
| How does a training run? | `training/`: `train.py`, `ppo.py`, `sac.py`; between two updates: `updates.py` |
| How do I add a column to an evaluation? | [a measure](../extend.md#a-measure) |

From a name to a number, as in `ethbrake evaluate --agents universal`:

```text
cli/evaluate.py         evaluate_command
names.py                teams_of, make_agent; parts.py says: agents/trained.py, make_trained
policies/bundle.py      load_shipped
evaluation/compared.py  Compared.of (in Python one begins with the next line)
evaluation/door.py      evaluate; worlds/sampling.py, draw_worlds: the fixed list of worlds
evaluation/evaluate.py  evaluate_teams
agents/team.py          play, and in each step:
episode/game.py         Game.step
episode/step.py         step; script_calls.py, ask_script: agents/policy_agent.py, policies/actor.py
motion/interval.py      move_line; motion/impact.py, resolve_impacts: the harm
evaluation/measures.py  harm: episode/state.py, State.harm
evaluation/summary.py   summarise; statistics.py, mean
files/sheet.py          Sheet: columns become text
```
"""
END = """
`scenarios/` has one YAML file for each scenario, `train/` one for each recipe; those of an extension
are in a subfolder of its name. The wheel contains both folders.
"""


def first_sentence(path: Path) -> str:
    text = ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""
    return " ".join(text.partition("\n\n")[0].split()).rstrip(".").replace("``", "`")


def room_of(module: str) -> str | None:
    """The folder or file of the core, or the extension, that a module of the package belongs to."""
    parts = module.split(".")
    if parts[0] != PACKAGE.name or len(parts) == 1:
        return None
    return ".".join(parts[1:3]) if parts[1] == "extensions" else parts[1]


def arrows() -> dict[str, set[str]]:
    """Each room -> the rooms from which it imports, for types too."""
    found = defaultdict[str, set[str]](set)
    for path in sorted(PACKAGE.rglob("*.py")):
        own = room_of(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if own and isinstance(node, ast.ImportFrom) and node.module:
                named = (
                    [node.module] if node.module != PACKAGE.name else [f"{node.module}.{a.name}" for a in node.names]
                )
                found[own] |= {room for each in named if (room := room_of(each)) and room != own}
    return found


def layers(folder: str) -> list[list[str]]:
    """The layers of a folder of the package in the contracts of import-linter, from the top down."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    (contract,) = (each for each in contracts if each.get("containers") == [folder])
    return [[room.strip("()") for room in layer.split(" | ")] for layer in contract["layers"]]


def table(rooms: list[list[str]], inside: str = "") -> list[str]:
    """A table of rooms: their files, and what they are."""
    folder = PACKAGE / inside
    lines = [f"| in `{folder.relative_to(ROOT).as_posix()}/` | what it holds |", "|---|---|"]
    for room in (room for layer in rooms for room in layer):
        place = folder / room
        path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        lines.append(f"| `{room}{'/' if place.is_dir() else '.py'}` | {first_sentence(path)} |")
    return lines


def page() -> str:
    core = [[room for room in layer if not room.startswith("__")] for layer in layers("ethbrake_marl")]
    core = [[room for room in layer if room != "extensions"] for layer in core]
    drawing = [" · ".join(layer) for layer in core if layer]
    extensions = layers("ethbrake_marl.extensions")
    beside = [" · ".join(layer) for layer in extensions]
    return "\n".join(
        [
            BEGINNING,
            "## The core\n",
            "This list shows the core. A folder or file uses only folders and files in the lines below it:\n",
            "```text",
            *drawing,
            "```",
            "",
            *table([layer for layer in core if layer]),
            "\n## Extensions\n",
            "An extension may use the core and the extensions in the lines below it:\n",
            "```text",
            *beside,
            "```",
            "",
            *table(extensions, "extensions"),
            END,
        ]
    )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    PAGE.write_text(page(), "utf-8")
