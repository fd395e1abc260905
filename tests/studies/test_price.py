"""The study of what it costs not to know: its table, its figure, and the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.agents.rollout import drive
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.statistics import Estimate
from ethbrake_marl.figures.bars import draw_bars
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.price import channels_of, limit_of, price_of_not_knowing

BASE = load_scenario("cooperation-2-paper")
DOCS = Path(__file__).parents[2] / "docs"


def test_channels__are_periodic_where_messages_are_sent_one_by_one() -> None:
    assert list(channels_of(["paper", "blocked", "sensors-only"])) == [
        "paper",
        "blocked",
        "blocked, periodic",
        "sensors-only",
    ]


def test_channels__that_are_none_are_refused() -> None:
    with pytest.raises(InvalidInput, match="channel 'nomnal': must be a preset of v2x: paper, clear"):
        channels_of(["nomnal"])
    with pytest.raises(InvalidInput, match="at least one channel"):
        channels_of([])


@pytest.mark.parametrize(
    ("agent", "limit"),
    [
        ("e_v2x_bm:believed", "e_v2x_bm"),
        ("e_v2x_bm:pairwise:believed", "e_v2x_bm:pairwise"),
        ("planner:20ms:believed", "planner:20ms"),
        ("ppo@shipped/ppo+step:believed", "ppo@shipped/ppo+step"),
        ("ppo@shipped/ppo+episode:pairwise:believed", "ppo@shipped/ppo+episode:pairwise"),
        ("coast+robust:believed", "coast+step"),
        ("e_v2x_bm:believed+step", "e_v2x_bm+step"),
        ("ppo@shipped/ppo+refined+step", None),
        ("full_brake", None),
    ],
)
def test_limit__is_the_same_agent_that_reads_the_line(agent: str, limit: str | None) -> None:
    assert limit_of(agent) == limit


def test_price__is_nothing_where_everything_is_known() -> None:
    agents = ["coast", "e_v2x_bm:believed", "full_brake+step:believed"]
    found = price_of_not_knowing(BASE, channels=["paper"], agents=agents, n=20)
    alone, searching, shielded = found.rows
    assert alone.limit is None and alone.price_first is None
    assert searching.price_first.value == pytest.approx(0.0, abs=1e-4)
    assert searching.above is None and shielded.above.value == 0.0


def test_price__is_paired_by_world_and_told_of_both_counts() -> None:
    (row,) = price_of_not_knowing(BASE, channels=["sensors-only"], agents=["e_v2x_bm:believed"], n=30).rows
    over = BASE.replace(v2x="sensors-only")
    harm = {
        spec: drive(over.sample(30, 7).worlds, make_agent(spec, scenario=over), over, 1).ledger
        for spec in ("e_v2x_bm", "e_v2x_bm:believed")
    }
    for count, price in (("first", row.price_first), ("total", row.price_total)):
        difference = harm["e_v2x_bm:believed"].world_harm(count) - harm["e_v2x_bm"].world_harm(count)
        assert price.value == pytest.approx(difference.mean(), abs=1e-9)
        spread = 2.045 * difference.std(ddof=1) / 30**0.5  # t of 29 degrees of freedom
        assert price.interval == pytest.approx((price.value - spread, price.value + spread), rel=1e-3)
    told = row.to_json()
    assert told["limit"] == "e_v2x_bm" and len(told["price_first_interval"]) == 2 and told["above"] is None


def test_price__a_bound_is_compared_with_the_harm_that_it_is_of() -> None:
    agents = ["coast+step:believed"]
    first, total = (
        price_of_not_knowing(BASE, channels=["sensors-only"], agents=agents, n=30, harm_count=count).rows[0]
        for count in ("first", "total")
    )
    assert 0.0 < first.above.value < 1.0 and 0.0 < total.above.value < 1.0
    assert total.total.value != first.total.value


def test_price__without_an_agent_to_compare_is_refused_before_anything_is_driven() -> None:
    with pytest.raises(InvalidInput, match="none of the agents is compared; give one that says 'believed'"):
        price_of_not_knowing(BASE, agents=["full_brake", "e_v2x_bm"], n=10**9)


def test_price__an_agent_that_cannot_be_is_refused_before_anything_is_driven() -> None:
    with pytest.raises(InvalidInput, match="e_v2x_bm:all"):
        price_of_not_knowing(BASE, agents=["full_brake", "e_v2x_bm:all:believed"], n=10**9)


def test_table__in_the_docs_is_of_the_worlds_that_the_study_takes() -> None:
    page = (DOCS / "baselines.md").read_text("utf-8")
    for name in channels_of():
        assert f"| {name} | " in page, name
    assert (DOCS / "figures" / "price-of-not-knowing.png").exists()


def test_bars__need_a_value_for_each_name() -> None:
    with pytest.raises(InvalidInput, match="every series needs a value"):
        draw_bars(["a", "b"], [("m", [("x", [Estimate(1.0, None)])])])
