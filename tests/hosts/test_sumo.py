"""SUMO as a host, where it is installed (the extra ``sumo``): the table of docs/hosts.md, and what is refused."""

import re

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl import errors
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.hosts import SumoHost, find_host
from tests.docs.site import DOCS

PAGE = (DOCS / "hosts.md").read_text("utf-8")
PAPER = eb.load_scenario("paper-random")


def test_sumo__that_is_not_installed_is_told_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(errors, "find_spec", lambda package: None)
    assert run_command(["evaluate", "--host", "sumo"]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "needs the package libsumo, which is not installed: " in told
    assert told.endswith("-m pip install 'ethbrake-marl[sumo]'\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--host", "carla"], "unknown host 'carla'; known: sumo"),
        (["--host", "sumo:x"], "host 'sumo:x': 'x' is no step in s; for instance sumo:0.01"),
        (["--host", "sumo", "--jobs", "3"], "--jobs: a host drives in one process; leave it out, or --host"),
        (["--host", "sumo", "--report", "--output", "a"], "--report: tells of the physics here; leave it out, or"),
        (["--host", "sumo", "--measures", "injury"], "--measures: tells of the physics here; leave it out, or --host"),
        (["--host", "sumo", "--scenario", "standards"], "--host: standards is a group of"),
    ],
)
def test_option_host__refuses_what_does_not_go_with_it(words, message, capsys):
    assert run_command(["evaluate", *words]) == 2
    assert f"ethbrake: error: {message}" in capsys.readouterr().err


def test_sumo__tells_the_table_of_the_page(capsys, monkeypatch):
    pytest.importorskip("libsumo")
    monkeypatch.setenv("COLUMNS", "120")
    (command,) = re.findall(r"```sh\nethbrake (.*?)```", PAGE, re.DOTALL)
    assert run_command(command.replace("\\\n", " ").split()) == 0
    told = capsys.readouterr().out
    there = told[told.index("Here   There") :]
    shown = re.findall(r"^\| `(\S+)` \| (\S+) \| (\S+) \| (.*?) \|$", PAGE, re.MULTILINE)
    assert len(shown) == 4
    for row in shown:
        assert re.search(rf"^{re.escape(row[0])} +{row[1]} +{row[2]} +{re.escape(row[3])} ", there, re.MULTILINE), row
    assert re.search(r"^ppo@shipped\+robust .*\] +0 +0$", there, re.MULTILINE)  # above the bound, distrusted
    assert "Regret" not in told and "proven" not in told  # of the physics here


def test_sumo__begins_where_it_is_told_and_is_one_at_a_time():
    pytest.importorskip("libsumo")
    worlds = PAPER.sample(100, 7).worlds
    with find_host("sumo:0.1").open(worlds) as host:
        told = host.state()
        assert np.abs(told.gaps_m - worlds.gaps_m).max() < 1e-12 and np.array_equal(told.speeds_mps, worlds.speeds_mps)
        with pytest.raises(eb.EthBrakeError, match="a simulation is open in this process"):
            SumoHost(worlds)
    with pytest.raises(eb.EthBrakeError, match=r"dt = 0.0005: must be whole milliseconds"):
        SumoHost(worlds, 0.0005)


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.1])
def test_sumo__is_driven_to_the_end_and_no_vehicle_drives_on_by_its_brakes_after_it_bounced_back(dt):
    pytest.importorskip("libsumo")
    scenario = eb.load_scenario("stress-wide")
    worlds = scenario.sample(60, 3).worlds
    with find_host(f"sumo:{dt}").open(worlds) as host:
        assert eb.drive_host(host, eb.make_agent("full_brake"), scenario, worlds).outcome.ledger.collided.any()
