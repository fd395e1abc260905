from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.evaluation import Evaluation, evaluate, summarise
from ethbrake_marl.evaluation.report import Report, ReportFigure, render_report, write_report
from ethbrake_marl.scenario import Scenario

PNG = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)
EXTERNAL = re.compile(r"""(https?:)?//|@import|url\(|<(script|link|iframe|object|embed|base)\b""", re.IGNORECASE)


class Page(HTMLParser):
    """Tags with their attributes, and the text."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag, f"</{tag}> closes nothing"

    def handle_data(self, data: str) -> None:
        if "style" not in self.open:
            self.words += data + " "

    @property
    def text(self) -> str:
        return " ".join(self.words.split())


@pytest.fixture
def report(evaluation: Evaluation) -> Report:
    return Report(
        title="PPO on paper-random",
        rows=summarise(evaluation),
        figures=[ReportFigure("Learning curve", "Harm over steps.", PNG), ReportFigure("Gaps", "Harm by gap.", PNG)],
        summary="One million steps.",
        settings={"Training seed": 5, "Command": "ethbrake run"},
        versions={"numpy": "2.4.6"},
    )


def test_report__loads_nothing_from_anywhere(report: Report) -> None:
    html = render_report(report)
    assert EXTERNAL.search(re.sub(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", html)) is None
    for _, attributes in Page(html).tags:
        assert "href" not in attributes
        assert (attributes.get("src") or "data:image/png").startswith("data:image/png")


def test_report__contains_the_figures_themselves(report: Report) -> None:
    pictures = [attributes for tag, attributes in Page(render_report(report)).tags if tag == "img"]
    assert [base64.b64decode(picture["src"].split(",")[1]) for picture in pictures] == [PNG, PNG]
    assert pictures[0]["alt"] == "Learning curve. Harm over steps."


def test_report__is_well_formed_and_says_everything(report: Report, evaluation: Evaluation) -> None:
    page = Page(render_report(report))
    assert page.open == []
    text = page.text.replace("\u00a0", " ")
    row = report.rows[0]
    for estimate in (row.first_impact_harm, row.total_harm):
        assert f"{estimate.value:.2f}" in text
        assert f"{estimate.interval[0]:.2f}, {estimate.interval[1]:.2f}" in text
    assert all(agent in text for agent in evaluation.outcomes)
    assert "paper-random: 200 worlds, seed 7; d = " in text
    assert "Training seed 5 Command ethbrake run" in text
    assert "numpy 2.4.6" in text
    assert "Hybrid PPO – 59.74 % 5.6202" in text
    assert "62.6 %" in text


def test_report__text_of_the_user_is_text(report: Report) -> None:
    html = render_report(Report(title="<script>x</script>", rows=report.rows, settings={"a": "<b>"}))
    assert "&lt;script&gt;" in html
    assert not {"script", "b"} & {tag for tag, _ in Page(html).tags}


def test_report__of_another_scenario_leaves_the_papers_rows_out(pair: Scenario) -> None:
    result = evaluate(pair.sample(2, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    text = Page(render_report(Report(title="Pair", rows=summarise(result)))).text
    assert "9.00" in text
    assert "as printed" not in text
    assert "5.6202" not in text


def test_write_report__overwrites_only_by_force(tmp_path: Path, report: Report) -> None:
    path = tmp_path / "report.html"
    write_report(path, report)
    assert path.read_text("utf-8") == render_report(report)
    with pytest.raises(AlreadyExists):
        write_report(path, report)
    write_report(path, Report(title="Other", rows=[]), force=True)
    assert "<h1>Other</h1>" in path.read_text("utf-8")
