"""The folder of a reproduction: whole files, going on, and names and results that somebody else wrote."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from pydantic import ValidationError

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.figures import estimates_figure
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.studies.reproduction import (
    HARM,
    Drawn,
    Reproduction,
    checked_result,
    docs_page,
    read_results,
    render_page,
    write_docs,
)
from tests.pages.hostile import Page

from .conftest import HOSTILE, made, planted


def drawn(stem: str = "a-figure") -> dict[Drawn, Figure]:
    line = {0.0: Estimate(1.0, None), 1.0: Estimate(2.0, (1.0, 3.0))}
    figure = estimates_figure({"panel": {"line": line}}, x_label="x", y_label="y", caption="c")
    return {Drawn(stem, "A figure", "What it shows."): figure}


def hidden(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.name != ".lock"]


def test_reproduce__writes_figures_data_results_and_one_page(settings: Reproduction) -> None:
    items = [planted("gaps", lambda s: made(figures=drawn()))]
    results, finished = settings.make(items)
    assert finished and [each.name for each in results] == ["gaps"]
    names = sorted(path.name for path in (settings.folder / "gaps").iterdir())
    assert names == ["a-figure.png", "a-figure.svg", "data.csv", "result.json"]
    page = (settings.folder / "index.html").read_text("utf-8")
    assert page.count("<svg") == 1 and "var(--series-0)" in page and "<img" not in page and "<script" not in page
    assert re.search(r"https?://", re.sub(r'xmlns(:\w+)?="[^"]*"', "", page)) is None
    assert hidden(settings.folder) == []


def test_page__tells_everything_that_a_result_holds(settings: Reproduction) -> None:
    told = replace(
        made(), tables=(Sheet("A table", ("Who", HARM), (("PPO", Estimate(1.5, (1.25, 1.75))),), "Of 24 worlds."),)
    )
    (result,), _ = settings.make([planted("gaps", lambda s: told)])
    page = Page((settings.folder / "index.html").read_text("utf-8"))
    assert page.open == []
    for text in ("A table", "PPO 1.50 [1.25, 1.75]", "Of 24 worlds.", "What it is.", "label", "Comparisons: 1"):
        assert text in page.text
    assert result.verdict.because in page.text and "stated in the paper (told)" in page.text
    links = [attributes["href"] for tag, attributes in page.tags if tag == "a"]
    assert "./gaps/data.csv" in links and links.count("#a-title") == 1
    around = [attributes.get("class") for tag, attributes in page.tags if tag == "div"]
    assert around.count("wide") == sum(tag == "table" for tag, _ in page.tags) == 4


def test_page__no_name_of_a_result_leads_elsewhere(settings: Reproduction) -> None:
    settings.make([planted("gaps", lambda s: made())])
    (result,) = read_results(settings.folder)
    hostile = replace(result, name="javascript:alert(1)", data=["//x", '" onclick="'])
    page = Page(render_page(settings.folder, [hostile]))
    links = [attributes["href"] for tag, attributes in page.tags if tag == "a"]
    assert links[-2:] == ["./javascript%3Aalert%281%29/%2F%2Fx", "./javascript%3Aalert%281%29/%22%20onclick%3D%22"]
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)


def test_reproduce__keeps_what_is_there_and_makes_it_again_by_force(settings: Reproduction) -> None:
    calls = []
    items = [planted("gaps", lambda s: calls.append(1) or made())]
    settings.make(items)
    settings.make(items)
    assert len(calls) == 1
    settings.make(items, force=True)
    assert len(calls) == 2


def test_reproduce__an_interruption_leaves_whole_files_and_goes_on(settings: Reproduction) -> None:
    def stop(_: Reproduction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        settings.make([planted("harm-delays", lambda s: made()), planted("gaps", stop)])
    assert [each.name for each in read_results(settings.folder)] == ["harm-delays"]
    assert "A title" in (settings.folder / "index.html").read_text("utf-8")
    assert hidden(settings.folder) == []
    results, _ = settings.make([planted("harm-delays", stop), planted("gaps", lambda s: made())])
    assert [each.name for each in results] == ["harm-delays", "gaps"]


def test_open_folder__refuses_what_holds_something_else(settings: Reproduction, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("text")
    for force in (False, True):
        with pytest.raises(AlreadyExists, match="holds no reproduction"):
            replace(settings, folder=tmp_path / "mine").open_folder(force=force)
    with pytest.raises(InvalidInput, match="is a file"):
        replace(settings, folder=tmp_path / "mine" / "thesis.txt").open_folder()
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    with pytest.raises(InvalidInput, match="no plain folder"):
        replace(settings, folder=tmp_path / "link").open_folder()


def test_open_folder__other_settings_need_force(settings: Reproduction) -> None:
    settings.make([planted("gaps", lambda s: made())])
    with pytest.raises(InvalidInput, match="episodes 24, here 30"):
        replace(settings, episodes=30).open_folder()
    replace(settings, episodes=30).open_folder(force=True)
    assert read_results(settings.folder) == []


@pytest.mark.parametrize("name", ["<b>out</b>", "a'b\"c", "x\u202ey", "; rm -rf", "{{ 7 * 7 }}"])
def test_reproduce__a_hostile_folder_name_is_only_a_name(settings: Reproduction, tmp_path: Path, name: str) -> None:
    own = replace(settings, folder=tmp_path / name)
    own.make([planted("gaps", lambda s: made())])
    assert name not in (own.folder / "index.html").read_text("utf-8")


def test_page__whatever_a_result_says_is_text(settings: Reproduction) -> None:
    results, _ = settings.make([planted("gaps", lambda s: made(HOSTILE))])
    page = (settings.folder / "index.html").read_text("utf-8")
    assert "<script" not in page and "&lt;script&gt;" in page
    docs = docs_page(results)
    assert "<script" not in docs
    assert "\u202e" not in page and "\u202e" not in docs
    assert all(line.count(" | ") <= 2 for line in docs.splitlines() if line.startswith("| "))


@pytest.mark.parametrize("stem", ["../../etc/passwd", "a b", "A", "", "x" * 65, "<svg>", "/tmp/x"])
def test_figures__a_stem_that_is_no_plain_name_is_refused(settings: Reproduction, stem: str) -> None:
    with pytest.raises(ValidationError, match="for Drawn"):
        drawn(stem)
    settings.make([planted("gaps", lambda s: made())])
    file = settings.folder / "gaps" / "result.json"
    content = json.loads(file.read_text())
    content["figures"] = [{"stem": stem, "title": "t", "text": "t"}]
    file.write_text(json.dumps(content))
    with pytest.raises(InvalidInput, match="figures: 0: stem: is not what a reproduction writes"):
        settings.make([planted("harm-delays", lambda s: made())])


NONE_OF_OURS = (
    "<script>alert(1)</script>",
    '<g onload="alert(1)"/>',
    '<g style="onload: alert(1)"/>',
    '<use href="#x"/>',
    '<use xmlns:l="http://www.w3.org/1999/xlink" l:href="https://example.org/x.svg#x"/>',
    '<path fill="url(https://example.org/x)"/>',
    '<path style="fill: URL(https://example.org/x)"/>',
    "<foreignObject/>",
    '<g xmlns="http://www.w3.org/1999/xhtml"/>',
    "<g>",
    "<g>" * 20_000 + "</g>" * 20_000,
)


def test_page__a_figure_that_is_none_of_ours_is_refused(settings: Reproduction) -> None:
    results, _ = settings.make([planted("gaps", lambda s: made(figures=drawn()))])
    file = settings.folder / "gaps" / "a-figure.svg"
    for inside in NONE_OF_OURS:
        file.write_text(f'<svg xmlns="http://www.w3.org/2000/svg">{inside}</svg>')
        with pytest.raises(InvalidInput, match=r"a-figure\.svg: is not a figure as it was drawn"):
            render_page(settings.folder, results)


@pytest.mark.parametrize(
    "change",
    [
        {"tables": "x"},
        {"tables": [{"title": "t", "head": ["h"], "rows": [[[1]]], "note": ""}]},
        {"tables": [{"title": "t", "head": ["h"], "rows": [[["a"]], []], "note": ""}]},
        {"tables": [{"title": "", "head": [], "rows": [], "note": ""}]},
        {"verdict": {}},
        {"figures": [1]},
        {"figures": [{"stem": 7, "title": "t", "text": "t"}]},
        {"name": None},
        {"name": "../elsewhere"},
        {"name": "random-table"},
        {"data": ["../../x.csv"]},
        {"verdict": {"what": "all", "outcome": "agrees", "because": "of 25 comparisons 25 agree"}},
        {"comparisons": [{"what": "w", "outcome": "<b>great</b>", "because": ""}]},
        {"comparisons": []},
        {"comparisons": [{"what": "w"}]},
        {"notes": ["a", None]},
    ],
)
def test_results__a_damaged_one_is_named(settings: Reproduction, change) -> None:
    settings.make([planted("gaps", lambda s: made())])
    file = settings.folder / "gaps" / "result.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    with pytest.raises(InvalidInput, match=r"result\.json: [\w: ]+: is not what a reproduction writes"):
        read_results(settings.folder)


def test_write_docs__page_data_and_figures(settings: Reproduction, tmp_path: Path) -> None:
    results, _ = settings.make([planted("gaps", lambda s: made(figures=drawn()))])
    file = tmp_path / "page.md"
    write_docs(file, settings.folder, results)
    assert json.loads((tmp_path / "page.json").read_text("utf-8")) == [each.in_words() for each in results]
    assert file.read_text("utf-8") == docs_page(read_results(settings.folder))
    assert (tmp_path / "figures" / "reproduction-a-figure.svg").is_file()
    with pytest.raises(InvalidInput, match=r"must end in \.md"):
        replace(settings, docs=tmp_path / "page.html")


def test_pages__say_command_machine_and_how_little_was_made(settings: Reproduction) -> None:
    results, _ = replace(settings, machine="a CPU, load 3.1, numpy 2.4.6").make([planted("gaps", lambda s: made())])
    page = Page((settings.folder / "index.html").read_text("utf-8"))
    for text in (page.text, docs_page(results)):
        assert "1 of the 10 items" in text and "ethbrake reproduce gaps --quick --episodes 24" in text
        assert f"({results[0].made_utc[:10]}, a CPU, numpy 2.4.6; " in text
        assert "At most 24 worlds of each list are driven here; the paper has 10,000." in text


def test_pages__of_results_that_do_not_say_how_many_worlds_say_nothing_of_it(settings: Reproduction) -> None:
    (found,), _ = settings.make([planted("gaps", lambda s: made())])
    content = {name: value for name, value in asdict(found).items() if name != "episodes"}
    result = checked_result(content, "result.json", "gaps")
    page = Page(render_page(settings.folder, [result]))
    assert "worlds of each list" not in page.text and "reproduce gaps --quick (" in page.text


def test_reproduce__one_process_works_in_a_folder(settings: Reproduction) -> None:
    with settings.open_folder().work(), pytest.raises(InvalidInput, match="another process works in it"):
        settings.make([planted("gaps", lambda s: made())])
