"""The pages about the reproduction: their numbers and claims are those of today's code."""

import re

import pytest

from ethbrake_marl import __version__
from ethbrake_marl.extensions.report.paper_rows import RANDOM_TEST
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.extensions.reproduction import curves, strategies, tables
from ethbrake_marl.extensions.reproduction.documents import markdown
from ethbrake_marl.extensions.reproduction.items import ITEMS
from ethbrake_marl.extensions.reproduction.made import PAPER_EPISODES, ReproductionSettings
from ethbrake_marl.extensions.reproduction.random_test import NON_E, SHIPPED_SPECS, report_outcome
from ethbrake_marl.extensions.reproduction.readings import NEAREST, STATED
from ethbrake_marl.extensions.reproduction.verdicts import claims_sheet
from ethbrake_marl.motion.digest import physics_digest
from tests.docs.site import DOCS, load

PAGE = (DOCS / "extensions" / "reproduction.md").read_text("utf-8")
RESULTS = (DOCS / "results" / "reproduction" / "README.md").read_text("utf-8")

sampling = load("../studies/sampling")


@pytest.mark.parametrize("agent", sampling.AGENTS)
def test_sampling__prints_the_errors_that_the_page_tells(agent: str) -> None:
    study = sampling.convergence(agent, steps_s=(0.2, 0.1, 0.05))
    exact, *_, coarse = sampling.table(study).partition("| 0.05 |")[0].split("| 0.1 | ")
    error = float(coarse.split(" | ")[0]) / float(re.search(r"mean harm (\S+)", exact)[1])
    assert f"{error:+.2%}".replace("%", " %") in PAGE
    assert picture_bytes(sampling.draw([study]), "study.png").startswith(b"\x89PNG")


def claims_of(page: str) -> list[str]:
    """The rows of the table of claims of a page, as Markdown."""
    table = page.split("| Where | The paper | Ours, as stated | Ours, nearest reading | Why |\n")[1]
    return table.split("\n\n")[0].splitlines()[1:]


def test_results__have_every_claim_that_the_code_makes_and_no_other(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(strategies, "process", lambda settings: {name: [spec] for name, spec in SHIPPED_SPECS.items()})
    for module in (curves, tables):
        monkeypatch.setattr(module, "unconverged_policy", lambda folder: "ppo-obstacle")
    settings = ReproductionSettings(tmp_path, episodes=20)
    made = [claim for item in ITEMS for claim in item.make(settings).claims]
    committed = [re.split(r" ?\| ?", row)[1:3] for row in claims_of(RESULTS)]
    assert committed == [[each.where, each.paper.replace("H*", r"H\*")] for each in made]


def test_results__are_those_of_this_version_and_the_non_ethical_row_of_today() -> None:
    assert f"version {__version__}, physics {physics_digest()})" in " ".join(RESULTS.split())
    stated, nearest = ({NON_E: report_outcome(NON_E, reading, PAPER_EPISODES)} for reading in (STATED, NEAREST))
    own = tables.number_claims("Table III", RANDOM_TEST[:1], stated, nearest, 0.0 * stated[NON_E][1])
    rows = markdown(claims_sheet(own)).splitlines()[2:]
    assert rows == [row for row in claims_of(RESULTS) if row.startswith(f"| Table III | {NON_E}, ")]


def test_pages__name_every_figure_and_table_of_the_paper() -> None:
    for label in (label for item in ITEMS for label in item.labels):
        assert f"`{label}`" in RESULTS
