"""What the pages show is what is printed, each with its place; the pages and the reference of the site."""

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_harm
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.scenario.catalogue import list_scenarios, load_scenario, new_scenario_text
from ethbrake_marl.scenario.tables import worlds_from_table
from tests.docs.printed import (
    BLOCKS,
    EXACT,
    MEASURED,
    PICTURES,
    ROOT,
    TABLES,
    How,
    Shown,
    agrees,
    commands_of,
    how,
    missing_figures,
    pages,
    pictures,
    printed_blocks,
    results,
    tables_of_figures,
)
from tests.docs.site import DOCS, load
from tests.programmes.libraries import harm_of_programs

Run = Callable[..., tuple[str, str]]


KINDS = [
    pytest.param(printed_blocks, BLOCKS, id="blocks"),
    pytest.param(tables_of_figures, TABLES, id="tables"),
    pytest.param(pictures, PICTURES, id="pictures"),
]


@pytest.mark.parametrize(("shown", "table"), KINDS)
def test_everything_shown__has_its_place(shown: Callable[[], Iterator[Shown]], table: dict[str, How]) -> None:
    found = [(each, how(table, each.begin)) for each in shown()]
    assert [f"{each.page}: {each.begin}" for each, place in found if place is None] == []
    used = {place[0] for _, place in found if place is not None}
    assert [key for key in table if key not in used] == []


def test_everything_shown__names_tests_and_programs_that_are_there() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    for place in (*BLOCKS.values(), *TABLES.values(), *PICTURES.values(), *(place for _, place in results())):
        for by in place.by:
            assert not by.startswith("tests/") or (ROOT / by).exists(), by
            assert not by.startswith("make ") or by.split()[1] in targets, by


