"""The pages about the reproduction: their numbers and claims are those of today's code."""

import re
from collections import Counter
from pathlib import Path
from typing import get_args

import pytest

from ethbrake_marl import __version__
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.extensions.reproduction.items import ITEMS
from ethbrake_marl.extensions.reproduction.made import ReproductionSettings
from ethbrake_marl.extensions.reproduction.readings import OURS, READINGS, STATED
from ethbrake_marl.extensions.reproduction.strategies import (
    E_V2X_BM,
    NON_E,
    SHIPPED_SPECS,
    contact_unavoidable,
    drive,
    impact_unavoidable,
    strategies,
)
from ethbrake_marl.extensions.reproduction.verdicts import Verdict, paper_texts, recorded
from ethbrake_marl.motion.digest import physics_digest
from tests.docs.printed import rows as rows_of_page
from tests.docs.site import DOCS, load
from tests.fixtures.commands import rows_of

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


HEADING = [
    "Where", "The paper", *READINGS, *(f"Numbers, {reading}" for reading in READINGS), "Why",
]  # fmt: skip
SENTENCES = paper_texts()["sentences"]
VERDICTS = get_args(Verdict)


def sentences() -> list[dict[str, str]]:
    """The committed rows of the table of sentences."""
    rows = rows_of(RESULTS)
    assert [*rows[0]] == HEADING
    return rows


def verdict_of(row: dict[str, str], reading: str) -> str:
    return row[reading].partition(" (")[0]


def test_results__have_every_sentence_in_the_papers_order() -> None:
    committed = [[row["Where"], row["The paper"]] for row in sentences()]
    assert committed == [[each["where"], each["paper"]] for each in SENTENCES]


def test_results__have_numbers_and_the_reason_for_our_verdict() -> None:
    for row, sentence in zip(sentences(), SENTENCES, strict=True):
        verdict = verdict_of(row, OURS)
        assert re.search(r"\d", row["Numbers, ours"]) and all(verdict_of(row, each) in VERDICTS for each in READINGS)
        assert row["Why"] == sentence["why"].get(verdict, "").strip()
        assert row["Why"] or verdict == "agrees"


def counts() -> dict[str, list[int]]:
    """Verdict -> number of rows in each reading."""
    counted = [Counter(verdict_of(row, reading) for row in sentences()) for reading in READINGS]
    return {verdict: [count[verdict] for count in counted] for verdict in VERDICTS}


def test_readme_and_page__have_the_number_of_each_verdict() -> None:
    number, text = counts(), " ".join(README.split())
    ours, first, alone = number["agrees"]
    assert f"of its {len(SENTENCES)} results {ours} to {alone} agree" in text and ours <= first <= alone
    columns = [", ".join(str(number[verdict][k]) for verdict in VERDICTS) for k in range(len(READINGS))]
    assert (
        f"verdicts on all {len(SENTENCES)} results: agree, differ, cannot be, undecided | {' | '.join(columns)} |"
        in PAGE
    )


def test_readings__change_these_verdicts_alone() -> None:
    """The rows that the authors' own count decides; none turns back under R2."""
    changed = {
        sentence["result"]: [verdict_of(row, reading) for reading in READINGS]
        for row, sentence in zip(sentences(), SENTENCES, strict=True)
        if len({verdict_of(row, reading) for reading in READINGS}) > 1
    }
    both, alone, back = (
        ["differs", "agrees", "agrees"],
        ["differs", "differs", "agrees"],
        ["agrees", "differs", "agrees"],
    )
    assert changed == {
        "random-table/hybrid and learning": both,
        "random-table/safety bound": both,
        "random-table/never worse": back,
        "random-table/expected is overall": alone,
        f"harm-distance/{NON_E} harms most, {E_V2X_BM}": both,
        f"harm-distance/less than {NON_E}, {E_V2X_BM}": both,
        f"harm-distance/learning harms less, {E_V2X_BM}, predicted": both,
        "harm-distance/lower": both,
        "hybrid-table/outperforms in harm": both,
    }


def test_sentences__are_judged_by_claims_that_the_code_makes_or_that_are_recorded() -> None:
    settings = ReproductionSettings(Path("unused"), episodes=20)
    made = {f"{item.name}/{claim.name}" for item in ITEMS for claim in item.make(settings).claims}
    listed = {sentence["result"] for sentence in SENTENCES}
    assert made | recorded()["results"].keys() == listed and not made & recorded()["results"].keys()
    assert all(verdict in VERDICTS for sentence in SENTENCES for verdict in sentence["why"])
    assert {result.partition("/")[0] for result in listed} == {item.name for item in ITEMS}


def test_results__are_those_of_this_version_and_the_numbers_of_today() -> None:
    assert f"version {__version__}, physics {physics_digest()})" in " ".join(PAGE.split())
    outcomes = strategies(STATED, 10_000, SHIPPED_SPECS)
    printed = [row for row in sentences() if row["Where"] == "Table III" and "average harm " in row["The paper"]]
    rows = {row["The paper"].partition(",")[0]: row for row in printed}
    for name in (NON_E, E_V2X_BM):
        for reading in READINGS:
            harm = outcomes[reading][name]["first"].mean()
            assert rows[name][f"Numbers, {reading}"].startswith(f"{harm:.2f} [")
    _, *table = rows_of_page("paper", "## Do the contributions hold?")
    for name, texts in zip((NON_E, E_V2X_BM, ("PPO", "SAC"), ("Hybrid PPO", "Hybrid SAC")), table, strict=False):
        names = (name,) if isinstance(name, str) else name
        for reading, text in zip(READINGS, texts[1:], strict=False):
            assert text == ", ".join(f"{outcomes[reading][each]['first'].mean():.2f}" for each in names)


def test_page__tells_what_is_unavoidable_of_contact_and_of_collisions() -> None:
    contact, impact = contact_unavoidable(STATED, 10_000), impact_unavoidable(STATED, 10_000)
    collided = {name: outcome["collided"] for name, outcome in strategies(STATED, 10_000, SHIPPED_SPECS)[OURS].items()}
    searched = drive(STATED, "best_harm", 10_000)["collided"]
    text, others = " ".join(PAGE.split()), [*collided.values(), searched]
    assert f"In {impact.mean():.2%}".replace("%", " %") in text and f"({impact.sum():,} of 10,000)" in text
    assert f"contact is in {contact.mean():.2%}".replace("%", " %") in text and f"({contact.sum():,})." in text
    assert all((rows | ~impact).all() for rows in others) and impact.sum() <= searched.sum() < contact.sum()
    base = collided[E_V2X_BM]
    assert f"E-V2X-BM collides in {base.sum():,} worlds. So at most {(base & ~impact).sum()} of its" in text
    assert f"at least {(base & ~searched).sum()} are," in text and f"collides in {searched.sum():,}. " in text
    assert f"In the other {(contact & ~searched).sum()} worlds in which contact is certain" in text
    assert f"PPO collides in {collided['PPO'].sum():,} worlds, its hybrid in {collided['Hybrid PPO'].sum():,}" in text


def test_pages__name_every_figure_and_table_of_the_paper() -> None:
    for label in (label for item in ITEMS for label in item.labels):
        assert f"`{label}`" in PAGE
