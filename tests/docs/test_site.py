"""The documentation site, as far as it can be looked at without Sphinx; `make docs` builds it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

import ethbrake_marl as eb
from ethbrake_marl.policies import shipped_policies
from tests.docs.site import DOCS, load

ROOT = DOCS.parent
pages = load("pages")
api = load("api")


def test_list_of_pages__has_every_page_once_in_five_sections() -> None:
    sections = pages.read_sections((DOCS / "README.md").read_text("utf-8"))
    assert list(sections) == ["Start here", "Tutorials", "How-to", "Reference", "Explanation"]
    listed = [page for each in sections.values() for page in each]
    there = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md") if "_build" not in path.parts}
    records = {page for page in there if re.match(r"decisions/\d", page)}
    assert len(listed) == len(set(listed))
    assert set(listed) == there - records - {"README.md", "index.md"}


@pytest.mark.parametrize(
    ("link", "docname", "written_in", "led"),
    [
        ("[a](docs/shield.md#how)", "index", ROOT, "[a](shield.md#how)"),
        ("[a](CHANGELOG.md)", "index", ROOT, "[a](changelog.md)"),
        ("[a](../CHANGELOG.md)", "README", None, "[a](changelog.md)"),
        ("[a](../../README.md)", "tutorials/first-ten-minutes", None, "[a](../index.md)"),
        ("[a](../README.md#x)", "tutorials/first-ten-minutes", None, "[a](../index.md#x)"),
        ("[a](../train/ppo.yaml)", "learning", None, "[a](../train/ppo.yaml)"),
        ("[a](../ethbrake_marl/_policies/ppo/card.md)", "learning", None, "[a](shipped-policies.md#ppo)"),
        ("[a](nowhere.md) [b](https://x.org/y) [c](#here)", "index", ROOT, None),
    ],
)
def test_links__of_a_page_lead_to_the_page_on_the_site(
    link: str, docname: str, written_in: Path | None, led: str | None
) -> None:
    assert pages.relink(link, docname, written_in) == (led or link)


def test_public_names__stand_once_each_on_their_page() -> None:
    groups = api.read_groups((ROOT / "ethbrake_marl" / "__init__.py").read_text("utf-8"))
    listed = [name for names in groups.values() for name in names]
    assert sorted([*listed, "__version__"]) == sorted(eb.__all__)
    page = api.add_public_names("# Python interface")
    assert all(f":: ethbrake_marl.{name}\n" in page for name in listed)
    assert all(f"\n## {title}\n" in page for title in groups)


def test_public_name__without_a_docstring_stops_the_build(monkeypatch: pytest.MonkeyPatch) -> None:
    class Planted:
        pass

    monkeypatch.setattr(eb, "Policy", Planted)
    with pytest.raises(ValueError, match="the public name Policy has no docstring"):
        api.add_public_names("# Python interface")


def test_page_of_shipped_policies__links_and_holds_every_card() -> None:
    text = (DOCS / "shipped-policies.md").read_text("utf-8")
    names = re.findall(r"^\| \[`(.*?)`\]\(\.\./ethbrake_marl/_policies/\1/card\.md\)", text, re.MULTILINE)
    assert set(names) == set(shipped_policies())
    assert set(re.findall(r"^## (\S+)$", pages.add_cards(text), re.MULTILINE)) == set(names)


def test_extra__brings_what_the_configuration_loads() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    brought = {re.split(r"[<>=]", line)[0] for line in project["optional-dependencies"]["docs"]}
    extensions = re.search(r"^extensions = \[(.*)\]$", (DOCS / "conf.py").read_text("utf-8"), re.MULTILINE)
    assert extensions is not None
    named = re.findall(r'"([a-z_]+)[".]', extensions[1])
    assert {name.replace("_", "-") for name in named if name != "extension"} | {"furo"} == brought
