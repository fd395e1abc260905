"""The study of what it costs not to know: its table, its figure, and the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.figures.bars import draw_bars
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.studies.price import channels_of, price_of, price_report, price_table

DOCS = Path(__file__).parents[2] / "docs"


def test_channels__are_periodic_where_messages_are_sent_one_by_one() -> None:
    assert list(channels_of(["paper", "blocked", "sensors-only"])) == [
        "paper",
        "blocked",
        "blocked, periodic",
        "sensors-only",
    ]


def test_price__is_nothing_where_everything_is_known() -> None:
    scenario = load_scenario("cooperation-2-paper")
    row = price_of(
        scenario, "paper", {"preset": "paper"}, ["e_v2x_bm", "e_v2x_bm:believed", "full_brake+step:believed"], 20, 7
    )
    assert row.harm["e_v2x_bm"] == pytest.approx(row.harm["e_v2x_bm:believed"], abs=1e-4)
    assert row.above["full_brake+step:believed"] == 0.0
    assert "above, `+step:believed`" in price_table([row]).splitlines()[0]


def test_report__writes_a_figure_and_says_which_worlds(tmp_path: Path) -> None:
    told = price_report(tmp_path / "price.png", presets=["sensors-only"], n=3)
    assert told.count("| sensors-only |") == 1 and "Worlds: SHA-256" in told
    assert (tmp_path / "price.png").stat().st_size > 1000


def test_table__in_the_docs_is_of_the_worlds_that_the_study_takes() -> None:
    page = (DOCS / "baselines.md").read_text("utf-8")
    for name in channels_of():
        assert f"| {name} | " in page, name
    assert (DOCS / "figures" / "price-of-not-knowing.png").exists()


def test_bars__need_a_value_for_each_name() -> None:
    with pytest.raises(InvalidInput, match="every series needs a value"):
        draw_bars(["a", "b"], [("x", [1.0])], "m")
