"""What a release and a stranger need, beside the package: version, citation, guides, shipped schema."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.learning.training import TrainingRecipe, load_recipe
from ethbrake_marl.scenario import list_scenarios, new_scenario_text, scenario_json_schema
from tests.docs.site import DOCS

ROOT = DOCS.parent
GUIDES = ("CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md", "PULL_REQUEST_TEMPLATE.md")


def test_version__is_the_same_wherever_it_stands() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert project["version"] == eb.__version__ == citation["version"]
    assert f"version = {{{eb.__version__}}}" in (ROOT / "README.md").read_text("utf-8")
    assert citation["license"] == project["license"]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in project["authors"]]


@pytest.mark.parametrize(
    ("file", "schema", "text"),
    [
        ("scenarios/scenario.schema.json", scenario_json_schema, new_scenario_text),
        ("train/recipe.schema.json", TrainingRecipe.json_schema, lambda name: load_recipe("ppo").new_text(name)),
    ],
)
def test_schema__that_ships_is_the_one_that_the_command_prints(
    file: str, schema: Callable[[], dict[str, Any]], text: Callable[[str], str]
) -> None:
    assert (ROOT / file).read_text("utf-8") == json.dumps(schema(), indent=2) + "\n"
    assert f"# yaml-language-server: $schema={Path(file).name}\n" in text("mine")


@pytest.mark.parametrize(("command", "file"), [("sweep", "sweep"), ("tune", "tuning")])
def test_schema__of_sweeps_and_tunings_is_printed_by_the_command_and_named_by_the_examples(
    command: str, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["study", command, "--schema"]) == 0
    assert (ROOT / "docs" / f"{file}.schema.json").read_text("utf-8") == capsys.readouterr().out
    for example in (ROOT / "docs").glob(f"{file}-*.yaml"):
        assert example.read_text("utf-8").startswith(f"# yaml-language-server: $schema={file}.schema.json\n")


def test_schemas__are_no_scenario_and_no_recipe() -> None:
    assert all(
        path.suffix == ".yaml" for path in (*TrainingRecipe.shipped().values(), *(e.path for e in list_scenarios()))
    )


@pytest.mark.parametrize("name", GUIDES)
def test_guide__has_links_that_lead_somewhere(name: str) -> None:
    text = (ROOT / ".github" / name).read_text("utf-8")
    links = re.findall(r"\]\((?!https?:)([^)#\s]+)", text)
    assert [link for link in links if not (ROOT / ".github" / link).exists()] == []


def test_hooks__run_tools_of_the_environment_and_download_nothing() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"]
    assert [repo["repo"] for repo in hooks] == ["local"]
    assert all(hook["entry"].startswith(".venv/bin/") for repo in hooks for hook in repo["hooks"])
