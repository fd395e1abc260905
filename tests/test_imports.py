"""The package imports one way, without a circle, and importing it stays light."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "ethbrake_marl"

# From the bottom up. A module imports what stands on lower levels, or in its own folder; folders of one level do not
# import each other.
LEVELS: tuple[tuple[str, ...], ...] = (
    ("errors", "progress"),
    ("files", "physics"),
    ("harm", "actions"),
    ("objectives",),
    ("scenario",),
    ("observations", "rewards"),
    ("engine",),
    ("search",),
    ("agents",),
    ("limits", "envs"),
    ("ethbrake_v0",),
    ("shield", "policies"),
    ("evaluation",),
    ("learning", "figures"),
    ("pages",),
    ("__init__",),
    ("studies",),
    ("cli",),
    ("__main__",),
)
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}

TORCH = ("torch", "torchrl", "tensordict", "safetensors.torch")


@dataclass(frozen=True)
class Arrow:
    """One import: the room and line that import, and the dotted name that is imported."""

    room: str
    where: str
    target: str

    @property
    def target_room(self) -> str | None:
        """The package's room that is imported, or None for another distribution."""
        top, *rest = self.target.split(".")
        return (rest[0] if rest else "__init__") if top == PACKAGE else None


def modules(package: Path) -> Iterator[tuple[str, Path]]:
    """(room, file) of every module of the package."""
    for path in sorted(package.rglob("*.py")):
        yield path.relative_to(package).parts[0].removesuffix(".py"), path


