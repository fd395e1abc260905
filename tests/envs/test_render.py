from __future__ import annotations

import copy
import pickle
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, render_test

import ethbrake_marl as eb
from ethbrake_marl.envs.drawing import BODY_M, HEIGHT, WIDTH, Trace, View, follow
from ethbrake_marl.envs.interfaces import env, parallel_env
from ethbrake_marl.errors import InvalidInput, MissingExtra
from tests.envs.lines import CRASH, REST

ROOT = Path(__file__).resolve().parents[2]
MODES = ["human", "rgb_array", "rgb_array_list", "ansi"]
SHAPE = (HEIGHT, WIDTH, 3)
FLASH = (255, 214, 10)


@pytest.fixture(autouse=True)
def _no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def crash(mode: str | None = "rgb_array", **settings: Any) -> Any:
    environment = gymnasium.make("EthBrake-v0", scenario=CRASH, render_mode=mode, **settings)
    environment.reset(seed=0)
    return environment


def flashes(frame: Any) -> int:
    """How many pixels have the colour of an impact."""
    return int((frame == np.array(FLASH, np.uint8)).all(axis=2).sum())


def test_frame__is_a_picture_of_bytes_in_its_own_memory() -> None:
    environment = crash()
    frame, again = environment.render(), environment.render()
    assert (frame.shape, frame.dtype) == (SHAPE, np.uint8)
    assert np.array_equal(frame, again)
    frame[:] = 0
    assert np.array_equal(environment.render(), again)


def test_frames__of_different_states_differ_and_of_equal_ones_do_not() -> None:
    shown = []
    for _ in range(2):
        environment = crash()
        frames = [environment.render()]
        for _ in range(3):
            environment.step(np.array([-1.0], np.float32))
            frames.append(environment.render())
        shown.append(np.array(frames))
    assert np.array_equal(*shown)
    assert all((shown[0][k] != shown[0][k + 1]).any() for k in range(3))


def test_impact__is_shown_where_it_happens_and_then_fades() -> None:
    environment = crash()  # coasting, Vehicle 2 hits Vehicle 1 at 1 s with 6 m/s
    seen: dict[float, int] = {}
    ended = False
    while not ended:
        *_, terminated, truncated, info = environment.step(np.array([0.0], np.float32))
        seen[round(info["time_s"], 3)] = flashes(environment.render())
        ended = terminated or truncated
    assert all(count == 0 for time, count in seen.items() if time < 1.0 - 1e-9)
    assert seen[min(time for time in seen if time >= 1.0 - 1e-9)] > 50


def test_step_frames__show_an_impact_inside_a_step_from_its_moment_on() -> None:
    scenario = CRASH.replace(latency_s=[0, 0.55])
    environment = gymnasium.make("EthBrake-v0", scenario=scenario, render_mode="rgb_array")
    environment.reset(seed=0)
    viewer = environment.unwrapped.viewer
    assert len(viewer.step_frames(50)) == round(0.55 * 50)  # from the alert to the first decision
    for _ in range(5):
        environment.step(np.array([0.0], np.float32))  # to 1.05 s; the impact is at 1 s
    frames = viewer.step_frames(50)
    assert [flashes(frame) > 0 for frame in frames] == [False, False, True, True, True]
    assert np.array_equal(frames[-1], environment.render())
    with pytest.raises(InvalidInput, match="fps = 0"):
        viewer.step_frames(0)


def test_scene__has_the_numbers_of_the_infos_and_the_places_of_the_physics() -> None:
    environment = parallel_env("paper-random")
    trace = Trace(environment.engine, whole=True)
    environment.reset(seed=7)
    infos: dict[str, Any] = {}
    while environment.agents:
        infos = environment.step({"vehicle_2": [-0.3]})[4]
    motions = trace.motions(environment.engine)
    shown = [scene for motion in motions for scene in motion.scenes(environment.engine, 0)]
    record = eb.record_episode(
        environment.engine.scenario.sample(1, seed=7, channel="training").worlds,
        eb.make_agent("coast"), scenario=environment.engine.scenario,
    )  # fmt: skip
    assert len(shown) == len(motions) == int(environment.engine.steps[0]) + 1
    last, worlds = shown[-1], environment.engine.worlds
    assert (last.time_s, last.ended) == (worlds.time_s[0], True)
    assert last.first_harm == pytest.approx(infos["vehicle_2"]["world_first_impact_harm"], abs=1e-9)
    assert last.total_harm == pytest.approx(infos["vehicle_2"]["world_total_harm"], abs=1e-9)
    assert last.gaps_m == pytest.approx(worlds.gaps_m[0], abs=1e-9)
    assert last.speeds_mps == pytest.approx(worlds.speeds_mps[0], abs=1e-9)
    assert shown[0].front_m[0] == pytest.approx(record.positions_m[record.time_s.searchsorted(0.5), 0])
    assert -np.diff(last.front_m) == pytest.approx(last.gaps_m + BODY_M)
    for scene in shown:
        assert scene.view.left_m < scene.front_m[-1] - BODY_M and scene.front_m[0] < scene.view.right_m