def test_results__are_linked_where_they_are_and_written_row_by_row() -> None:
    anchors = [(Path(each.page).stem, each.begin) for each, _ in results()]
    text = "".join(page.read_text("utf-8") for page in pages())
    again = [("reproduction", each["name"]) for each in json.loads((DOCS / "reproduction.json").read_text("utf-8"))]
    assert set(re.findall(r"results/([a-z-]+)\.md#([a-z0-9-]+)\)", text)) <= {*anchors, *again}
    assert len({anchor for _, anchor in anchors}) == len(anchors)
    for path in MEASURED.RESULTS.glob("*.json"):
        assert MEASURED.text_of(MEASURED.read_tables(path.stem)) == path.read_text("utf-8")
        with pytest.raises(ValueError, match="notes"):
            MEASURED.TABLES.validate_json(path.read_bytes().replace(b'"note"', b'"notes"'))


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a command line in this process in an empty folder; stderr and stdout."""
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.chdir(tmp_path)

    def call(command: str) -> tuple[str, str]:
        capsys.readouterr()
        run_command(command.split()[1:])
        captured = capsys.readouterr()
        return captured.err, captured.out

    return call


def _blocks() -> list[Shown]:
    places = [(each, how(BLOCKS, each.begin)) for each in printed_blocks()]
    own = [each for each, place in places if place is not None and place[1] == EXACT and "ethbrake" in each.begin]
    return [each for each in own if "first-ten-minutes" not in each.page]  # see tests/cli/test_scenarios.py


@pytest.mark.parametrize("block", _blocks(), ids=lambda block: block.begin[:60])
def test_block__is_what_its_commands_print(block: Shown, told: Run) -> None:
    if block.begin == "ethbrake scenario validate rainy.yaml":  # whose mistake the page tells
        told("ethbrake scenario new rainy")
        text = Path("rainy.yaml").read_text("utf-8")
        Path("rainy.yaml").write_text(text.replace("\nmass_t:", "\nmass_kg:"))
    for command, shown in commands_of(block.text):
        assert agrees(shown, "".join(told(command)).splitlines()), command


@pytest.mark.slow
def test_table_of_shipped_lists__is_printed_by_its_command(capsys: pytest.CaptureFixture[str]) -> None:
    (table,) = (each for each in MEASURED.read_tables("best-harm") if each.id == "proven-and-found")
    load("../studies/best_harm").main(["--shipped"])
    printed = capsys.readouterr().out.splitlines()
    for row in (table.columns, *table.rows):
        assert any(one.startswith(f"| {' | '.join(row)}") for one in printed), row


def test_reference_values__are_those_of_the_closed_form() -> None:
    (table,) = (each for each in MEASURED.read_tables("baselines") if each.id == "closed-form-values")
    for row in table.rows:
        world, ends, optimum, full = row
        gaps, speeds, latency = ([float(word) for word in part.split(",")] for part in world.split(";"))
        scenario = load_scenario("paper-random").replace(latency_s=[0.0, *latency])
        start = {f"gap_{k}_m": [gap] for k, gap in enumerate(gaps, 1)}
        start |= {f"speed_{k}_mps": [speed] for k, speed in enumerate(speeds, 1)}
        worlds = worlds_from_table(scenario, start)
        found = optimise_pairwise(worlds, 1)
        told = [found.spares_front_mps2, found.spares_rear_mps2, found.deceleration_mps2, found.harm]
        told.append(pairwise_harm(worlds, [6, 7, 6]).sum(axis=1))
        assert missing_figures(f"{ends} {optimum} {full}", " ".join(repr(float(each[0])) for each in told)) == [], row


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("a", "a", True),
        ("a", "b", False),
        ("a\n...\nd", "a\nb\nc\nd", True),
        ("a\n...\nd", "a\nd", True),
        ("a\n...", "a\nb", True),
        ("a\n  ...\nc", "a\nb", False),
        ("...\na", "b\na\n\n", True),
        ("a", "a\nb", False),
        ("", "a", False),
        ("a ...", "a b c", True),
        ("a ...", "b", False),
        ("a...", "ab", False),
    ],
)
def test_agrees__where_dots_stand_for_any_lines(shown: str, printed: str, same: bool) -> None:
    assert agrees(shown.splitlines(), printed.splitlines()) == same


@pytest.mark.parametrize(
    ("table", "printed", "missing"),
    [
        ("| a | 1.25 |", "1.2496", []),
        ("| a | 1.25 |", "1.244", ["1.25"]),
        ("| a | 65.1 % [64.1, 66.0] |", "0.6508 0.641 0.66", []),
        ("| a | 65.1 |", "0.651", ["65.1"]),
        ("| a | 0.5 %, 12 |", "0.0049 13", []),  # of whole numbers nothing is said
        ("| a | −3.14 |", "-3.141", []),
    ],
)
def test_missing_figures__are_those_that_nothing_rounds_to(table: str, printed: str, missing: list[str]) -> None:
    assert missing_figures(table, printed) == missing


PROGRAM_PAGES = ("environments", pytest.param("../README", marks=pytest.mark.slow))


PROGRAM = re.compile(r"```python\n(.*?)```(?:\n\n```\n(.*?)```)?", re.DOTALL)


@pytest.mark.parametrize("page", PROGRAM_PAGES)
def test_programs__of_a_page_run_and_print_what_stands_below_them(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "my_file"}
    programs = PROGRAM.findall((DOCS / f"{page}.md").read_text("utf-8"))
    assert programs
    for code, printed in programs:
        exec(compile(code, f"{page}.md", "exec"), names)
        assert capsys.readouterr().out == printed or not printed


@pytest.mark.slow
def test_programs_of_train__run_and_beat_full_braking(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(
        tmp_path
    )  # MAPPO of BenchMARL, where it is missing here, is run by ``make programme NAME=libraries``
    assert {"one", "pair"} <= harm_of_programs().keys()


NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))


def code_cells(notebook: Path) -> list[dict[str, Any]]:
    return [cell for cell in json.loads(notebook.read_text("utf-8"))["cells"] if cell["cell_type"] == "code"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook__is_committed_with_its_outputs(notebook: Path) -> None:
    cells = code_cells(notebook)
    assert any(cell["outputs"] for cell in cells)
    assert [cell for cell in cells if any(each["output_type"] == "error" for each in cell["outputs"])] == []


@pytest.mark.long
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook__runs_from_its_first_cell_to_its_last(notebook: Path, tmp_path: Path) -> None:
    cells = ["".join(cell["source"]) for cell in code_cells(notebook)]
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(cells)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]


# ---------------------------------------------------------------- the site


site_pages = load("pages")


def test_list_of_pages__has_every_page_once() -> None:
    sections = site_pages.read_sections((DOCS / "README.md").read_text("utf-8"))
    assert list(sections) == ["Start", "Guides", "Notebooks", "Extensions", "Reference", "More"]
    listed = [page for each in sections.values() for page in each]
    for page in (page for page in listed.copy() if page.endswith("/README.md")):
        listed += _inside(page)
    files = [*DOCS.rglob("*.md"), *DOCS.rglob("*.ipynb")]
    there = {
        path.relative_to(DOCS).as_posix() for path in files if not {"_build", ".ipynb_checkpoints"} & set(path.parts)
    }
    assert len(listed) == len(set(listed))
    assert set(listed) == {page for page in there if "/api/" not in page} - {"README.md", "index.md"}


def _inside(page: str) -> list[str]:
    """The pages that the navigation has below the page of a folder."""
    folder = page.removesuffix("README.md")
    made = site_pages.list_folder((DOCS / page).read_text("utf-8"), page.removesuffix(".md"))
    inside = [folder + each for each in made.rpartition("```{toctree}")[2].split() if each.endswith(".md")]
    return inside + [page for each in inside if each.endswith("/README.md") for page in _inside(each)]


@pytest.mark.parametrize(
    ("link", "docname", "written_in", "led"),
    [
        ("[a](docs/shield.md#how)", "index", ROOT, "[a](shield.md#how)"),
        ("[a](CHANGELOG.md)", "index", ROOT, "[a](changelog.md)"),
        ("[a](../CHANGELOG.md)", "README", None, "[a](changelog.md)"),
        ("[a](../../README.md)", "internals/model", None, "[a](../index.md)"),
        ("[a](../README.md#x)", "internals/model", None, "[a](../index.md#x)"),
        ("[a](../train/ppo.yaml)", "train", None, "[a](../train/ppo.yaml)"),
        ("[a](../ethbrake_marl/_policies/ppo/card.md)", "train", None, "[a](reference/policies.md#ppo)"),
        ("[a](nowhere.md) [b](https://x.org/y) [c](#here)", "index", ROOT, None),
    ],
)
def test_links__of_a_page_lead_to_the_page_on_the_site(
    link: str, docname: str, written_in: Path | None, led: str | None
) -> None:
    assert site_pages.relink(link, docname, written_in) == (led or link)


def test_extra__brings_what_the_configuration_loads() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    brought = {re.split(r"[<>=]", line)[0] for line in project["optional-dependencies"]["docs"]}
    extensions = re.search(r"^extensions = \[(.*)\]$", (DOCS / "conf.py").read_text("utf-8"), re.MULTILINE)
    assert extensions is not None
    named = re.findall(r'"([a-z_]+)[".]', extensions[1])
    loaded = {name.replace("_", "-") for name in named if name != "extension"}
    assert loaded | {"sphinx", "furo", "ethbrake-marl[notebook]"} == brought


QUESTIONS = {
    "train ppo": "train",
    "add scenario": "scenarios",
    "cooperation level": "cooperation",
    "shield my policy": "shield",
    "own vehicle data": "scenarios",
    "train a team": "train",
    "add my own reward": "environments",
    "whose harm counts": "extensions/fronts",
    "compare agents": "evaluate",
    "units of harm": "game",
    "install without torch": "installing",
    "what is harm": "game",
    "E-V2X-BM": "evaluate",
    "reward": "environments",
    "pettingzoo wrapper": "environments",
}


@pytest.mark.parametrize("question", QUESTIONS)
def test_search__is_told_the_page_that_answers_a_question_of_somebody_new(question: str) -> None:
    asked = set(re.findall(r"\w+", question.lower())) - {"is", "of"}  # words that the search passes over
    sought = load("sought").SOUGHT
    assert all((DOCS / f"{page}.md").exists() for page in sought)

    def words(text: str) -> int:
        return len(asked.intersection(re.findall(r"\w+", text.lower())))

    titles = {page: (DOCS / f"{page}.md").read_text("utf-8").partition("\n")[0] for page in sought}
    told = {page: (words(f"{titles[page]} {text}"), words(text)) for page, text in sought.items()}
    assert [page for page, count in told.items() if count == max(told.values())] == [QUESTIONS[question]]
    assert max(told.values())[0] == len(asked)


def test_demonstration__plays_the_picture_of_the_first_page_and_says_it_in_words(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    demo = load("demo")
    monkeypatch.setattr(demo, "WORLDS", (0,))
    monkeypatch.setattr(demo, "AGENTS", {"Full braking": "full_brake", demo.OWN: "universal"})
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
    ("command", "file"), [("scenario schema", "scenarios/scenario"), ("train --schema", "train/recipe")]
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
PAGES = sorted([ROOT / "README.md", *ROOT.glob(".github/*.md"), *DOCS.glob("*.md"), *DOCS.glob("[einrt]*/**/*.md")])
CODE = re.compile(r"^\s*(```+|~~~+|:::+).*?^\s*\1\s*$", re.DOTALL | re.MULTILINE)
FREE = re.compile(r"\s*(\||#|<|!\[)|    |\[[\w-]+\]: |\s*([-*] )?\S+$")  # tables, headings, HTML, code, one word


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_page__has_short_lines_and_code_blocks_on_lines_of_their_own(path: Path) -> None:
    text = path.read_text("utf-8")
    prose = CODE.sub("", text).splitlines()
    assert [line for line in prose if len(line) > MOST_CHARACTERS and not FREE.match(line)] == []
    assert [line for line in prose if line.startswith("%")] == []  # the site takes it for a comment
    broken = re.compile(r"\S.*```|```\S+ .*\S *```")
    assert [line for line in text.splitlines() if broken.search(line) and "````" not in line] == []


def test_readme__is_short_and_begins_with_a_picture_of_less_than_200_kb() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 120
    found = re.search(r"!\[[^\]]*\]\(([^)]*\.png)\)", text)
    assert found is not None and found.start() < text.index("\n## ")
    assert (ROOT / found[1]).stat().st_size < 200_000
