"""The same results under other objectives."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.evaluation import evaluate, write_per_world
from ethbrake_marl.harm import STANDARD, declared_objectives
from ethbrake_marl.scenario import Scenario


def test_rescored__one_impact_by_hand(pair: Scenario) -> None:
    # Harm 9, of which the vehicles bear 4.95 and 4.05 (see conftest).
    result = evaluate(pair.sample(2, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    rows = {row.objective: row for row in result.rescore([*STANDARD, "weighted:1,3"]) if row.harm_count == "total"}
    borne, root = (4.95, 4.05), math.sqrt(0.5)
    expected = {
        "total": (9.0, 9.0),
        "own": borne,
        "social:45": (root * 9.0, root * 9.0),
        "maximin": (4.95, 4.95),
        "mass-weighted": (2 * (4.5 * 4.95 + 5.5 * 4.05) / 10.0,) * 2,
        "weighted:1,3": (2 * (4.95 + 3 * 4.05) / 4.0,) * 2,
    }
    assert list(rows) == list(expected)
    for name, row in rows.items():
        assert [estimate.value for estimate in row.each] == pytest.approx(expected[name]), name
    found = rows["own"].to_json()
    assert (found["objective"], found["harm_count"], found["vehicle_1_interval"]) == (
        "own",
        "total",
        pytest.approx([4.95] * 2),
    )
    assert json.loads(json.dumps(found, allow_nan=False)) == found


def test_write_per_world__objectives_are_columns(pair: Scenario, tmp_path: Path) -> None:
    result = evaluate(pair.sample(2, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    write_per_world(tmp_path / "plain.csv", result)
    write_per_world(tmp_path / "more.csv", result, objectives=["own", "weighted:1,3"])
    plain, more = (list(csv.DictReader((tmp_path / f"{n}.csv").read_text().splitlines())) for n in ("plain", "more"))
    new = [name for name in more[0] if name not in plain[0]]
    assert new[:3] == ["own_first_1", "own_first_2", "own_total_1"] and len(new) == 8
    assert more[0]["own_total_2"] == more[0]["total_harm_2"]
    assert float(more[1]["weighted:1,3_total_1"]) == pytest.approx(2 * (4.95 + 3 * 4.05) / 4.0)


def test_declared_objectives__names_and_bad_ones() -> None:
    assert declared_objectives(["standard", "weighted:1,2"], 2) == [*STANDARD, "weighted:1,2"]
    assert declared_objectives([], 2) == []
    for bad in (["own", "own"], ["ownn"], ["social:91"], ["weighted:1,2,3"]):
        with pytest.raises(EthBrakeError):
            declared_objectives(bad, 2)
    with pytest.raises(InvalidInput, match="'own' is given twice"):
        declared_objectives(["standard", "own"], 2)