def imported_names(tree: ast.AST, parent: tuple[str, ...]) -> Iterator[tuple[int, str, tuple[str, ...]]]:
    """(line, module, names taken from it) of every import, at any depth, `import_module("...")` included."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name, ()
        elif isinstance(node, ast.ImportFrom):
            base = parent[: len(parent) - node.level + 1] if node.level else ()
            module = ".".join([*base, *([node.module] if node.module else [])])
            yield node.lineno, module, tuple(alias.name for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            function = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if function in ("import_module", "__import__") and isinstance(node.args[0].value, str):
                yield node.lineno, node.args[0].value, ()


def arrows(package: Path) -> list[Arrow]:
    """Every import of every module; `from package import room` points at the room."""
    found = []
    rooms = {room for room, _ in modules(package)}
    for room, path in modules(package):
        parent = (PACKAGE, *path.relative_to(package).parent.parts)
        for line, module, names in imported_names(ast.parse(path.read_text("utf-8")), parent):
            where = f"{path.relative_to(package)}:{line}"
            targets = [f"{module}.{name}" for name in names] or [module]
            if module == PACKAGE:
                targets = [target if target.split(".")[-1] in rooms else PACKAGE for target in targets]
            found += [Arrow(room, where, target) for target in targets]
    return found


def upward(found: list[Arrow]) -> list[str]:
    """The arrows that point up, or sideways to another folder of the same level."""
    inside = [(a, a.target_room) for a in found if a.target_room is not None and a.target_room != a.room]
    return [
        f"{arrow.where}: {arrow.room} imports {arrow.target}"
        for arrow, target in inside
        if LEVEL[target] >= LEVEL[arrow.room]
    ]


def circles(package: Path) -> list[tuple[str, ...]]:
    """Modules that import each other in a circle, those inside one folder too, imports for types included."""
    files = {module_name(package, path): path for _, path in modules(package)}
    graph: dict[str, set[str]] = {name: set() for name in files}
    for name, path in files.items():
        parent = (PACKAGE, *path.relative_to(package).parent.parts)
        for _, module, names in imported_names(ast.parse(path.read_text("utf-8")), parent):
            for target in [f"{module}.{each}" for each in names] or [module]:
                found = target if target in files else module
                if found in files and found != name:
                    graph[name].add(found)
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as error:
        return [tuple(error.args[1])]
    return []


def module_name(package: Path, path: Path) -> str:
    """The dotted name of a file of the package; of a folder for its ``__init__``."""
    parts = (PACKAGE, *path.relative_to(package).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def misplaced_matplotlib(found: list[Arrow]) -> list[str]:
    """The arrows to matplotlib from outside figures/."""
    return [f"{a.where}: {a.target}" for a in found if a.target.split(".")[0] == "matplotlib" and a.room != "figures"]


def misplaced_torch(found: list[Arrow]) -> list[str]:
    """The arrows to torch from outside learning/ and agents/learned.py."""
    return [
        f"{arrow.where}: {arrow.target}"
        for arrow in found
        if any(arrow.target == name or arrow.target.startswith(f"{name}.") for name in TORCH)
        and arrow.room != "learning"
        and not arrow.where.startswith("agents/learned.py:")
    ]


def planted(folder: Path, files: dict[str, str]) -> list[Arrow]:
    """The arrows of a small package written for one test."""
    for name, source in files.items():
        path = folder / PACKAGE / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source, "utf-8")
    return arrows(folder / PACKAGE)


def test_import_order__every_module_stands_in_a_known_room() -> None:
    rooms = {room for room, _ in modules(ROOT / PACKAGE)}
    assert "physics" in rooms
    assert rooms <= set(LEVEL), f"give these a level in LEVELS: {sorted(rooms - set(LEVEL))}"


def test_readme__shows_the_levels_from_the_top_down() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    rows = text[text.index("| in `ethbrake_marl/` |") :].split("\n\n")[0].splitlines()[2:]
    shown = [name.strip("`/").removesuffix(".py") for row in rows for name in row.split("|")[1].strip().split(", ")]
    levels = [LEVEL[name] for name in shown]
    assert levels == sorted(levels, reverse=True)
    assert set(shown) == {room for room, _ in modules(ROOT / PACKAGE)} - {"__init__", "__main__"}


def test_import_order__no_arrow_points_up() -> None:
    found = arrows(ROOT / PACKAGE)
    assert any(arrow.target_room == "physics" for arrow in found)
    assert upward(found) == []


def test_import_order__has_no_circle() -> None:
    assert circles(ROOT / PACKAGE) == []


def test_import_order__finds_a_planted_circle_inside_a_folder(tmp_path: Path) -> None:
    files = {
        "physics/__init__.py": "",
        "physics/worlds.py": "if TYPE_CHECKING:\n    from ethbrake_marl.physics.advance import advance",
        "physics/advance.py": "from ethbrake_marl.physics import impact",
        "physics/impact.py": "def later():\n    from ethbrake_marl.physics.worlds import Worlds",
    }
    planted(tmp_path, files)
    (found,) = circles(tmp_path / PACKAGE)
    assert {name.split(".")[-1] for name in found} == {"worlds", "advance", "impact"}


def test_torch__is_imported_only_where_policies_live() -> None:
    assert misplaced_torch(arrows(ROOT / PACKAGE)) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("physics/advance.py", "from ethbrake_marl.harm import Ledger"),
        ("physics/advance.py", "from ..harm import Ledger"),
        ("physics/advance.py", "from .. import harm"),
        ("physics/deep/events.py", "from ...harm import Ledger"),
        ("physics/__init__.py", "from ..harm import Ledger"),
        ("physics/advance.py", "import ethbrake_marl.harm as ledger"),
        ("physics/advance.py", "from ethbrake_marl import harm"),
        ("physics/advance.py", "from ethbrake_marl import load_scenario"),
        ("physics/advance.py", "import ethbrake_marl"),
        ("physics/advance.py", "def later():\n    from ethbrake_marl.harm import Ledger"),
        ("physics/advance.py", "if TYPE_CHECKING:\n    from ethbrake_marl.harm import Ledger"),
        ("physics/advance.py", "importlib.import_module('ethbrake_marl.harm')"),
        ("errors.py", "from ethbrake_marl.physics import advance"),
        ("engine/engine.py", "from ethbrake_marl.cli.app import main"),
    ],
)
def test_import_order__finds_a_planted_upward_arrow(tmp_path: Path, name: str, source: str) -> None:
    found = planted(tmp_path, {"harm.py": "", "cli/app.py": "", name: source})
    assert len(upward(found)) == 1
    assert upward(found)[0].startswith(f"{name}:")


def test_import_order__accepts_what_points_down_or_stays_in_the_room(tmp_path: Path) -> None:
    files = {
        "harm.py": "import numpy\nfrom ethbrake_marl.physics.worlds import Worlds\nfrom ethbrake_marl import physics",
        "physics/advance.py": "from ethbrake_marl.physics.worlds import Worlds\nfrom .impact import collide",
        "learning/train.py": "from ethbrake_marl.evaluation import evaluate",
        "cli/app.py": "from ethbrake_marl import load_scenario",
    }
    assert upward(planted(tmp_path, files)) == []


def test_import_order__folders_of_one_level_do_not_import_each_other(tmp_path: Path) -> None:
    files = {"learning/ppo.py": "from ethbrake_marl.figures import style", "figures/style.py": ""}
    assert len(upward(planted(tmp_path, files))) == 1


def test_package__imports_nothing_from_the_tests() -> None:
    assert [arrow for arrow in arrows(ROOT / PACKAGE) if arrow.target.split(".")[0] == "tests"] == []


def test_matplotlib__is_imported_only_in_figures(tmp_path: Path) -> None:
    assert misplaced_matplotlib(arrows(ROOT / PACKAGE)) == []
    files = {"studies/speed.py": "def draw():\n    from matplotlib.figure import Figure", "figures/style.py": ""}
    assert len(misplaced_matplotlib(planted(tmp_path, files))) == 1


@pytest.mark.parametrize(
    ("name", "source", "misplaced"),
    [
        ("engine/engine.py", "import torch", True),
        ("envs/sb3.py", "def step():\n    from torch.nn import Linear", True),
        ("agents/constant.py", "from safetensors import torch", True),
        ("agents/constant.py", "from safetensors.numpy import load_file", False),
        ("engine/engine.py", "import torchlight", False),
        ("learning/ppo.py", "import torch", False),
        ("agents/learned.py", "import torch.nn as nn", False),
    ],
)
def test_torch__a_planted_import_is_judged_by_its_place(
    tmp_path: Path, name: str, source: str, misplaced: bool
) -> None:
    assert len(misplaced_torch(planted(tmp_path, {name: source}))) == misplaced


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("ethbrake_marl", ("torch", "matplotlib", "stable_baselines3")),
        ("ethbrake_marl.cli.app", ("torch", "stable_baselines3")),
    ],
)
def test_import__loads_nothing_heavy_and_says_nothing(module: str, heavy: tuple[str, ...]) -> None:
    program = f"import sys, {module}; sys.exit(', '.join(sorted(set({heavy!r}) & set(sys.modules))) or None)"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
