"""Results by group on the command line: by the scenario of a mixture, by the type of a vehicle."""

from __future__ import annotations

import csv
import json
from pathlib import Path

from ethbrake_marl.scenario import scenario_path


def test_by__tells_every_group_and_writes_it_down(ethbrake, tmp_path: Path):
    out = tmp_path / "w.csv"
    command = ("evaluate", "--scenario", "mixture-delays", "--agents", "full_brake,coast", "--episodes", "30")
    told = ethbrake(*command, "--by", "scenario", "--per-world", str(out))
    assert told.status == 0
    for name, worlds in (("paper-delay-high", 11), ("paper-delay-low", 8), ("paper-delay-middle", 11)):
        assert f"\n{name}: {worlds} worlds\n" in told.out
    rows = json.loads((tmp_path / "w.csv.json").read_text())
    assert [row["agent"] for row in rows] == ["full_brake", "coast"]
    for row in rows:
        assert {name: group["episodes"] for name, group in row["groups"].items()} == {
            "paper-delay-high": 11,
            "paper-delay-low": 8,
            "paper-delay-middle": 11,
        }
        assert {group["agent"] for group in row["groups"].values()} == {row["agent"]}
    lines = list(csv.DictReader(out.read_text().splitlines()))
    assert sum(line["scenario"] == "paper-delay-low" for line in lines) == 16


def test_validate__counts_types_and_scenarios(ethbrake):
    assert "; vehicle_1_type: car 714, truck 197, van 89;" in ethbrake("scenario", "validate", "realistic-mixed").out
    assert "; scenario: paper-delay-high 332, paper-delay-low" in ethbrake("scenario", "validate", "mixture-delays").out


def test_validate__tells_what_may_not_be_meant(ethbrake, tmp_path: Path):
    assert "note:" not in ethbrake("scenario", "validate", "paper-random").out
    text = Path(scenario_path("paper-random")).read_text()
    odd = tmp_path / "odd.yaml"
    text = text.replace("name: paper-random", "name: odd").replace("horizon_s: 8", "horizon_s: 2")
    odd.write_text(text.replace("latency_s: [0, ", "latency_s: [0.3, "))
    answer = ethbrake("scenario", "validate", str(odd))
    assert answer.status == 0
    assert "at the horizon (2 s) something still moves in 1,000 of them" in answer.out
    assert "Vehicle 1, whose braking is the alert, has a latency above 0 in 1,000 of them" in answer.out
    told = json.loads(ethbrake("scenario", "validate", str(odd), "--json").out)
    assert (told["moving_at_horizon"], told["vehicle_1_late"], told["worlds"]) == (1000, 1000, 1000)
    table = ethbrake("evaluate", "--scenario", str(odd), "--agents", "full_brake", "--episodes", "20").out
    assert "something still moved, and what came after counts nowhere; worlds, of 20: full_brake 20." in (
        " ".join(table.split())
    )


def test_set__changes_every_scenario_of_a_mixture(ethbrake):
    command = ("evaluate", "--scenario", "mixture-delays", "--agents", "full_brake", "--episodes", "5", "--json")
    (row,) = json.loads(ethbrake(*command, "--set", "mass_t=4", "--set", "gaps_m=9").out)
    assert row["parameters"]["mass_t"] == [4.0] * 3
    assert row["parameters"]["gaps_m"] == [9.0] * 2
