"""The agent ``human``: required decelerations, reaction times and braking by hand; a light touch startles nobody."""

from itertools import pairwise

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.field.human import required_deceleration
from ethbrake_marl.motion.layout import SPEED

ROLES = {"vehicle_1": "coast", "vehicle_2": "learner"}
LINE = eb.load_scenario("standards-ccrs-followed").replace(
    table=None, gaps_m=50, speeds_mps=20, braking_capacity_mps2=[4, 9, {"uniform": [5, 8]}], latency_s=0, horizon_s=40
)


def followed(speed: float, time_gap: float, driver: str = "human", **changes: object) -> eb.Scenario:
    """A line with nothing ahead of Vehicle 2, which everybody drives at one speed."""
    changes = {"gaps_m": [5000, speed * time_gap], "speeds_mps": [40, speed, speed], **changes}
    return LINE.replace(roles={**ROLES, "vehicle_3": driver}, **changes)


def driven(scenario: eb.Scenario, brakes: list[tuple[float, float]], until_s: float, worlds: int = 20) -> list[State]:
    """States while Vehicle 2 brakes with the deceleration (m/s2) of the first of ``brakes`` that has not ended (s)."""
    _, game = eb.open_game(scenario)
    states = [game.reset(scenario.sample(worlds, seed=3))]
    while (time := states[-1].time_s[0]) < until_s - 1e-9:
        deceleration = next((each for end, each in brakes if time < end - 1e-9), 0.0)
        states.append(game.step(states[-1], np.full((worlds, 1), -deceleration / 9.0))[0])
    return states


@pytest.mark.parametrize(
    ("gap", "speed", "front", "braking", "required"),
    [
        (20, 20, 20, 0, 0),
        (20, 20, 25, 0, 0),
        (10, 20, 15, 0, 25 / 20),
        (10, 20, 15, 2, 2 + 25 / 20),  # closest after 4 s, and the vehicle ahead stands after 7.5 s
        (10, 20, 15, 6, 400 / (2 * (10 + 225 / 12))),  # it stands after 2.5 s
        (20, 20, 20, 8, 400 / (2 * (20 + 25))),
        (20, 20, 0, 6, 10),
        (np.inf, 20, 0, 0, 0),
    ],
)
def test_required_deceleration__by_hand(
    gap: float, speed: float, front: float, braking: float, required: float
) -> None:
    arguments = (np.array([float(each)]) for each in (gap, speed, front, braking))
    assert required_deceleration(*arguments).tolist() == pytest.approx([required])


def test_reaction_times__are_drawn_once_a_world_or_fixed() -> None:
    worlds = followed(20, 1).sample(4000, seed=1)

    def reactions(spec: str, alert: State = worlds) -> np.ndarray:
        return np.asarray(eb.make_agent(spec, scenario=LINE).begin(alert, 3).reaction_s)

    drawn = reactions("human")
    assert drawn.mean() == pytest.approx(1.21, abs=0.03) and drawn.std() == pytest.approx(0.60, abs=0.03)
    assert np.median(drawn) == pytest.approx(1.07, abs=0.03) and drawn.max() == pytest.approx(1.21 + 3 * 0.63)
    assert reactions("human", worlds.take([7, 5])).tolist() == drawn[[7, 5]].tolist()
    assert set(reactions("human:reaction=1.25:sd=0")) == {1.25}
    assert not reactions("human:reaction=0:sd=0").any()


