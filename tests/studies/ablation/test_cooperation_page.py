"""What docs/cooperation.md shows is what the code does."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest

from ethbrake_marl.harm import KINDS, scored
from ethbrake_marl.learning.training import Scheme
from ethbrake_marl.scenario import Scenario, list_scenarios, load_scenario, parse_yaml
from ethbrake_marl.scenario.v2x import CHANNELS, PRESETS, V2X

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "cooperation.md").read_text("utf-8")


def rows(heading: str) -> dict[str, list[str]]:
    """The first table below a header line: first cell -> other cells."""
    below = PAGE.split(heading, 1)[1].split("\n\n", 1)[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in below.splitlines() if line[:3] == "| `"]
    return {row[0]: row[1:] for row in cells}


def test_page__its_presets_are_those_of_the_code():
    table = rows("| preset | p | r |")
    assert list(table) == [f"`{name}`" for name in PRESETS]
    for name in ("clear", "nominal", "congested", "blocked"):
        channel, (p, r, lost_messages, burst, lost, _) = CHANNELS[name], table[f"`{name}`"]
        assert (float(p), float(r), float(lost)) == (channel.loss_begins, channel.loss_ends, channel.lost)
        share = 100 * channel.loss_begins / (channel.loss_begins + channel.loss_ends)
        assert float(lost_messages.split()[0]) == pytest.approx(share, abs=0.05)
        assert float(burst.split()[0]) == pytest.approx(1 / channel.loss_ends, abs=0.05)


def test_page__names_every_training_scheme():
    assert {re.findall("`(.*?)`", cell)[0] for cell in rows("| scheme | networks |")} == set(get_args(Scheme))


def test_page__names_every_key_objective_and_level():
    keys = {key for cell in rows("| key | range |") for key in re.findall("`(.*?)`", cell)}
    assert keys == set(V2X.model_fields)
    objectives = [re.findall("`(.*?)[:`]", cell)[0] for cell in rows("| `objective` | for")]
    assert objectives == list(KINDS)
    levels = {entry.name for entry in list_scenarios() if entry.path.parent.name == "cooperation"}
    assert set(rows("| scenario | learns |")) == {f"`{name}`" for name in levels}


def test_page__its_example_of_a_training_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,) = (b for b in re.findall("```python\n(.*?)```", PAGE, re.DOTALL) if "result = eb.train(" in b)
    names: dict[str, object] = {}
    exec(
        block.replace('("cooperation-ppo")', '("cooperation-ppo").replace(total_steps=1, n_envs=8)').replace(
            "1000", "20"
        ),
        names,
    )
    assert names["harm"].shape == (20,)
    assert (tmp_path / "runs" / "pair" / "team.json").is_file()


def test_page__its_examples_run():
    names: dict[str, object] = {}
    blocks = [b for b in re.findall("```python\n(.*?)```", PAGE, re.DOTALL) if "result = eb.train(" not in b]
    assert len(blocks) == 4 and "for preset in PRESETS" in blocks[1]  # 100,000 worlds of each
    for block in (blocks[0], *blocks[2:]):
        exec(block.replace("1000", "20"), names)
    assert names["columns"]["social:45"].shape == (20, 3)
    assert names["columns"].keys() == scored(names["result"].outcome("full_brake").ledger, "first").keys()


def test_page__its_level_is_a_valid_scenario():
    (text,) = re.findall("```yaml\n(.*?)```", PAGE, re.DOTALL)
    scenario = Scenario.from_document(parse_yaml(text, "docs/cooperation.md"))
    assert scenario.objective == ("total", "social:45", "total") and scenario.v2x.channel.hears == "front"
    assert not scenario.sample(5, 0).worlds.vehicles.is_known_at_once


def test_page__its_messages_are_those_of_the_code():
    from_page = re.findall(r"my.yaml, line 9: (.*)", PAGE)
    ten = {"vehicles": 10, "gaps_m": 5, "speeds_mps": 20, "latency_s": 0.0, "mass_t": 5}
    ten |= {"braking_capacity_mps2": 6, "driving_capacity_mps2": 6}
    given = [{"v2x": {"preset": "clear", "senses": "none"}}, {"v2x": "blocked", **ten}]
    for message, changes in zip(from_page, given, strict=True):
        with pytest.raises(ValueError, match=re.escape(message)):
            load_scenario("paper-random").replace(roles={"vehicle_2": "learner"}, **changes)
