"""The documentation site, as far as it can be looked at without Sphinx; `make docs` builds it."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.policies import shipped_policies
from ethbrake_marl.scenario import list_scenarios, new_scenario_text
from tests.docs.site import DOCS, load

ROOT = DOCS.parent


pages = load("pages")


api = load("api")


reference = load("reference")


def test_list_of_pages__has_every_page_once_in_five_sections() -> None:
    sections = pages.read_sections((DOCS / "README.md").read_text("utf-8"))
    assert list(sections) == ["Start here", "Tutorials", "How-to", "Reference", "Explanation"]
    listed = [page for each in sections.values() for page in each]
    there = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md") if "_build" not in path.parts}
    records = {page for page in there if re.match(r"(decisions|results)/(?!README)|api/", page)}
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


def test_public_names__stand_once_each_on_the_pages_by_task(monkeypatch: pytest.MonkeyPatch) -> None:
    api.check_pages()
    shown = "".join(api.add_public_names(path.read_text("utf-8")) for path in api.PAGES.glob("*.md"))
    assert all(f":: ethbrake_marl.{name}\n" in shown for name in eb.__all__ if name != "__version__")
    links = set(re.findall(r"\]\((api/.*?)\)", (DOCS / "api.md").read_text("utf-8")))
    assert links == {f"api/{path.name}" for path in api.PAGES.glob("*.md")}
    monkeypatch.setattr(api.ethbrake_marl, "__all__", [*eb.__all__, "planted"])
    with pytest.raises(ValueError, match="each public name belongs on one page of docs/api: planted"):
        api.check_pages()


def test_public_name__without_a_docstring_stops_the_build(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eb, "Policy", type("Planted", (), {}))
    with pytest.raises(ValueError, match="the public name Policy has no docstring"):
        api.add_public_names("```{public}\nPolicy\n```")


def test_reference__is_made_of_the_code_below_a_short_beginning() -> None:
    assert {path.stem for path in (DOCS / "reference").glob("*.md")} | {"cli", "shipped-policies"} == {
        name.removeprefix("reference/") for name in reference.COMPLETED
    }
    for name, make in reference.COMPLETED.items():
        assert len((DOCS / f"{name}.md").read_text("utf-8").split()) < 120
        made = make()
        assert made.count("| --- |") >= 1 and "m/s2" not in re.sub("`.*?`", "", made), name
    commands = reference.COMPLETED["cli"]()
    assert "\n### train resume\n" in commands and "| `--other-versions` |" in commands
    assert "`ethbrake train` alone is `ethbrake train start`." in commands
    assert "| `mass_t` | mass of each vehicle | (0, 1000] t | required |" in reference.scenario_keys()


def test_cards__are_those_of_the_shipped_policies() -> None:
    names = shipped_policies()
    assert set(re.findall(r"^## (\S+)$", pages.add_cards(""), re.MULTILINE)) == set(names)
    assert all(f"| [`{name}`](#{name}) |" in reference.policies() for name in names)


def test_extra__brings_what_the_configuration_loads() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    brought = {re.split(r"[<>=]", line)[0] for line in project["optional-dependencies"]["docs"]}
    extensions = re.search(r"^extensions = \[(.*)\]$", (DOCS / "conf.py").read_text("utf-8"), re.MULTILINE)
    assert extensions is not None
    named = re.findall(r'"([a-z_]+)[".]', extensions[1])
    assert {name.replace("_", "-") for name in named if name != "extension"} | {"furo"} == brought


QUESTIONS = {
    "train ppo": "howto-train",
    "add scenario": "add-a-scenario",
    "cooperation level": "cooperation",
    "shield my policy": "shield",
    "own vehicle data": "own-vehicle-data",
    "install without torch": "installing",
    "what is harm": "harms",
    "E-V2X-BM": "baselines",
    "reward": "rewards",
    "pettingzoo wrapper": "environment",
}


@pytest.mark.parametrize("question", QUESTIONS)
def test_search__is_told_the_page_that_answers_a_question_of_somebody_new(question: str) -> None:
    asked = set(re.findall(r"\w+", question.lower())) - {"is"}  # a word that the search passes over
    sought = load("sought").SOUGHT
    assert all((DOCS / f"{page}.md").exists() for page in sought)

    def words(page: str, text: str) -> set[str]:
        title = (DOCS / f"{page}.md").read_text("utf-8").partition("\n")[0]
        return asked.intersection(re.findall(r"\w+", f"{title} {text}".lower()))

    told = {page: len(words(page, text)) for page, text in sought.items()}
    assert [page for page, count in told.items() if count == len(asked)] == [QUESTIONS[question]]


def test_demonstration__plays_the_picture_of_the_first_page_and_says_it_in_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    demo = load("demo")
    monkeypatch.setattr(demo, "WORLDS", (0,))
    monkeypatch.setattr(demo, "AGENTS", {"Full braking": "full_brake", demo.OWN: ""})
    monkeypatch.setattr(demo, "TESTS", {"Main test": demo.TESTS["Main test"]})
    page = demo.add_demonstration((ROOT / "README.md").read_text("utf-8"))
    assert (
        "Vehicle 2 strikes Vehicle 1 after 2.17 s at 2.4 m/s; Vehicle 3 strikes Vehicle 2 after 3.30 s at 5.3" in page
    )
    assert page.index('class="demo"') < page.index("## Quick start") and page.count('"pieces":') == 2
    with pytest.raises(ValueError, match="no heading 'Quick start'"):
        demo.add_demonstration("# Another README")


GUIDES = ("CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md", "PULL_REQUEST_TEMPLATE.md")


def test_version__is_the_same_wherever_it_stands() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert project["version"] == eb.__version__ == citation["version"]
    assert f"version = {{{eb.__version__}}}" in (ROOT / "README.md").read_text("utf-8")
    assert citation["license"] == project["license"]
    assert [author["name"] for author in citation["authors"]] == [author["name"] for author in project["authors"]]


@pytest.mark.parametrize(
    ("command", "file"),
    [
        ("scenario schema", "scenarios/scenario"),
        ("recipe schema", "train/recipe"),
        ("study sweep --schema", "docs/sweep"),
        ("study tune --schema", "docs/tuning"),
    ],
)
def test_schema__that_ships_is_printed_by_the_command_and_named_by_templates_and_examples(
    command: str, file: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(command.split()) == 0
    assert (ROOT / f"{file}.schema.json").read_text("utf-8") == capsys.readouterr().out
    texts = {"scenarios": [new_scenario_text("mine")], "train": [eb.load_recipe("ppo").new_text("mine")]}
    texts["docs"] = [each.read_text("utf-8") for each in ROOT.glob(f"{file}-*.yaml")]
    named = f"# yaml-language-server: $schema={Path(file).name}.schema.json\n"
    assert [text for text in texts[Path(file).parent.name] if named not in text] == []


def test_schemas__are_no_scenario_and_no_recipe() -> None:
    assert all(
        path.suffix == ".yaml" for path in (*eb.TrainingRecipe.shipped().values(), *(e.path for e in list_scenarios()))
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


MOST_CHARACTERS = 100
PAGES = sorted([ROOT / "README.md", *ROOT.glob(".github/*.md"), *DOCS.glob("*.md"), *DOCS.glob("[aprt]*/*.md")])
CODE = re.compile(r"^\s*(```+|~~~+|:::+).*?^\s*\1\s*$", re.DOTALL | re.MULTILINE)
FREE = re.compile(r"\s*(\||#|<|!\[)|    |\[[\w-]+\]: |\s*([-*] )?\S+$")  # tables, headings, HTML, code, one word


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_page__has_short_lines_and_code_blocks_on_lines_of_their_own(path: Path) -> None:
    text = path.read_text("utf-8")
    prose = CODE.sub("", text).splitlines()
    assert [line for line in prose if len(line) > MOST_CHARACTERS and not FREE.match(line)] == []
    broken = re.compile(r"\S.*```|```\S+ .*\S *```")
    assert [line for line in text.splitlines() if broken.search(line) and "````" not in line] == []


def test_readme__is_short_and_begins_with_a_moving_picture_of_less_than_300_kb() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 120
    found = re.search(r"!\[[^\]]*\]\(([^)]*\.svg)\)", text)
    assert found is not None and found.start() < text.index("\n## ")
    picture = (ROOT / found[1]).read_bytes()
    assert b"<animate" in picture and len(picture) < 300_000