def test_braking__by_hand() -> None:
    """Vehicle 1 brakes with 6 m/s2 from 30 m/s, 50 m ahead. What is seen at 0.05 s is acted on at 0.55 s."""
    pair = eb.Scenario(
        name="two", vehicles=2, gaps_m=50, speeds_mps=30, braking_capacity_mps2=[6, 9], driving_capacity_mps2=3,
        mass_t=1, latency_s=[0, 0.05], restitution=0,
    )  # fmt: skip
    _, game = eb.open_game(pair)
    team = eb.Team("one", {2: eb.make_agent("human:reaction=0.5:sd=0:jerk=1000", scenario=pair)})
    states = [state for _, state in eb.play(game, pair.sample(1, 7), team)]
    commands = [float(state.wanted[0, 2]) for state in states[1:7]]
    # Seen: 29.7 m/s, 49.9925 m. Expected at 0.55 s: 26.7 m/s after 14.1 m, the own way is 15 m. The gap less 2 m:
    room = 49.9925 + 14.1 - 15 - 2
    assert commands[:5] == [0.0] * 5
    assert commands[5] == pytest.approx(-900 / (2 * (room + 26.7**2 / 12)), abs=1e-9)


TOUCHES = [(0.02, 9.0), (0.1, 9.0), (0.3, 9.0), (0.3, 3.0), (0.5, 1.0), (1.0, 1.0)]  # s, m/s2


@pytest.mark.parametrize(("touch_s", "deceleration"), TOUCHES)
@pytest.mark.parametrize(("speed", "time_gap"), [(3, 1.5), (8, 0.5), (20, 0.5), (20, 3.0), (33, 1.0)])
def test_touch_of_the_brake__makes_nobody_stop(
    touch_s: float, deceleration: float, speed: float, time_gap: float
) -> None:
    step_s = 0.02 if touch_s == 0.02 else 0.1
    line = followed(speed, time_gap, time_step_s=step_s)
    states = driven(line, [(touch_s, deceleration)], 15.0, worlds=3 if touch_s == 0.02 else 20)
    front, own = states[-1].line[:, SPEED, 2], states[-1].line[:, SPEED, 3]
    assert own == pytest.approx(front, rel=0.05)
    assert min(state.line[:, SPEED, 3].min() for state in states) > 0.0


@pytest.mark.parametrize("driver", ["human", "human:reaction=3:sd=0", "human:reaction=0.3:sd=0"])
def test_other_touches__of_other_drivers(driver: str) -> None:
    pulses = [(0.2, 9.0), (4.0, 0.0), (4.2, 9.0), (7.0, 0.0), (8.0, 1.0)]
    states = driven(followed(25, 1.2, driver), pulses, 23.0)
    assert states[-1].line[:, SPEED, 3] == pytest.approx(states[-1].line[:, SPEED, 2], rel=0.05)
    assert not states[-1].collided.any() and states[-1].line[:, SPEED, 3].min() > 19.0


def test_driver__does_nothing_before_anything_happens__and_drives_no_faster_than_before() -> None:
    states = driven(followed(20, 0.4), [(6.0, 0.0), (7.0, 3.0), (12.0, 0.0), (20.0, -6.0)], 40.0, worlds=5)
    before = [state for state in states if state.time_s[0] < 6.0]
    assert all((state.line[:, SPEED, 3] == 20.0).all() for state in before)
    assert states[-1].line[0, SPEED, 2] > 30.0  # Vehicle 2 has driven on
    assert max(state.line[:, SPEED, 3].max() for state in states) <= 20.0 + 1e-9
    assert states[-1].line[:, SPEED, 3] == pytest.approx(20.0, rel=0.1)


def test_full_braking__is_answered_late_and_as_hard_as_the_vehicle_can() -> None:
    """With 1 s of reaction and a time gap of 1 s the driver brakes 1 to 1.1 s later, harder by 12.65 m/s3."""
    states = driven(followed(20, 1.0, "human:reaction=1:sd=0"), [(9.0, 9.0)], 2.5, worlds=10)
    forces = np.array([state.forces_mps2[:, 2] for state in states])
    times = np.array([state.time_s[0] for state in states])
    assert (forces[times < 1.05] == 0.0).all() and (forces[times > 1.25] < -1.0).all()
    assert min(float((later - earlier).min()) for earlier, later in pairwise(forces)) >= -1.265 - 1e-9
    assert forces[-1] == pytest.approx(-states[0].braking_capacity_mps2[:, 2])
