"""The scripts of docs/studies: what they measure, and that the pages show what they print."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.figures import picture_bytes
from ethbrake_marl.limits.limits import best_known
from ethbrake_marl.physics import advance
from ethbrake_marl.scenario import Task, load_scenario
from ethbrake_marl.studies.speed import Effort
from tests.docs.site import DOCS, load

sampling, price, equal_time, scaling = (
    load(f"../studies/{name}") for name in ("sampling", "price", "equal_time", "scaling")
)


PAPER = load_scenario("paper-random")


BASELINES = load("results").read_tables("baselines")


BASE = load_scenario("cooperation-2-paper")


SHORT = Effort(1, 1e-6)


PNG = b"\x89PNG"


@pytest.mark.parametrize("agent", sampling.CONTROLS)
def test_sampling__the_table_in_the_docs_is_the_one_that_it_prints(agent):
    (table,) = (each for each in load("results").read_tables("sampled") if f"`{agent}`" in each.note)
    study = sampling.convergence(PAPER.sample(2000, 7).worlds, agent, steps_s=(0.2, 0.1, 0.05, 0.02))
    note, _, head, _, *rows, _ = sampling.table(study).splitlines()
    assert (note, [head, *rows]) == (table.note, [f"| {' | '.join(row)} |" for row in (table.columns, *table.rows[:4])])
    assert picture_bytes(sampling.draw([study]), "study.png").startswith(PNG)


def test_price__is_nothing_where_everything_is_known():
    found = price.drive(BASE, 12, {"paper": {"preset": "paper"}})["paper"]
    for count in price.COUNTS:
        assert price.price(found, "e_v2x_bm:believed", count).value == pytest.approx(0.0, abs=1e-4)
    assert price.above(found, "e_v2x_bm:believed") is None
    assert price.above(found, f"{price.POLICY}+step:believed").value == 0.0


def test_price__is_paired_by_world_and_told_of_both_counts():
    found = price.drive(BASE, 30, {"sensors-only": {"preset": "sensors-only"}})
    over = BASE.replace(v2x="sensors-only")
    harm = {
        spec: drive(over.sample(30, 7).worlds, make_agent(spec, scenario=over), over, 1).ledger
        for spec in ("e_v2x_bm", "e_v2x_bm:believed")
    }
    for count in price.COUNTS:
        told = price.price(found["sensors-only"], "e_v2x_bm:believed", count)
        difference = harm["e_v2x_bm:believed"].world_harm(count) - harm["e_v2x_bm"].world_harm(count)
        assert told.value == pytest.approx(difference.mean(), abs=1e-9)
    heads = [line for line in price.tables(found).splitlines() if line.startswith("| channel")]
    tables = [table for table in BASELINES if table.columns[0] == "channel"]
    assert heads == [f"| {' | '.join(table.columns)} |" for table in tables] and len(heads) == 5
    assert all([row[0] for row in table.rows] == list(price.channels()) for table in tables)
    assert picture_bytes(price.draw(found), "price.png").startswith(PNG)


@pytest.mark.slow
def test_scaling__costs_are_per_world_step() -> None:
    by_worlds, by_vehicles = list(scaling.by_worlds(SHORT, (1, 3))), list(scaling.by_vehicles(SHORT, (2, 4)))
    kinds = scaling.EMERGENCY, scaling.ENGINE, scaling.APART
    assert [(kinds.index(cost.what), cost.worlds, cost.vehicles) for cost in by_worlds] == [
        (0, 1, 3), (1, 1, 3), (0, 3, 3), (1, 3, 3),
    ]  # fmt: skip
    assert [(kinds.index(cost.what), cost.vehicles) for cost in by_vehicles] == [(0, 2), (2, 2), (0, 4), (2, 4)]
    assert all(0.0 < cost.nanoseconds < math.inf for cost in by_worlds + by_vehicles)


drawings = load("../drawings")


@pytest.mark.parametrize("name", drawings.DRAWINGS)
def test_drawing__is_the_one_that_is_shown(name: str) -> None:
    assert f"](figures/model-{name}.svg)" in (DOCS / "model.md").read_text("utf-8").replace("\n", " ")
    made = picture_bytes(drawings.DRAWINGS[name](), "made.svg")
    assert made == (DOCS / "figures" / f"model-{name}.svg").read_bytes()


def test_equal_time__tells_the_harm_of_an_evaluation_in_the_columns_of_the_page() -> None:
    driven = equal_time.drive(
        PAPER.sample(20, 8), make_lineup(["coast", "full_brake", "e_v2x_bm"], PAPER), PAPER, repeats=2
    )
    rows = {row[0]: row for row in equal_time.rows_of(driven, "full_brake")}
    full, coast = (driven[name][1].first_impact_harm for name in ("full_brake", "coast"))
    assert rows["`e_v2x_bm`"][1] == "true model" and rows["`full_brake`"][5] == ""
    assert rows["`coast`"][3] == f"{coast.mean():.3f}"
    assert rows["`coast`"][5].startswith(f"{(coast - full).mean():+.3f} [")
    assert list(equal_time.HEAD) in [table.columns for table in BASELINES]
    worlds = PAPER.sample(equal_time.WORLDS, equal_time.SEED).worlds  # which no table holds
    assert not np.isfinite(best_known(worlds, Task(PAPER, PAPER.learners))["first"]).any()


@pytest.mark.parametrize("vehicles", [2, 50])
def test_scaling__its_lines_are_the_same_every_time_and_apart_in_their_first_step(vehicles: int) -> None:
    worlds, again = scaling.make_lines(40, vehicles), scaling.make_lines(40, vehicles)
    assert worlds.speeds_mps.shape == (40, vehicles)
    assert (worlds.gaps_m == again.gaps_m).all() and (worlds.speeds_mps == again.speeds_mps).all()
    after, impacts = advance(worlds, -worlds.vehicles.braking_capacity_mps2, 0.1)
    assert impacts.count.sum() == 0 and (after.gaps_m > 0.0).all()
