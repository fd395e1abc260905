"""An agent drives Vehicle 2 in HighwayEnv's road simulation: in which worlds does it report a collision? See field.py.

Run in an environment with highway-env.
"""

import json

import numpy as np
from highway_env.road.lane import StraightLane
from highway_env.road.road import Road, RoadNetwork
from highway_env.vehicle.kinematics import Vehicle

import ethbrake_marl as eb

STEP_S, WORLDS, END_S, START_M, LIMIT_MPS = 0.01, 60, 8.0, 1000.0, 50


def road_of(gaps_m: np.ndarray, speeds_mps: np.ndarray) -> Road:
    network = RoadNetwork()
    network.add_lane("a", "b", StraightLane([0, 0], [5 * START_M, 0], speed_limit=LIMIT_MPS))
    road = Road(network, np_random=np.random.RandomState(0))
    places = START_M - np.append(0.0, np.cumsum(gaps_m + Vehicle.LENGTH))
    pairs = zip(places.tolist(), speeds_mps.tolist(), strict=True)
    road.vehicles = [Vehicle(road, [place, 0.0], 0.0, speed) for place, speed in pairs]
    return road


def crashes(agent: str, scenario: eb.Scenario, alert: eb.State) -> np.ndarray:
    """Whether HighwayEnv reports a collision, [n]."""
    roads = [road_of(alert.gaps_m[k], alert.speeds_mps[k]) for k in range(alert.n)]
    driver, brakes = eb.Driver(agent, alert, scenario=scenario), -alert.braking_capacity_mps2
    commands, hit = np.where(alert.latency_s == 0.0, brakes, 0.0), np.zeros(alert.gaps_m.shape, np.bool_)
    for step in range(round(END_S / STEP_S)):
        time_s = round(step * STEP_S, 9)
        if time_s >= driver.first_s[0] and step % round(driver.time_step_s / STEP_S) == 0:
            places = np.array([[vehicle.position[0] for vehicle in road.vehicles] for road in roads])
            speeds = np.array([[vehicle.speed for vehicle in road.vehicles] for road in roads])
            gaps = places[:, :-1] - Vehicle.LENGTH - places[:, 1:]
            commands[:, 1] = driver.decide(time_s, gaps, speeds, commands, hit)
        commands[:, 2] = np.where(time_s >= alert.latency_s[:, 2], brakes[:, 2], 0.0)
        for k, road in enumerate(roads):
            for vehicle, command in zip(road.vehicles, commands[k].tolist(), strict=True):
                vehicle.act({"acceleration": max(command, -vehicle.speed / STEP_S), "steering": 0.0})
            road.step(STEP_S)
            struck = np.array([vehicle.crashed for vehicle in road.vehicles])
            hit[k] |= struck[1:] & struck[:-1]
    return hit.any(axis=1)


def tell(agent: str) -> None:
    """Print in which share of the worlds both collide, and both agree, as JSON."""
    scenario = eb.load_scenario("paper-random")
    alert = scenario.sample(WORLDS, seed=7)
    ours = eb.evaluate(alert, agent, scenario=scenario)[agent]["collided"]
    theirs = crashes(agent, scenario, alert)
    print(json.dumps({"crashed": float(theirs.mean()), "same_worlds": float((theirs == ours).mean())}))
