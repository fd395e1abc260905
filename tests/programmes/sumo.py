"""An agent drives Vehicle 2 in SUMO, on one road per world; what is the same there, and what is not? See field.py.

SUMO's vehicles pass through each other. ``drive(..., impacts=True)`` applies momentum and restitution where SUMO
reports a gap of 0 or less. Run in an environment with eclipse-sumo and libsumo.
"""

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import sumo

import ethbrake_marl as eb

STEP_S, WORLDS, LENGTH_M, END_S = 0.01, 200, 5.0, 8.0
START_M, PLATE_MPS = 1000.0, 1e-5  # front of Vehicle 1 on its road; a slower contact is no impact
SIMPLE = {"minGap": 0, "accel": 9, "decel": 9, "emergencyDecel": 9, "sigma": 0, "tau": 0.01, "maxSpeed": 50}
OPTIONS = {
    "--step-length": STEP_S, "--step-method.ballistic": "true", "--collision.action": "none", "--no-step-log": "true",
    "--no-warnings": "true", "--default.speeddev": 0,
}  # fmt: skip


def program(name: str) -> str:
    return str(Path(sumo.__path__[0]) / "bin" / name)


def write_network(folder: Path, alert: eb.State) -> tuple[str, str]:
    """Write a road for each world, and its vehicles at the alert."""
    worlds = range(alert.n)
    nodes = "".join(f'<node id="{end}{k}" x="{x}" y="{20 * k}"/>' for k in worlds for end, x in (("a", 0), ("b", 2000)))
    edges = "".join(f'<edge id="r{k}" from="a{k}" to="b{k}" numLanes="1" speed="50"/>' for k in worlds)
    files = {"nodes": folder / "n.nod.xml", "edges": folder / "e.edg.xml"}
    for kind, text in (("nodes", nodes), ("edges", edges)):
        files[kind].write_text(f"<{kind}>{text}</{kind}>")
    network, routes = str(folder / "w.net.xml"), str(folder / "w.rou.xml")
    command = [program("netconvert"), "-n", str(files["nodes"]), "-e", str(files["edges"]), "-o", network]
    subprocess.run(command, check=True, capture_output=True)
    fronts_m = START_M - np.cumsum(np.column_stack([np.zeros(alert.n), alert.gaps_m + LENGTH_M]), axis=1)
    kind = "".join(f' {name}="{value}"' for name, value in SIMPLE.items())
    departures = "".join(
        f'<vehicle id="{k}_{i}" type="c" route="r{k}" depart="0" departPos="{float(fronts_m[k, i])!r}"'
        f' departSpeed="{float(alert.speeds_mps[k, i])!r}" insertionChecks="none"/>'
        for k in worlds for i in range(alert.vehicles)
    )  # fmt: skip
    roads = "".join(f'<route id="r{k}" edges="r{k}"/>' for k in worlds)
    Path(routes).write_text(f'<routes><vType id="c" length="{LENGTH_M}"{kind}/>{roads}{departures}</routes>')
    return network, routes


def strike(alert: eb.State, gaps_m: Any, speeds_mps: Any, hit: Any, *, impacts: bool) -> tuple[Any, Any]:
    """First-impact and total harm of one step, [n] m2/s2 each; changes ``hit`` and, with ``impacts``, the speeds."""
    first, total = np.zeros(alert.n), np.zeros(alert.n)
    touching = (gaps_m <= 0.0) & (np.diff(speeds_mps, axis=1) > PLATE_MPS)
    for p in range(alert.vehicles - 1):
        closing = np.where(touching[:, p], np.maximum(speeds_mps[:, p + 1] - speeds_mps[:, p], 0.0), 0.0)
        first += np.where(hit[:, p], 0.0, closing**2)
        hit[:, p] |= closing > 0.0
        if impacts:
            total += closing**2
            front, rear = alert.mass_t[:, p], alert.mass_t[:, p + 1]
            change = (1.0 + alert.restitution) * closing / (front + rear)
            speeds_mps[:, p] += rear * change
            speeds_mps[:, p + 1] -= front * change
    return first, total


