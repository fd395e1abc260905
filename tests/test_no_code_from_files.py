"""What would run code that a file brings along is used nowhere in the package but in the places that are named.

`make lint` refuses it: ruff's bans, with the places, stand in pyproject.toml. docs/internals/bundles.md says why none
of them runs a stranger's file. What ruff has no rule for is looked for here.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
RULES = "TID251,S102,S307,S602,S604,S605"
UNRULED = re.compile(
    r"(?<![.\w])(?<!def )(?:compile|__import__)\(|\.extractall\b|\.(?:to|read)_pickle\b|unsafe_load"
    r"|allow_pickle=(?!False)|\.load\([^)]*\b(?:device|map_location|weights_only|custom_objects)="
)
PLACES = {"ethbrake_marl/files/python_file.py"}  # a file that the user names is code


def refused(*arguments: str, text: str = "") -> dict[str, set[int]]:
    """Lines that ruff refuses, by file."""
    command = [sys.executable, "-m", "ruff", "check", "--no-cache", "--select", RULES, "--output-format", "json"]
    done = subprocess.run([*command, *arguments], cwd=ROOT, input=text, capture_output=True, text=True, check=False)
    found: dict[str, set[int]] = {}
    for each in json.loads(done.stdout):
        found.setdefault(Path(each["filename"]).name, set()).add(each["location"]["row"])
    return found


def test_package__runs_no_code_from_files_but_in_the_named_places() -> None:
    assert refused("ethbrake_marl", "train") == {}
    files = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in ROOT.glob("ethbrake_marl/**/*.py")}
    assert {file for file, text in files.items() if UNRULED.search(text)} == PLACES


PLANTED = """\
import pickle
from pickle import loads
import cloudpickle as c
import marshal, shelve
eval("1")
exec(text)
yaml.load(text, Loader=yaml.SafeLoader)
y.unsafe_load(text)
from yaml import load
torch.load(path)
t.load(path, weights_only=True)
from torch import load as read
np.lib.format.read_array(file)
subprocess.run(line, shell=True)
os.system(line)
importlib.util.spec_from_file_location(a, b)
import runpy, code
joblib.load(path)
"""
USUAL = "import importlib.util, joblib, os, subprocess, numpy as np, torch, torch as t, yaml, yaml as y\n"


def test_planted__is_refused() -> None:
    lines = PLANTED.count("\n")
    found = refused("--stdin-filename", "ethbrake_marl/planted.py", "-", text=USUAL + PLANTED)
    assert found == {"planted.py": {*range(2, lines + 2)}}


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("compile(text)", True), ("re.compile(text)", False), ("torch.compile(model)", False), ("__import__(a)", True),
        ("open_archive(path).extractall(folder)", True), ("frame.to_pickle(path)", True), ("json.load(file)", False),
        ("np.load(path, allow_pickle=given)", True), ("np.load(path, allow_pickle=False)", False),
        ("classes[name].load(path, device='cpu')", True), ("yaml.unsafe_load(text)", True),
    ],
)  # fmt: skip
def test_planted__is_found_where_ruff_has_no_rule(source: str, told: bool) -> None:
    assert (UNRULED.search(source) is not None) == told
