"""SUMO as a host, if the extra ``sumo`` is installed: the table of docs/extensions/hosts.md, and what is refused."""

import re

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl import errors
from ethbrake_marl.extensions.hosts.protocol import drive_host
from ethbrake_marl.extensions.hosts.sumo import SumoHost, find_host
from tests.docs.site import DOCS

PAGE = (DOCS / "extensions" / "hosts.md").read_text("utf-8")
PAPER = eb.load_scenario("paper-random")


def test_sumo__that_is_not_installed_is_told_in_one_line(monkeypatch):
    monkeypatch.setattr(errors, "find_spec", lambda package: None)
    with pytest.raises(eb.MissingExtra, match=r"needs the package libsumo, which .*'ethbrake-marl\[sumo\]'$"):
        find_host("sumo")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("carla", "unknown host 'carla'; known: sumo"),
        ("sumo:x", "host 'sumo:x': 'x' is not a step length; give a number of seconds"),
    ],
)
def test_find_host__refuses_what_is_none(spec, message):
    with pytest.raises(eb.EthBrakeError, match=message):
        find_host(spec)


def test_sumo__tells_the_table_of_the_page(capsys):
    pytest.importorskip("libsumo")
    (program,) = re.findall(r"```python\n([^`]*find_host.*?)```", PAGE, re.DOTALL)
    names = {}
    exec(program, names)
    told = capsys.readouterr().out.splitlines()
    shown = re.findall(r"^\| `(\S+)` \| (\S+) \| (\S+) \| (.*?) \|$", PAGE, re.MULTILINE)
    assert told == [" ".join(row) for row in shown] and len(shown) == 3
    outcome, distrusted = names["there"].outcome("ppo+robust"), names["distrusted"]["ppo+robust"]
    assert not (outcome.first_impact_harm > outcome.predicted_harm).any() and not distrusted.any()
    text = eb.summarise(names["there"]).markdown()
    assert "Regret" not in text and "proven" not in text  # of the physics here


def test_sumo__begins_where_it_is_told_and_is_one_at_a_time():
    pytest.importorskip("libsumo")
    worlds = PAPER.sample(100, 7).worlds
    with find_host("sumo:0.1").open(worlds) as host:
        told = host.state()
        assert np.abs(told.gaps_m - worlds.gaps_m).max() < 1e-12 and np.array_equal(told.speeds_mps, worlds.speeds_mps)
        with pytest.raises(eb.EthBrakeError, match="another SUMO simulation is open in this process"):
            SumoHost(worlds)
    with pytest.raises(eb.EthBrakeError, match=r"dt = 0.0005: the step length must be a whole number of milliseconds"):
        SumoHost(worlds, 0.0005)


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.1])
def test_sumo__is_driven_to_the_end_and_no_vehicle_drives_on_by_its_brakes_after_it_bounced_back(dt):
    pytest.importorskip("libsumo")
    scenario = eb.load_scenario("stress-wide")
    worlds = scenario.sample(60, 3).worlds
    with find_host(f"sumo:{dt}").open(worlds) as host:
        assert drive_host(host, eb.make_agent("full_brake"), scenario, worlds).outcome.ledger.collided.any()
