"""Measures of the user's own: one registered function, and it stands wherever an evaluation is told."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.measures import REGISTERED
from ethbrake_marl.evaluation.statistics import mean, rate
from ethbrake_marl.pages.report import Report

SCENARIO = eb.load_scenario("paper-random")
SAMPLE = SCENARIO.sample(40, 7)


def squared(episodes: Any) -> Any:
    """Squared closing speed of every impact."""
    rows = episodes.rows
    return np.bincount(rows.world, rows.closing_speed_mps**2, minlength=episodes.worlds.n)


def injury(episodes: Any) -> Any:
    """Probability of a severe injury by each vehicle's largest change of speed, struck at the front."""
    return 1.0 / (1.0 + np.exp(4.457 - 0.177 * episodes.largest_speed_change_mps))


def register(function: Any = squared, name: str = "squared", unit: str = "m2/s2") -> None:
    eb.register_measure(name, function, unit=unit)


def evaluated(**options: Any) -> Any:
    agents = {name: eb.make_agent(name, scenario=SCENARIO) for name in ("full_brake", "e_v2x_bm", "ppo@shipped+step")}
    return eb.evaluate(SAMPLE, agents, scenario=SCENARIO, **options)


def test_measure__sees_every_impact_whatever_the_chunk() -> None:
    register()
    whole, parts = evaluated(), evaluated(chunk=7)
    for name, outcome in whole.outcomes.items():
        assert outcome.metrics["squared"] == pytest.approx(outcome.total_harm, rel=1e-9, abs=1e-9)
        assert outcome.metrics["squared"].tolist() == parts.outcome(name).metrics["squared"].tolist()
    taken = whole.outcome("full_brake").take(np.array([3, 1]))
    assert taken.metrics["squared"].tolist() == whole.outcome("full_brake").metrics["squared"][[3, 1]].tolist()
    assert evaluated(aftermath=False).outcome("full_brake").metrics == {}


def test_measure__changes_nothing_else() -> None:
    before = evaluated()
    register()
    after = evaluated()
    for name, outcome in before.outcomes.items():
        assert outcome.metrics == {}
        assert outcome.total_harm.tobytes() == after.outcome(name).total_harm.tobytes()


def test_measure_of_each_vehicle__stands_in_rows_frame_markdown_and_report() -> None:
    register()
    register(injury, "injury", "1")
    found = evaluated()
    rows = eb.summarise(found)
    assert [*rows[0].metrics] == ["squared", "injury_1", "injury_2", "injury_3"]
    assert rows[1].metrics["injury_2"] == mean(found.outcome("e_v2x_bm").metrics["injury_2"])
    told = rows[0].to_json()
    assert told["metric_squared"] == pytest.approx(told["total_harm"]) and len(told["metric_injury_3_interval"]) == 2
    assert told["metrics"]["injury_3"] == "injury, vehicle 3 (1)"
    frame = found.to_frame("columns")
    assert frame["metric_squared"] == pytest.approx(frame["total_harm"])
    for text in (rows.markdown(), Report("mine", rows, found).html):
        assert "squared (m2/s2)" in text and "injury, vehicle 2 (1)" in text
    assert "Squared closing speed of every impact." in Report("mine", rows, found).html


def test_change_of_speed__is_the_largest_of_each_vehicle_and_0_without_an_impact() -> None:
    register(lambda_free, "change", "m/s")
    found = evaluated().outcome("full_brake")
    changes = np.stack([found.metrics[f"change_{i}"] for i in (1, 2, 3)], axis=1)
    assert ((changes > 0.0).any(axis=1) == found.collided).all() and (changes >= 0.0).all()


def lambda_free(episodes: Any) -> Any:
    """Largest change of speed of each vehicle."""
    return episodes.largest_speed_change_mps


def change_of_vehicle_3(episodes: Any) -> Any:
    """Largest change of speed of Vehicle 3 in one impact."""
    return episodes.largest_speed_change_mps[:, 2]


def hit_hard(episodes: Any) -> Any:
    """Whether Vehicle 3 was hit hard."""
    return episodes.largest_speed_change_mps[:, 2] > 2.0


