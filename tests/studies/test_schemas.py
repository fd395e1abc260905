"""The JSON Schemas of sweeps and tunings, asked as an editor asks them: what they let pass, and what they mark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import Draft202012Validator

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import read_yaml
from ethbrake_marl.studies.sweep import SweepFile, SweepPlan, TuningFile, TuningPlan

DOCS = Path(__file__).resolve().parents[2] / "docs"
KINDS = {"sweep": (SweepPlan.json_schema, SweepFile.read_as), "tuning": (TuningPlan.json_schema, TuningFile.read_as)}
GOOD = {"sweep": "sweep-example", "tuning": "tuning-quick"}
JOB = {"scenario": "paper-random", "recipe": "ppo"}
SPACE = {"n_epochs": {"low": 1, "high": 4}}


def _marked(kind: str, content: Any) -> set[str]:
    """The places where an editor marks a mistake; empty: the whole file."""
    found = Draft202012Validator(KINDS[kind][0]()).iter_errors(content)
    return {".".join(map(str, error.absolute_path)) for error in found}


def _parts(schema: dict[str, Any]) -> dict[str, Any]:
    return {"the file": schema, **schema["$defs"]}


@pytest.mark.parametrize("kind", KINDS)
def test_schema__is_one_and_says_what_every_key_means(kind: str) -> None:
    schema = KINDS[kind][0]()
    Draft202012Validator.check_schema(schema)
    silent = [
        f"{part}.{key}"
        for part, inner in _parts(schema).items()
        for key, value in inner["properties"].items()
        if not value.get("description")
    ]
    assert silent == []


@pytest.mark.parametrize("kind", KINDS)
def test_schema__lets_the_examples_pass(kind: str) -> None:
    examples = [*DOCS.glob(f"{kind}-*.yaml")]
    assert examples and all(_marked(kind, read_yaml(example).content) == set() for example in examples)


@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("sweep", {"grid": {**JOB, "seed": 3}}),
        ("sweep", {"grid": {"scenario": ["a", "b"], "recipe": ["ppo"], "seed": [0, 1]}, "jobs": []}),
        ("sweep", {"jobs": [{"scenario": "a", "recipe": "ppo"}]}),
        ("tuning", {"prune": None}),
        ("tuning", {"search": {"holds": {"choices": [[1], "x", 3]}}}),
        ("tuning", {"search": {"gamma": {"low": 0.5, "high": 1, "log": True}}}),
    ],
)
def test_schema__lets_pass_what_the_reader_takes(kind: str, change: dict[str, Any], tmp_path: Path) -> None:
    content = {**read_yaml(DOCS / f"{GOOD[kind]}.yaml").content, **change}
    assert _marked(kind, content) == set()
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    KINDS[kind][1](tmp_path / "mine.yaml", "scaling", "")


@pytest.mark.parametrize(
    ("kind", "change", "place"),
    [
        ("sweep", {"gird": JOB}, ""),
        ("sweep", {"grid": {**JOB, "level": "2-paper"}}, "grid"),
        ("sweep", {"grid": {"recipe": "ppo"}}, "grid"),
        ("sweep", {"grid": {**JOB, "seed": [-1]}}, "grid.seed"),
        ("sweep", {"grid": {**JOB, "seed": {"first": 1}}}, "grid.seed"),
        ("sweep", {"grid": {**JOB, "recipe": []}}, "grid.recipe"),
        ("sweep", {"grid": {**JOB, "set": {"gamma": 0.9}}}, "grid.set.gamma"),
        ("sweep", {"jobs": [{"scenario": "paper-random"}]}, "jobs.0"),
        ("sweep", {"jobs": [{**JOB, "seed": [1]}]}, "jobs.0.seed"),
        ("tuning", {"serach": SPACE}, ""),
        ("tuning", {"search": {}}, "search"),
        ("tuning", {"search": {"gamma": {"low": 0.5}}}, "search.gamma"),
        ("tuning", {"search": {"gamma": {"low": "a", "high": 1}}}, "search.gamma"),
        ("tuning", {"search": {"gamma": {"choices": [0.9]}}}, "search.gamma"),
        ("tuning", {"measure": {"worlds": 0}}, "measure.worlds"),
        ("tuning", {"prune": {"keep": 1.0}}, "prune"),
        ("tuning", {"sampler": {"name": "grid"}}, "sampler.name"),
        ("tuning", {"seed": None}, "seed"),
    ],
)
def test_schema__marks_what_the_reader_refuses(kind: str, change: dict[str, Any], place: str, tmp_path: Path) -> None:
    content = {**read_yaml(DOCS / f"{GOOD[kind]}.yaml").content, **change}
    assert _marked(kind, content) == {place}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(InvalidInput):
        KINDS[kind][1](tmp_path / "mine.yaml", "scaling", "")


@pytest.mark.parametrize(("kind", "needed"), [("sweep", {"grid", "jobs"}), ("tuning", {"search"})])
def test_schema__asks_for_what_is_missing(kind: str, needed: set[str]) -> None:
    content = read_yaml(DOCS / f"{GOOD[kind]}.yaml").content
    assert _marked(kind, {key: value for key, value in content.items() if key not in needed}) == {""}