def test_view__stands_still_until_the_line_would_leave_it() -> None:
    view = View(-30.0, 50.0)
    assert follow(view, np.array([44.0, -20.0])) == view
    assert follow(view, np.array([55.0, 0.0])) == View(-20.0, 60.0)
    assert follow(view, np.array([55.0, -25.0])) == View(-32.5, 60.0)
    assert follow(view, np.array([0.0, -40.0])) == View(-47.5, 50.0)


def test_list__has_the_beginning_and_each_step_once() -> None:
    for environment in (crash("rgb_array_list"), eb.EthBrakeEnv(CRASH, render_mode="rgb_array_list")):
        environment.reset(seed=0)
        for _ in range(3):
            environment.step(np.array([0.0], np.float32))
        frames = environment.render()
        assert len(frames) == 4 and all(frame.shape == SHAPE for frame in frames)
        assert environment.render() == []
        environment.step(np.array([0.0], np.float32))
        assert len(environment.render()) == 1
        environment.reset(seed=0)
        (first,) = environment.render()
        assert np.array_equal(first, frames[0])


def test_ansi__says_it_in_words() -> None:
    environment = gymnasium.make("EthBrake-v0", scenario=CRASH, render_mode="ansi")
    environment.reset(seed=0)
    assert "0.50 s after the alert" in environment.render()
    ended = False
    while not ended:
        *_, terminated, truncated, _ = environment.step(np.array([0.0], np.float32))
        ended = terminated or truncated
    text = environment.render()
    lines = text.splitlines()
    assert lines[0] == "crash  1.30 s after the alert  (ended)"
    assert "[1>" in lines[1] and "[2>" in lines[1] and lines[1].index("2") < lines[1].index("1")
    assert lines[2].startswith("vehicle_1") and lines[2].endswith("brakes 6.0 m/s2")
    assert lines[3].startswith("vehicle_2   learns") and "gap ahead" in lines[3] and lines[3].endswith("coasts")
    assert lines[4] == "harm 36.00 m2/s2 by first impacts, 36.00 in total"
    assert all(character.isprintable() or character == "\n" for character in text)


def test_obstacle__is_in_the_picture_and_in_the_text() -> None:
    environment = parallel_env("paper-random-obstacle", render_mode="ansi")
    environment.reset(seed=0)
    assert "#" in environment.render() and "obstacle" in environment.render()


def test_vector__gives_one_frame_for_each_world() -> None:
    batch = gymnasium.make_vec("EthBrake-v0", num_envs=3, scenario="paper-random", render_mode="rgb_array")
    batch.reset(seed=5)
    batch.step(np.full((3, 1), -1.0, np.float32))
    frames = batch.render()
    assert len(frames) == 3 and all(frame.shape == SHAPE for frame in frames)
    single = gymnasium.make("EthBrake-v0", scenario="paper-random", render_mode="rgb_array")
    for k in range(3):
        single.reset(seed=5 if k == 0 else None)
        single.step(np.array([-1.0], np.float32))
        assert np.array_equal(frames[k], single.render())


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_vector__goes_on_through_automatic_resets(mode: str) -> None:
    batch = eb.EthBrakeVectorEnv(3, REST.replace(gaps_m={"uniform": [1, 50]}), render_mode="ansi", autoreset_mode=mode)
    batch.reset(seed=0)
    ends = 0
    for _ in range(30):
        *_, terminated, _truncated, infos = batch.step(np.full((3, 1), -1.0, np.float32))
        texts = batch.render()
        ends += int(terminated.sum())
        for k, time in enumerate(infos["time_s"]):
            assert f"  {time:.2f} s after the alert" in texts[k]
    assert ends > 3


@pytest.mark.parametrize("make", [parallel_env, eb.EthBrakeEnv, eb.EthBrakeVectorEnv, env])
def test_mode__unknown_is_one_clear_error(make: Any) -> None:
    with pytest.raises(InvalidInput, match=r"^render_mode = 'depth': must be .*'rgb_array'.* or None$"):
        make(render_mode="depth")


def test_render__without_a_mode_or_an_episode_is_one_clear_error() -> None:
    with pytest.raises(InvalidInput, match="made with render_mode=None"):
        parallel_env().render()
    with pytest.raises(InvalidInput, match="call reset first"):
        parallel_env(render_mode="rgb_array").render()


def test_human__without_its_library_says_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(MissingExtra, match=r"pip install 'ethbrake-marl\[render\]'") as raised:
        parallel_env(render_mode="human")
    assert "\n" not in str(raised.value)


