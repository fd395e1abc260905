"""docs/paper.md treats everything that is in the paper, and its figures are those that its commands print."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agents import optimise_pairwise
from ethbrake_marl.evaluation import evaluate
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.evaluation.measures import PAPER_NOTE, PAPER_ROWS
from ethbrake_marl.scenario import Scenario, load_scenario

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = (DOCS / "paper.md").read_text("utf-8")

# Every \label of an equation, algorithm, figure or table in the paper's source, and how many of each it numbers.
EQUATIONS = (
    "dynamics", "eq:olle1", "eq:olle2", "eq:4", "eq:5", "eq:52", "eq:rel_distance", "gamma", "eq:rel_velocity",
    "eq:harm", "eq:harm_i+1", "eq:11", "eq:12", "eq:13", "dynamics2", "eq:total_objective", "eq:Jharmn", "Jfunc",
    "eq:ratio", "eq:ppo_clip", "eq:alpha_loss", "Eq:BaselineHarm",
)  # fmt: skip
FIGURES = (
    "fig:fig1", "fig:ppo_sac_high_latency", "fig:ppo_sac_low_latency", "Fig:Harm-ivds", "Fig:harm-delay", "Fig:pic5sim",
    "Fig:pic5act", "Fig:hybrid illu",
)  # fmt: skip
TABLES = ("table:params", "tab:ppo-sac", "Table:hybrid", "Table:Random")
NUMBERED_EQUATIONS, NUMBERED_FIGURES, NUMBERED_TABLES = 35, 8, ("I", "II", "III")


def section(title: str) -> str:
    """The text below one heading of the second level."""
    return PAGE.partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def rows(text: str) -> list[list[str]]:
    """The cells of every line of a table."""
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in text.splitlines() if line[:1] == "|"]


def numbers(text: str) -> list[str]:
    """The numbers in the first column of the tables that have one."""
    return [number for row in rows(text) if len(row) == 5 for number in row[0].split(", ") if number.isalnum()]


@pytest.mark.parametrize(
    ("title", "labels"),
    [("Equations", EQUATIONS), ("Algorithm", ("alg:hybrid",)), ("Figures", FIGURES), ("Tables", TABLES)],
)
def test_paper_page__treats_every_label(title: str, labels: tuple[str, ...]) -> None:
    second = " ".join(row[1] for row in rows(section(title)) if len(row) == 5)
    assert [label for label in labels if f"`{label}`" not in second] == []


def test_paper_page__treats_everything_that_has_a_number_once() -> None:
    assert numbers(section("Equations")) == [str(k) for k in range(1, NUMBERED_EQUATIONS + 1)]
    assert numbers(section("Figures")) == [str(k) for k in range(1, NUMBERED_FIGURES + 1)]
    assert numbers(section("Tables")) == list(NUMBERED_TABLES)


def test_paper_page__says_what_no_other_page_said() -> None:
    for sentence in (
        "one `k_energy` for all pairs",
        "masses and e they do not",
        "predict 3.07",
        "above v_max when pushed",
    ):
        assert sentence in PAGE


def test_paper_page__is_where_the_docs_and_the_report_speak_of_the_paper() -> None:
    assert "(paper.md)" in (DOCS / "README.md").read_text("utf-8")
    assert "docs/paper.md" in PAPER_NOTE
    for page in ("model", "evaluation", "scenarios", "learning", "environment", "shield", "sampled"):
        assert "paper.md" in (DOCS / f"{page}.md").read_text("utf-8"), page


def test_paper_page__links_lead_to_headings() -> None:
    def headings(text: str) -> set[str]:
        found = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
        return {re.sub(r"[^a-z0-9 -]", "", title.lower()).replace(" ", "-") for title in found}

    for target in re.findall(r"\]\(([^)]+)\)", PAGE):
        file, _, anchor = target.partition("#")
        path = DOCS / file if file else DOCS / "paper.md"
        assert path.is_file(), target
        assert not anchor or anchor in headings(path.read_text("utf-8")), target


def test_5000_worlds__cannot_come_from_the_speeds_of_the_figure_of_distances() -> None:
    printed = next(row for row in PAPER_ROWS if row.table == "hybrid test" and row.agent == "E-V2X-BM").average_harm
    at_figure, at_random = (
        optimise_pairwise(load_scenario(name).sample(n, 7).worlds, 1).harm.mean()
        for name, n in (("paper-distance", 5_000), ("paper-random", 10_000))
    )
    assert f"{at_figure:.2f}" == "3.07" and f"{at_random:.2f}" == "9.45"
    assert printed > 3.0 * at_figure
    assert "| 67.7 %, 3.07, 12.88 | 85.26 %, 9.8514 |" in PAGE
    assert "| 65.4 %, 9.45, 19.20 | 85.26 %, 9.8514 |" in PAGE


def first_total(scenario: Scenario, spec: str) -> str:
    state = {"gap_1_m": [7], "gap_2_m": [7], "speed_1_mps": [20], "speed_2_mps": [18], "speed_3_mps": [20]}
    worlds = scenario.worlds_from_table(state)
    outcome = evaluate(worlds, make_lineup([spec], scenario), scenario=scenario).outcome(spec)
    return f"{outcome.first_impact_harm.mean():.2f}, {outcome.total_harm.mean():.2f}".replace("0.00", "0")


@pytest.mark.parametrize("spec", ["full_brake", "e_v2x_bm", "ppo@shipped/ppo", "best_harm"])
def test_three_delays__are_as_printed(spec: str) -> None:
    (row,) = (cells for cells in rows(section("Figures")) if cells[0].startswith(f"`{spec}`") and len(cells) == 4)
    delays = ("low", "middle", "high")
    assert row[1:] == [first_total(load_scenario(f"paper-delay-{delay}"), spec) for delay in delays]


def test_total_distance__full_braking_is_as_printed() -> None:
    scenario = load_scenario("paper-distance")
    result = evaluate(scenario.sample(5_000, 7), make_lineup(["full_brake"], scenario), scenario=scenario)
    groups = np.digitize(result.worlds.gaps_m.sum(axis=1), (12.0, 14.0, 16.0, 18.0))
    harm = result.outcome("full_brake").first_impact_harm
    means = " | ".join(f"{harm[groups == group].mean():.2f}" for group in range(5))
    assert f"| `full_brake` | {means} |" in PAGE
