"""What a release and a stranger need, beside the package: version, citation, guides, shipped schema."""

from __future__ import annotations

import json
import re
import tomllib

import pytest
import yaml

import ethbrake_marl as eb
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


def test_schema__that_ships_is_the_one_that_the_command_prints() -> None:
    shipped = (ROOT / "scenarios" / "scenario.schema.json").read_text("utf-8")
    assert shipped == json.dumps(scenario_json_schema(), indent=2) + "\n"
    assert "# yaml-language-server: $schema=scenario.schema.json\n" in new_scenario_text("mine")
    assert all(entry.path.suffix == ".yaml" for entry in list_scenarios())


@pytest.mark.parametrize("name", GUIDES)
def test_guide__has_links_that_lead_somewhere(name: str) -> None:
    text = (ROOT / ".github" / name).read_text("utf-8")
    links = re.findall(r"\]\((?!https?:)([^)#\s]+)", text)
    assert [link for link in links if not (ROOT / ".github" / link).exists()] == []


def test_hooks__run_tools_of_the_environment_and_download_nothing() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text("utf-8"))["repos"]
    assert [repo["repo"] for repo in hooks] == ["local"]
    assert all(hook["entry"].startswith(".venv/bin/") for repo in hooks for hook in repo["hooks"])
