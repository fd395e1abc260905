"""What the environments draw: pictures, words and a window of their running worlds."""

import copy
import sys
import warnings
from hashlib import sha256
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import render_test

from ethbrake_marl.errors import InvalidInput, MissingExtra
from ethbrake_marl.extensions.rendering.scene import BODY_M
from ethbrake_marl.faces.gymnasium import EthBrakeEnv
from ethbrake_marl.faces.pettingzoo import EthBrakeParallelEnv, raw_env
from ethbrake_marl.faces.sb3 import make_sb3_vec_env
from ethbrake_marl.faces.vector import EthBrakeVectorEnv
from ethbrake_marl.motion.layout import GAP
from ethbrake_marl.worlds.scenario import Scenario
from tests.refused import refused

FLASH = (255, 214, 10)
CRASH = Scenario(  # Vehicle 2 coasts into Vehicle 1 after 1 s: 14 and 20 m/s become 17 m/s, then both brake at 3 m/s2
    name="crash", vehicles=2, gaps_m=3.0, speeds_mps=20.0, mass_t=2.0, braking_capacity_mps2=6.0,
    driving_capacity_mps2=5.0, latency_s=0.0, restitution=0.0, roles={"vehicle_2": "learner"}, horizon_s=1.3,
)  # fmt: skip


def coasting(mode: str, steps: int = 0, **changes: Any) -> Any:
    environment = EthBrakeEnv(CRASH.replace(**changes), render_mode=mode)
    environment.reset(seed=0)
    for _ in range(steps):
        environment.step(np.zeros(1, np.float32))
    return environment


def scene_of(renderer: Any, row: int) -> Any:
    motion = renderer.motion(row)
    return motion.scene(motion.until_s)


def flashes(frame: Any) -> bool:
    return bool((frame == np.array(FLASH, np.uint8)).all(axis=2).any())


CRASHED = """\
crash  1.30 s after the alert (ended)
....................................................===[2>=====[1>====..............................
vehicle_1            16.10 m/s                      brakes 6.0 m/s2
vehicle_2   learns   16.10 m/s  gap ahead   0.00 m  coasts
harm 36.00 by first impacts, 36.00 in total (m2/s2)
"""


def test_ansi__says_it_in_words() -> None:
    assert coasting("ansi", 13).render() == CRASHED
    assert coasting("ansi", 11).render().splitlines()[-1] == "impact of Vehicles 1 and 2 at 6.0 m/s, 1.00 s"


def test_ansi__shows_the_obstacle_and_who_cannot_act_yet() -> None:
    environment = EthBrakeParallelEnv("paper-random-obstacle", render_mode="ansi")
    environment.reset(seed=0)
    shown = environment.render().splitlines()
    assert shown[1].count("#") == 1
    assert "gap ahead  29.56 m" in shown[2]
    assert shown[4].endswith("acts from 0.80 s")


@pytest.mark.skipif(version("pillow") != "13.0.0", reason="another Pillow draws letters otherwise")
@pytest.mark.parametrize(
    ("scenario", "pixels"), [("paper-random-obstacle", "ef6c11e4f3b1"), ("cooperation-4-five", "b9c7b2e52fc9")]
)
def test_pictures__have_the_same_pixels_as_ever(scenario: str, pixels: str) -> None:
    environment = EthBrakeParallelEnv(scenario, render_mode="rgb_array")
    environment.reset(seed=3)
    digest = sha256(environment.render())
    while environment.agents:
        environment.step({f"vehicle_{body}": [-0.4] for body in environment.game.settings.learners})
        digest.update(environment.render())
    assert digest.hexdigest()[:12] == pixels


def test_step_frames__show_an_impact_inside_a_step_from_its_moment_on() -> None:
    environment = coasting("rgb_array", 5, latency_s=[0.0, 0.55])  # to 1.05 s; the impact is at 1 s
    frames = environment.renderer.step_frames(50)
    assert [flashes(frame) for frame in frames] == [False, False, True, True, True]
    assert np.array_equal(frames[-1], environment.render())
    assert not flashes(coasting("rgb_array", 13).render())  # 0.3 s later


@pytest.mark.parametrize("scenario", ["paper-random-obstacle"])
def test_scene__has_the_places_of_the_physics(scenario: str) -> None:
    environment = EthBrakeParallelEnv(scenario, render_mode="rgb_array")
    environment.reset(seed=7)
    start, way = environment.episode, 0.0
    while environment.agents:
        before = environment.episode
        environment.step({"vehicle_2": [-0.3]})
        after, scene = environment.episode, scene_of(environment.renderer, 0)
        assert np.array_equal(scene.line, after.line[0])
        way += 0.1 * float(before.speeds_mps[0, 0] + after.speeds_mps[0, 0]) / 2.0
        assert scene.front_m == pytest.approx(way, abs=0.6)  # the speed jumps at impacts
        assert -np.diff(scene.fronts_m) == pytest.approx(after.gaps_m[0] + BODY_M)
        assert scene.shown_m[0] < scene.fronts_m[-1] - BODY_M
        assert scene.shown_m[1] > scene.fronts_m[0]
        if scene.has_obstacle:
            assert scene.obstacle_m == pytest.approx(start.line[0, GAP, 0])


def test_many_worlds__have_the_picture_of_each() -> None:
    single = EthBrakeEnv(render_mode="rgb_array")
    many = EthBrakeVectorEnv(3, render_mode="rgb_array")
    many.reset(seed=5)
    rows = make_sb3_vec_env("paper-random", 3, seed=5, render_mode="rgb_array")
    rows.reset()
    for _ in range(12):
        many.step(np.full((3, 1), 0.5))
        rows.step(np.full((3, 1), 0.5))
    for k in range(3):
        single.reset(seed=5 if k == 0 else None)
        for _ in range(12):
            single.step(np.full(1, 0.5))
        assert np.array_equal(many.render()[k], single.render())
        assert np.array_equal(rows.get_images()[k], single.render())


