"""The end of ``docs/code.md``: ``python -m tests.docs.layout`` makes it from the package, a test compares it."""

import argparse
import ast
import tomllib
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ethbrake_marl"
PAGE = ROOT / "docs" / "code.md"
BEGINNING = """## Every folder

A folder or file imports only from its own folder or from the rows below it; `make lint` checks this.
`python -m tests.docs.layout` makes this list from the code.
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


def table(rooms: list[list[str]]) -> list[str]:
    """A table of rooms of the core: their files, and what they are."""
    lines = ["| in `ethbrake_marl/` | what it holds |", "|---|---|"]
    for room in (room for layer in rooms for room in layer):
        place = PACKAGE / room
        path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
        lines.append(f"| `{room}{'/' if place.is_dir() else '.py'}` | {first_sentence(path)} |")
    return lines


def page() -> str:
    core = [[room for room in layer if not room.startswith("__")] for layer in layers("ethbrake_marl")]
    core = [[room for room in layer if room != "extensions"] for layer in core]
    extensions = layers("ethbrake_marl.extensions")
    return "\n".join(
        [
            PAGE.read_text("utf-8").partition(BEGINNING.partition("\n")[0])[0] + BEGINNING,
            *table([layer for layer in core if layer]),
            "\n### Extensions\n",
            "An extension is a folder whose table `contents.py` says what it adds; [no module of the core names",
            "it](decisions/README.md#the-core-never-names-an-extension). It may use the core and the extensions in",
            "the lines below it; the docstring of its folder says what it holds. To delete one, delete its folder, its",
            "folder in `tests/extensions/`, and every extension that uses it.\n",
            "```text",
            *(" · ".join(layer) for layer in extensions),
            "```",
            END,
        ]
    )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    PAGE.write_text(page(), "utf-8")
