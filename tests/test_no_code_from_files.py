"""What would run code that a file brings along is used nowhere in the package but in the places that are named here."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.test_imports import tree_of

ROOT = Path(__file__).resolve().parents[1]


# File -> what it alone may use. docs/security.md says why each is none of a stranger's files.
PLACES = {
    "ethbrake_marl/physics/compiling.py": {"pickle"},  # machine code that this user, or root, has compiled
    "ethbrake_marl/studies/jobs.py": {"pickle"},  # calls between processes of our own
    "ethbrake_marl/files/plugins.py": {"exec", "compile"},  # a plug-in that the user names is code
}


MODULES = {"pickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "joblib", "runpy", "code", "codeop"}


BUILTINS = {"eval", "exec", "compile", "__import__"}


FUNCTIONS = {
    *(f"yaml.{name}" for name in ("load", "load_all", "unsafe_load", "unsafe_load_all", "full_load", "full_load_all")),
    *(f"yaml.{name}" for name in ("Loader", "UnsafeLoader", "FullLoader")),
    *("torch.load", "torch.jit.load", "torch.package", "numpy.lib.format.read_array", "pandas.read_pickle"),
    *("os.system", "os.popen", "shutil.unpack_archive", "importlib.util.spec_from_file_location"),
    *("subprocess.getoutput", "subprocess.getstatusoutput"),
}


OF_A_MODEL = {"device", "map_location", "weights_only", "custom_objects"}  # arguments of what unpickles a model


METHODS = {"extractall", "to_pickle", "read_pickle", "unsafe_load"}


def forbidden(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """(line, what) of everything in a file that could run code from another file."""
    named = _imported(tree)
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        match node:
            case ast.Import() | ast.ImportFrom():
                names = _names_of(node)
                yield from ((line, name) for name in names if name.split(".")[0] in MODULES or name in FUNCTIONS)
            case ast.Name(id=name) if name in BUILTINS:
                yield line, name
            case ast.Attribute(attr=name):
                whole = _dotted(node, named)
                if whole in FUNCTIONS or name in METHODS or whole.removeprefix("builtins.") in BUILTINS:
                    yield line, whole or name
            case ast.Call(func=ast.Attribute(attr="load"), keywords=given) if {each.arg for each in given} & OF_A_MODEL:
                yield line, "load"
            case ast.keyword(arg="shell" | "allow_pickle", value=ast.Constant(value=False)):
                pass
            case ast.keyword(arg="shell" | "allow_pickle" as name, value=value):
                yield value.lineno, f"{name}="


def _names_of(node: ast.Import | ast.ImportFrom) -> list[str]:
    names = [alias.name for alias in node.names]
    if isinstance(node, ast.Import):
        return names
    return [] if node.level else [*{node.module or ""}, *(f"{node.module}.{name}" for name in names)]


def _imported(tree: ast.Module) -> dict[str, str]:
    """Local name -> the module, or what of a module, it stands for."""
    found = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.split(".")[0]
                found[alias.asname or top] = alias.name if alias.asname else top
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _dotted(node: ast.expr, named: dict[str, str]) -> str:
    """``np.lib.format.read_array`` with the module's own name in front; empty for what is no chain of names."""
    if isinstance(node, ast.Name):
        return named.get(node.id, node.id)
    if isinstance(node, ast.Attribute):
        front = _dotted(node.value, named)
        return front and f"{front}.{node.attr}"
    return ""


def offences(root: Path) -> list[str]:
    """Every use below ``root`` that its place may not have; a named place that no longer needs its leave, too."""
    found, used = [], {(file, what) for file, every in PLACES.items() for what in every}
    for path in sorted((*root.glob("ethbrake_marl/**/*.py"), *root.glob("train/*.py"))):
        file = path.relative_to(root).as_posix()
        for line, what in forbidden(tree_of(path)):
            top = what.split(".")[0]
            if top in PLACES.get(file, ()):
                used.discard((file, top))
            else:
                found.append(f"{file}:{line}: {what}")
    return [*found, *(f"{file}: may use {what}, and does not" for file, what in sorted(used))]


def test_package__runs_no_code_from_files_but_in_the_named_places() -> None:
    assert offences(ROOT) == []


PLANTED = {
    "import pickle": "pickle",
    "from pickle import loads": "pickle",
    "import cloudpickle as c": "cloudpickle",
    "import marshal": "marshal",
    "import shelve": "shelve",
    "eval('1')": "eval",
    "run = exec": "exec",
    "import builtins\nbuiltins.eval('1')": "builtins.eval",
    "__import__(name)": "__import__",
    "import yaml\nyaml.load(text, Loader=yaml.SafeLoader)": "yaml.load",
    "import yaml as y\ny.unsafe_load(text)": "yaml.unsafe_load",
    "from yaml import load": "yaml.load",
    "import torch\ntorch.load(path)": "torch.load",
    "import torch as t\nt.load(path, weights_only=True)": "torch.load",
    "from torch import load as read": "torch.load",
    "classes[name].load(path, device='cpu')": "load",
    "archive.extractall(folder)": "archive.extractall",
    "open_archive(path).extractall(folder)": "extractall",
    "import numpy as np\nnp.load(path, allow_pickle=True)": "allow_pickle=",
    "import numpy as np\nnp.load(path, allow_pickle=given)": "allow_pickle=",
    "import numpy as np\nnp.lib.format.read_array(file)": "numpy.lib.format.read_array",
    "import subprocess\nsubprocess.run(line, shell=True)": "shell=",
    "import os\nos.system(line)": "os.system",
    "import importlib.util\nimportlib.util.spec_from_file_location(a, b)": "importlib.util.spec_from_file_location",
}  # fmt: skip


@pytest.mark.parametrize("source", PLANTED)
def test_planted__is_found_in_a_file_of_the_package(source: str, tmp_path: Path) -> None:
    for file in PLACES:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).write_bytes((ROOT / file).read_bytes())
    (tmp_path / "ethbrake_marl" / "planted.py").write_text(source)
    found = {each.split(": ", 1)[1].removesuffix(".loads") for each in offences(tmp_path)}
    assert found - {"load"} == {PLANTED[source]} - {"load"} and PLANTED[source] in found


@pytest.mark.parametrize(
    "source",
    [
        "import re\nre.compile(text)",
        "import torch\ntorch.compile(model)",
        "import yaml\nyaml.safe_load(text)",
        "import json\njson.load(file)",
        "import numpy as np\nnp.load(file, allow_pickle=False)",
        "import subprocess\nsubprocess.run(words, shell=False)",
    ],
)
def test_harmless__is_left_alone(source: str) -> None:
    assert [*forbidden(ast.parse(source))] == []


def test_leave__that_is_no_longer_needed_is_told(tmp_path: Path) -> None:
    assert offences(tmp_path) == [
        "ethbrake_marl/files/plugins.py: may use compile, and does not",
        "ethbrake_marl/files/plugins.py: may use exec, and does not",
        "ethbrake_marl/physics/compiling.py: may use pickle, and does not",
        "ethbrake_marl/studies/jobs.py: may use pickle, and does not",
    ]