def test_many_worlds__begin_anew_row_by_row() -> None:
    many = EthBrakeVectorEnv(4, render_mode="ansi", autoreset_mode="SameStep")
    many.reset(seed=5)
    begun = False
    for _ in range(120):
        many.step(np.full((4, 1), -0.6))
        for row, shown in enumerate(many.render()):
            scene = scene_of(many.renderer, row)
            assert np.array_equal(scene.line, many.episode.line[row])
            assert shown.startswith(f"paper-random  {many.episode.time_s[row]:.2f} s")
            begun |= scene.front_m == 0.0
    assert begun


def test_human__shows_each_step_in_real_time(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame = pytest.importorskip("pygame", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    environment, other = (EthBrakeEnv(CRASH, render_mode="human") for _ in range(2))
    assert environment.renderer.window is None  # before there is something to show
    environment.reset(seed=0)
    other.reset(seed=0)
    before = pygame.time.get_ticks()
    environment.step(np.zeros(1, np.float32))
    assert pygame.time.get_ticks() - before >= 80  # a step of 0.1 s
    assert environment.render() is None
    assert environment.renderer.window.window.size == (800, 304)
    copy.deepcopy(environment).close()
    pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=other.renderer.window.window))
    for _ in range(2):
        environment.step(np.zeros(1, np.float32))
        other.step(np.zeros(1, np.float32))
    assert other.renderer.window is None  # its user has closed it
    assert environment.renderer.window is not None
    other.reset(seed=0)
    environment.close()
    other.step(np.zeros(1, np.float32))
    assert other.renderer.window is not None
    other.close()
    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "nothing")
    with pytest.raises(InvalidInput, match=r"cannot open a window .*; render_mode = 'rgb_array' and film files"):
        EthBrakeParallelEnv(render_mode="human").reset(seed=0)
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(MissingExtra, match=r"pip install 'ethbrake-marl\[render\]'"):
        EthBrakeParallelEnv(render_mode="human").reset(seed=0)


@pytest.fixture(params=["no pygame", "the package pygame", "no display", "pygame-ce"])
def modes(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Put the module of a package in place of pygame; return the render modes that then work."""
    if request.param == "no pygame":
        monkeypatch.setitem(sys.modules, "pygame", None)
    elif request.param == "the package pygame":
        monkeypatch.delattr(pytest.importorskip("pygame"), "Window")
    elif request.param == "no display":
        pytest.importorskip("pygame")
        for name in ("SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
            monkeypatch.delenv(name, raising=False)
    else:
        pytest.importorskip("pygame")
        monkeypatch.setattr("ethbrake_marl.extensions.rendering.viewer.SMOOTH_FPS", 1000)  # no waiting
        return ["ansi", "human", "rgb_array"]
    return ["ansi", "rgb_array"]


def test_render_modes__are_those_that_work_here_and_the_checkers_of_libraries_pass(modes: list[str]) -> None:
    made = gymnasium.make("EthBrake-v3")
    assert sorted(made.metadata["render_modes"]) == modes
    assert sorted(EthBrakeVectorEnv(2).metadata["render_modes"]) == ["ansi", "rgb_array"]  # not human
    assert sorted(EthBrakeParallelEnv.metadata["render_modes"]) == sorted(raw_env().metadata["render_modes"]) == modes
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*not within.*")
        check_env(made.unwrapped)
    render_test(raw_env)


def test_display__is_started_only_for_human(monkeypatch: pytest.MonkeyPatch) -> None:
    pygame, started = pytest.importorskip("pygame"), list[str]()
    start = pygame.display.init
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(pygame.display, "init", lambda: started.append("display") or start())
    many = [gymnasium.make_vec("EthBrake-v3", 2), EthBrakeVectorEnv(2), make_sb3_vec_env("paper-random", 2)]
    for mode in (None, "rgb_array", "ansi"):
        for env in (gymnasium.make("EthBrake-v3", render_mode=mode), EthBrakeEnv(render_mode=mode), raw_env()):
            env.reset(seed=7)
            assert "ansi" in env.metadata["render_modes"] and str(env) and not started
    assert all(str(env) for env in many) and not started
    human = EthBrakeEnv(render_mode="human")
    assert not started  # before there is something to show
    human.reset(seed=7)
    assert started
    human.close()


def test_human__with_the_module_of_another_package_names_both_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(pytest.importorskip("pygame"), "Window")
    for environment in (EthBrakeEnv(render_mode="human"), raw_env(render_mode="human")):
        with refused("has no Window: the package pygame has none, the package pygame-ce has one"):
            environment.reset(seed=0)
        environment.close()
    with pytest.warns(UserWarning, match="HumanRendering wrapper"):
        shown = gymnasium.make("EthBrake-v3", render_mode="human")
    shown.reset(seed=0)
    assert shown.step(np.zeros(1, np.float32))[1] == 0.0 and shown.render() is None
    shown.close()


def test_refusals() -> None:
    with refused("render_mode = 'film': must be None or one of: ansi, human, rgb_array"):
        EthBrakeEnv(render_mode="film")
    with refused("render_mode = 'human': must be 'rgb_array' or 'ansi' for many worlds"):
        EthBrakeVectorEnv(2, render_mode="human")
    with refused("render: no episode has started; call reset first"):
        EthBrakeEnv(render_mode="ansi").render()
    with refused("step_frames: fps"):
        coasting("rgb_array").renderer.step_frames(0)
    assert EthBrakeEnv().render() is None