def test_human__shows_each_step_in_real_time() -> None:
    pygame = pytest.importorskip("pygame", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    environment = gymnasium.make("EthBrake-v0", scenario=CRASH, render_mode="human")
    assert pygame.display.get_surface() is None  # no window before there is something to show
    environment.reset(seed=0)
    before = pygame.time.get_ticks()
    environment.step(np.array([0.0], np.float32))
    assert pygame.time.get_ticks() - before >= 80  # a step of 0.1 s
    assert pygame.display.get_surface().get_size() == (WIDTH, HEIGHT)
    assert environment.render() is None
    environment.close()
    assert pygame.display.get_surface() is None


def test_human__without_a_display_says_what_needs_none(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pygame", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    monkeypatch.setenv("SDL_VIDEODRIVER", "nothing")
    with pytest.raises(InvalidInput, match=r"no window can be opened here .*; 'rgb_array' needs no display"):
        parallel_env(render_mode="human").reset(seed=0)


@pytest.mark.filterwarnings("ignore:.*:UserWarning")
def test_checkers__pass_with_every_mode() -> None:
    pytest.importorskip("pygame", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    check_env(gymnasium.make("EthBrake-v0", scenario=REST).unwrapped)
    render_test(lambda render_mode: env(scenario=REST, render_mode=render_mode))
    for mode in MODES[1:]:
        parallel_api_test(parallel_env(REST, render_mode=mode), num_cycles=20)
        api_test(env(scenario=REST, render_mode=mode), num_cycles=20)


def test_metadata__plays_in_real_time() -> None:
    assert eb.EthBrakeEnv.metadata["render_modes"] == MODES
    for environment in (eb.EthBrakeEnv(CRASH.replace(time_step_s=0.05)), parallel_env(CRASH.replace(time_step_s=0.05))):
        assert environment.metadata["render_modes"] == MODES
        assert environment.metadata["render_fps"] == 20
    assert eb.EthBrakeVectorEnv(2).metadata["render_modes"] == ["rgb_array", "ansi"]
    assert env(scenario=CRASH).metadata["render_fps"] == 10


def test_stable_baselines3__makes_it_by_its_id() -> None:
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env

    rows = make_vec_env("EthBrake-v0", n_envs=2)
    assert rows.reset().shape[0] == 2
    model = PPO("MlpPolicy", "EthBrake-v0", n_steps=16, batch_size=16, n_epochs=1, device="cpu").learn(16)
    assert model.get_env().render(mode="rgb_array").shape == SHAPE


@pytest.mark.skipif(find_spec("moviepy") is None, reason="moviepy is not installed; RecordVideo needs it")
def test_record_video__writes_a_film_of_the_episode(tmp_path: Path) -> None:
    environment = gymnasium.wrappers.RecordVideo(crash(), str(tmp_path / "films"), episode_trigger=lambda _: True)
    environment.reset(seed=0)
    ended = False
    while not ended:
        *_, terminated, truncated, _ = environment.step(np.array([0.0], np.float32))
        ended = terminated or truncated
    environment.close()
    (path,) = (tmp_path / "films").glob("*.mp4")
    frames, seconds = import_module("imageio_ffmpeg").count_frames_and_secs(str(path))
    assert frames == 9 and seconds == pytest.approx(0.9, abs=0.02)  # from 0.5 s to 1.3 s, one frame per step of 0.1 s


def test_shields__are_looked_through_and_their_interventions_shown() -> None:
    scenario = eb.load_scenario("paper-random")
    single = eb.ShieldedEnv(eb.EthBrakeEnv(scenario, render_mode="ansi"))
    parallel = eb.HybridShield(parallel_env(scenario, render_mode="ansi"), mode="step")
    single.reset(seed=7), parallel.reset(seed=7)
    assert "shield" not in single.render()
    for environment, action in ((single, [1.0]), (parallel, {"vehicle_2": [1.0]})):
        environment.step(action)
        assert environment.render().splitlines()[-1] == "shield: stepped in"
    rows = eb.ShieldedVectorEnv(eb.EthBrakeVectorEnv(2, scenario, render_mode="ansi"))
    rows.reset(seed=7)
    rows.step(np.full((2, 1), 1.0))
    assert rows.render()[0] == single.render()
    hybrid = eb.HybridShield(parallel_env(scenario, render_mode="ansi"), eb.make_agent("coast"))
    hybrid.reset(seed=7)
    hybrid.step({})
    assert "shield: stepped in" in hybrid.render()


def test_copies__go_on_drawing_the_same() -> None:
    environment = parallel_env(CRASH, render_mode="rgb_array")
    environment.reset(seed=0)
    environment.step({"vehicle_2": [0.0]})
    for twin in (copy.deepcopy(environment), pickle.loads(pickle.dumps(environment))):
        assert np.array_equal(twin.render(), environment.render())
        twin.step({"vehicle_2": [1.0]})
        assert not np.array_equal(twin.render(), environment.render())
