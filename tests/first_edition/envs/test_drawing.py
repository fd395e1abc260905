"""What the environments draw: pictures, words and windows of the running worlds."""

from hashlib import sha256
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.envs.rendering import BODY_M
from ethbrake_marl.first_edition.envs.trace import Trace
from tests.first_edition.contract.interfaces import CRASH

near = pytest.approx
FLASH = (255, 214, 10)
COAST = np.zeros(1, np.float32)


def crash(mode: str | None = "rgb_array", **changes: Any) -> Any:
    environment = gymnasium.make("EthBrake-v1", scenario=CRASH.replace(**changes), render_mode=mode)
    environment.reset(seed=0)
    return environment


def to_its_end(environment: Any) -> list[Any]:
    """What is rendered after each step, coasting; the world's time stands before it."""
    shown, ended = [], False
    while not ended:
        *_, terminated, truncated, info = environment.step(COAST)
        shown.append((round(info["time_s"], 3), environment.render()))
        ended = terminated or truncated
    return shown


def flashes(frame: Any, colour: tuple[int, int, int] = FLASH) -> int:
    """How many pixels have a colour, that of an impact unless another one is given."""
    return int((frame == np.array(colour, np.uint8)).all(axis=2).sum())


@pytest.mark.skipif(version("pillow") != "13.0.0", reason="another Pillow draws letters otherwise")
@pytest.mark.parametrize(
    ("scenario", "learners", "pixels"),
    [
        ("paper-random", ["vehicle_2"], "f11b70d3a510"),
        ("paper-random-obstacle", [], "320fe8dd969a"),
        ("cooperation-4-five", None, "9d8b561a1ad1"),
    ],
)
def test_frames__are_the_same_pixels_as_ever(scenario: str, learners: list[str] | None, pixels: str) -> None:
    environment = eb.parallel_env(scenario, learners=learners, render_mode="rgb_array")
    environment.reset(seed=3)
    told = sha256(environment.render())
    while environment.agents:
        environment.step({f"vehicle_{i + 1}": [-0.4] for i in environment.engine.learners})
        told.update(environment.render())
    assert told.hexdigest()[:12] == pixels


def test_step_frames__show_an_impact_inside_a_step_from_its_moment_on() -> None:
    environment = crash(latency_s=[0, 0.55])
    viewer = environment.unwrapped.viewer
    assert len(viewer.step_frames(50)) == round(0.55 * 50)  # from the alert to the first decision
    for _ in range(5):
        environment.step(COAST)  # to 1.05 s; the impact is at 1 s
    frames = viewer.step_frames(50)
    assert [flashes(frame) > 0 for frame in frames] == [False, False, True, True, True]
    assert np.array_equal(frames[-1], environment.render())


def test_scene__has_the_numbers_of_the_infos_and_the_places_of_the_physics() -> None:
    environment = eb.parallel_env("paper-random")
    trace, engine = Trace(environment.engine, whole=True), environment.engine
    environment.reset(seed=7)
    infos: dict[str, Any] = {}
    while environment.agents:
        infos = environment.step({"vehicle_2": [-0.3]})[4]
    motions = trace.motions(engine)
    shown = [scene for motion in motions for scene in motion.scenes(engine, 0)]
    start = engine.scenario.sample(1, seed=7, channel="training").worlds
    record = eb.record_episode(start, eb.make_agent("coast"), scenario=engine.scenario)
    assert len(shown) == len(motions) == int(engine.steps[0]) + 1
    last, worlds, told = shown[-1], engine.worlds, infos["vehicle_2"]
    assert (last.time_s, last.ended) == (worlds.time_s[0], True)
    harms = [told["world_first_impact_harm"], told["world_total_harm"]]
    assert [last.first_harm, last.total_harm] == near(harms, abs=1e-9)
    assert last.gaps_m == near(worlds.gaps_m[0], abs=1e-9) and last.speeds_mps == near(worlds.speeds_mps[0], abs=1e-9)
    assert shown[0].front_m[0] == near(record.positions_m[record.time_s.searchsorted(0.5), 0])
    assert -np.diff(last.front_m) == near(last.gaps_m + BODY_M)
    for scene in shown:
        assert scene.view.left_m < scene.front_m[-1] - BODY_M and scene.front_m[0] < scene.view.right_m


CRASHED = """\
crash  1.30 s after the alert  (ended)
.....................................................===[2>=====[1>====.............................
vehicle_1            18.05 m/s                      brakes 6.0 m/s2
vehicle_2   learns   18.05 m/s  gap ahead   0.00 m  coasts
harm 36.00 m2/s2 by first impacts, 36.00 in total
"""
AHEAD = """\
paper-random-obstacle  0.50 s after the alert
...............==[3>==.............==[2>==..........==[1>==....................................#....
vehicle_1            18.28 m/s  obstacle   29.56 m  brakes 6.0 m/s2
vehicle_2   learns   20.98 m/s  gap ahead   8.78 m  coasts
vehicle_3            18.25 m/s  gap ahead  11.13 m  acts from 0.80 s
harm 0.00 m2/s2 by first impacts, 0.00 in total
"""


def test_ansi__says_it_in_words() -> None:
    obstacle = eb.parallel_env("paper-random-obstacle", render_mode="ansi")
    obstacle.reset(seed=0)
    assert (to_its_end(crash("ansi"))[-1][1], obstacle.render()) == (CRASHED, AHEAD)


def test_vector__gives_the_frame_of_each_world() -> None:
    batch = gymnasium.make_vec("EthBrake-v1", num_envs=3, scenario="paper-random", render_mode="rgb_array")
    single = gymnasium.make("EthBrake-v1", scenario="paper-random", render_mode="rgb_array")
    batch.reset(seed=5)
    batch.step(np.full((3, 1), -1.0, np.float32))
    frames = batch.render()
    assert len(frames) == 3
    for k in range(3):
        single.reset(seed=5 if k == 0 else None)
        single.step(-1.0 + COAST)
        assert np.array_equal(frames[k], single.render())
