"""The pages about the reproduction: their numbers and claims are those of today's code."""

import csv
import re
from collections import Counter
from typing import get_args

import pytest

from ethbrake_marl import __version__
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.extensions.reproduction import curves, learning, strategies, tables
from ethbrake_marl.extensions.reproduction.items import ITEMS
from ethbrake_marl.extensions.reproduction.learning import Course
from ethbrake_marl.extensions.reproduction.made import PAPER_EPISODES, ReproductionSettings
from ethbrake_marl.extensions.reproduction.paper_rows import RANDOM_TEST
from ethbrake_marl.extensions.reproduction.random_test import NON_E, SHIPPED_SPECS, report_outcome
from ethbrake_marl.extensions.reproduction.readings import NEAREST, STATED
from ethbrake_marl.extensions.reproduction.verdicts import REASONS, Verdict, paper_texts
from ethbrake_marl.motion.digest import physics_digest
from tests.docs.site import DOCS, load

PAGE = (DOCS / "paper.md").read_text("utf-8")
README = (DOCS.parent / "README.md").read_text("utf-8")
RESULTS = DOCS / "results" / "reproduction" / "claims.csv"

sampling = load("../studies/sampling")


@pytest.mark.parametrize("agent", sampling.AGENTS)
def test_sampling__prints_the_errors_that_the_page_tells(agent: str) -> None:
    study = sampling.convergence(agent, steps_s=(0.2, 0.1, 0.05))
    exact, *_, coarse = sampling.table(study).partition("| 0.05 |")[0].split("| 0.1 | ")
    error = float(coarse.split(" | ")[0]) / float(re.search(r"mean harm (\S+)", exact)[1])
    assert f"{error:+.2%}".replace("%", " %") in PAGE
    assert picture_bytes(sampling.draw([study]), "study.png").startswith(b"\x89PNG")


HEADING = ["Where", "The paper", "Ours, as stated", "Ours, nearest reading", "Verdict", "Why"]
SENTENCES = paper_texts()["sentences"]


def sentences() -> list[list[str]]:
    """The committed rows of the table of sentences, as texts."""
    with RESULTS.open(encoding="utf-8", newline="") as file:
        heading, *rows = csv.reader(file)
    assert heading == HEADING
    return rows


def test_results__have_every_sentence_in_the_papers_order() -> None:
    committed = [row[:2] for row in sentences()]
    assert committed == [[each["where"], each["paper"]] for each in SENTENCES]


def test_results__have_a_number_in_each_row_that_was_run_and_the_reason_for_its_verdict() -> None:
    for row, sentence in zip(sentences(), SENTENCES, strict=True):
        *_, ours, _, verdict, why = row
        assert re.search(r"\d", ours) or verdict == "not run"
        assert why == sentence["why"].get(verdict, REASONS.get(verdict, "")).strip()
        assert why or verdict == "agrees"


COUNTED = {
    "agrees": "agree", "differs": "differ", "cannot be": "cannot be", "undecided": "are undecided",
    "not converged": "rest on a training that has not converged", "not run": "wait for a long training",
}  # fmt: skip


def test_readme__has_the_number_of_each_verdict() -> None:
    count = Counter(row[4] for row in sentences())
    *verdicts, last = (f"{count[verdict]} {words}" for verdict, words in COUNTED.items() if count[verdict])
    assert f"of its {len(SENTENCES)} results, {', '.join(verdicts)}, and {last}" in " ".join(README.split())


def test_sentences__are_judged_by_claims_that_the_code_makes_and_no_claim_is_left_out(
    tmp_path, monkeypatch: pytest.MonkeyPatch
) -> None:
    course = Course([{k: -9.0 + min(k, 3) for k in range(9)}] * 2, [{100.0: 1.0}] * 2)
    courses = dict.fromkeys(SHIPPED_SPECS, course)
    two_seeds = {name: [spec, spec] for name, spec in SHIPPED_SPECS.items()}
    monkeypatch.setattr(strategies, "process", lambda settings: two_seeds)
    for module in (curves, tables, learning):
        monkeypatch.setattr(
            module, "courses_of", lambda settings, delay: {"PPO": course} if delay == learning.DENSE else courses
        )
    for module in (curves, tables):
        monkeypatch.setattr(module, "unconverged_policy", lambda folder: "sac")
    settings = ReproductionSettings(tmp_path, episodes=20)
    made = {f"{item.name}/{claim.name}" for item in ITEMS for claim in item.make(settings).claims}
    assert made == {sentence["result"] for sentence in SENTENCES}
    verdicts = get_args(Verdict)
    assert all(verdict in verdicts for sentence in SENTENCES for verdict in sentence["why"])


def test_results__are_those_of_this_version_and_the_non_ethical_row_of_today() -> None:
    assert f"version {__version__}, physics {physics_digest()})" in " ".join(PAGE.split())
    stated, nearest = ({NON_E: report_outcome(NON_E, reading, PAPER_EPISODES)} for reading in (STATED, NEAREST))
    claims = tables.number_claims(RANDOM_TEST[:1], stated, nearest, 0.0 * stated[NON_E][1], {})
    rows = [row[2:5] for row in sentences() if row[1].startswith(f"{NON_E}, ")]
    assert rows == [[*claim[1:]] for claim in claims]


def test_pages__name_every_figure_and_table_of_the_paper() -> None:
    for label in (label for item in ITEMS for label in item.labels):
        assert f"`{label}`" in PAGE