def drive(agent: str, scenario: eb.Scenario, alert: eb.State, *, impacts: bool) -> dict[str, Any]:
    """Harm in SUMO, [n] m2/s2, and the gaps at each decision, [decisions, n, N - 1] m."""
    names = [[f"{k}_{i}" for i in range(alert.vehicles)] for k in range(alert.n)]
    with tempfile.TemporaryDirectory() as folder:
        network, routes = write_network(Path(folder), alert)
        options = [str(word) for pair in OPTIONS.items() for word in pair]
        libsumo.start(["sumo", "-n", network, "-r", routes, *options])
        libsumo.simulationStep()
    for name in np.ravel(names):
        libsumo.vehicle.setSpeedMode(name, 32)  # our commands, unchecked
        libsumo.vehicle.setLaneChangeMode(name, 0)
    driver = eb.Driver(agent, alert, scenario=scenario)
    brakes, hit = -alert.braking_capacity_mps2, np.zeros(alert.gaps_m.shape, np.bool_)
    commands, first, total = np.where(alert.latency_s == 0.0, brakes, 0.0), np.zeros(alert.n), np.zeros(alert.n)
    speeds, gaps_seen = alert.speeds_mps.copy(), []
    for step in range(round(END_S / STEP_S)):
        time_s = round(step * STEP_S, 9)
        places = np.array([[libsumo.vehicle.getLanePosition(name) for name in row] for row in names])
        gaps = places[:, :-1] - LENGTH_M - places[:, 1:]
        more = strike(alert, gaps, speeds, hit, impacts=impacts)
        first, total = first + more[0], total + more[1]
        if time_s >= driver.first_s[0] and step % round(driver.time_step_s / STEP_S) == 0:
            gaps_seen.append(gaps)
            commands[:, 1] = driver.decide(time_s, gaps, speeds, commands, hit)  # the accelerations until now
        commands[:, 2] = np.where(time_s >= alert.latency_s[:, 2], brakes[:, 2], 0.0)
        if step == 0:
            inserted = np.abs(gaps - alert.gaps_m).max()
        speeds = np.where((speeds <= 0.0) & (commands < 0.0), 0.0, np.maximum(speeds + commands * STEP_S, 0.0))
        for row, values in zip(names, speeds.tolist(), strict=True):
            for name, speed in zip(row, values, strict=True):
                libsumo.vehicle.setSpeed(name, speed)
        libsumo.simulationStep()
    libsumo.close()
    return {"first": first, "total": total, "gaps": np.array(gaps_seen), "inserted": inserted}


def before_contact(agent: str, scenario: eb.Scenario, alert: eb.State, gaps_m: Any) -> float:
    """Largest difference between the gaps of SUMO and ours before a world's first impact, and while all move, m."""
    (game_scenario, game), worst = eb.open_game(scenario), 0.0
    team = eb.Team.of({"vehicle_2": eb.make_agent(agent, scenario=game_scenario)}, agent)
    for (_, state), gaps in zip(eb.play(game, alert, team), gaps_m, strict=False):
        free = ~state.collided & (state.speeds_mps > 0.0).all(axis=1)
        worst = max(worst, float(np.abs(gaps - state.gaps_m)[free].max(initial=0.0)))
    return worst


def tell(agent: str) -> None:
    """Print what one agent does in SUMO and here, as JSON."""
    scenario = eb.load_scenario("paper-random")
    alert = scenario.sample(WORLDS, seed=7)
    ours = eb.evaluate(alert, agent, scenario=scenario)[agent]
    plain, law = (drive(agent, scenario, alert, impacts=impacts) for impacts in (False, True))
    print(json.dumps({
        "inserted_m": float(law["inserted"]),
        "moved_m": before_contact(agent, scenario, alert, law["gaps"]),
        "same_worlds": float(np.mean((law["first"] > 0.0) == ours["collided"])),
        "first": [float(law["first"].mean()), float(ours["first_impact_harm"].mean())],
        "total": [float(law["total"].mean()), float(ours["total_harm"].mean())],
        "sumo_as_it_is": float(plain["first"].mean()),
    }))  # fmt: skip