def test_measure__one_function_and_it_stands_in_every_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    register(change_of_vehicle_3, "change_of_rear", "m/s")
    register(hit_hard, "hit_hard", "1")
    names, agents = ("metric_change_of_rear", "metric_hit_hard"), ["--agents", "full_brake,e_v2x_bm", "--seed", "7"]

    def told(*words: str) -> str:
        assert run_command(["evaluate", *agents, *words]) == 0
        return capsys.readouterr().out

    text = " ".join(told("--episodes", "40", "--per-world", "out.csv", "--report", "out.html").split())
    rows = list(csv.DictReader(Path("out.csv").read_text().splitlines()))[:40]
    change, hit = (np.array([float(row[name]) for row in rows]) for name in names)
    assert np.ptp(change) > 1.0 and set(hit) == {0.0, 1.0} and ((change > 2.0) == hit).all()
    for page in (text, Path("out.html").read_text()):
        assert "change_of_rear (m/s)" in page and f"{change.mean():.2f}" in page and "hit_hard (1)" in page
    results = json.loads(Path("out.csv.json").read_text())[0]
    expected = [mean(change), rate(int(hit.sum()), 40)]
    assert [(results[n], tuple(results[f"{n}_interval"])) for n in names] == [(e.value, e.interval) for e in expected]
    told("--episodes", "40", "--per-world", "out.parquet")
    table = pyarrow.parquet.read_table("out.parquet")
    assert [table[name].to_pylist()[:40] for name in names] == [change.tolist(), hit.tolist()]
    sharded = json.loads(told("--episodes", "1040", "--shards", "2", "--json", "--output", "kept", "--rows"))
    (whole,) = (row for row in json.loads(told("--episodes", "1040", "--json")) if row["agent"] == "full_brake")
    assert [sharded[0][name] for name in names] == [whole[name] for name in names]
    parts = [pyarrow.parquet.read_table(path) for path in sorted(Path("kept").rglob("*.parquet"))]
    first = [row for part in parts for row in part.to_pylist() if row["agent"] == "full_brake"][:40]
    assert [row[names[0]] for row in first] == change.tolist()
    lines = eb.summarise(evaluated()).markdown().splitlines()
    assert "| change_of_rear (m/s) | hit_hard (1) |" in lines[0]


def test_plugin__with_a_metric_is_seen_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine.py").write_text(
        "import ethbrake_marl as eb\n\n\ndef worst(episodes):\n    'Largest change of speed in the line.'\n"
        "    return episodes.largest_speed_change_mps.max(axis=1)\n\n\n"
        "eb.register_measure('worst', worst, unit='m/s')\n"
    )
    words = ["evaluate", "--plugin", str(tmp_path / "mine.py"), "--episodes", "5", "--agents", "full_brake"]
    assert run_command([*words, "--per-world", str(tmp_path / "out.csv")]) == 0
    assert "worst (m/s)" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "out.csv").read_text().splitlines()))
    (told,) = json.loads((tmp_path / "out.csv.json").read_text())
    assert told["metric_worst"] == pytest.approx(np.mean([float(row["metric_worst"]) for row in rows]))
    assert run_command(["evaluate", "--help"]) == 0 and "Measures" in capsys.readouterr().out


def test_register_measure__refuses_what_cannot_be_used() -> None:
    def flat(episodes: Any) -> Any:
        """One number for all."""
        return 1.0

    def broken(episodes: Any) -> Any:
        """Not a number."""
        return np.full(episodes.worlds.n, np.nan)

    def masked(episodes: Any) -> Any:
        """Nothing that counts."""
        return np.ma.masked_array(np.zeros(episodes.worlds.n), True)

    def greedy(episodes: Any) -> Any:
        """Changes what it is given."""
        episodes.rows.closing_speed_mps[:] = 0.0

    for function, name, message in (
        (squared, "Squared", "must be 1 to 64 of a-z"),
        *((squared, f"delta_v_{end}", "not ending in _ and a number") for end in ("2", "interval", "low", "high")),
        (masked, "mine", r"'mine': gave object of shape \(\)"),
        (3, "mine", "needs a function with a docstring"),
        (lambda episodes: 0, "mine", "needs a function with a docstring"),
        (flat, "mine", r"gave float64 of shape \(\); must be numbers of shape \(2,\), one per world, or \(2, 3\)"),
        (broken, "mine", "'mine': is nan in world 0; must be finite"),
        (greedy, "mine", r"'mine': its function fails: ValueError: .*read-only"),
    ):
        with pytest.raises(InvalidInput, match=message):
            register(function, name)
    assert not REGISTERED
    register()
    register()
    with pytest.raises(AlreadyExists, match="measure 'squared' is registered already"):
        register(injury)


def test_measure__of_another_form_than_when_it_was_registered_is_refused() -> None:
    def by_size(episodes: Any) -> Any:
        """A truth of few worlds, a number of many."""
        change = episodes.largest_speed_change_mps.max(axis=1)
        return change > 3.0 if len(change) < 10 else change

    def by_call(episodes: Any) -> Any:
        """One for each vehicle, in two worlds alone."""
        return episodes.largest_speed_change_mps[:, 0] if episodes.worlds.n > 2 else episodes.largest_speed_change_mps

    for function, message in (
        (by_size, "'mine': gave a number per world; when it was registered it gave a truth per world"),
        (by_call, "'mine': gave a number per world; when it was registered it gave a number per vehicle"),
    ):
        register(function, "mine")
        with pytest.raises(InvalidInput, match=message):
            evaluated()
        REGISTERED.clear()
