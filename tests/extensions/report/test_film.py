"""Films of single episodes."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.report.film import film, film_scenes
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.evaluation.record import record_episode
from tests.first_edition.contract.interfaces import CRASH

DOCS = Path(__file__).resolve().parents[3] / "docs"


WORLD = CRASH.sample(1, seed=0).worlds


COASTING = film_scenes(WORLD, make_agent("coast"), scenario=CRASH)


def test_film_scenes__are_those_of_the_recorded_episode(paper_random: eb.Scenario) -> None:
    world, agent = paper_random.sample(1, seed=7).worlds, make_agent("e_v2x_bm")
    record = record_episode(world, agent, scenario=paper_random)
    shown = film_scenes(world, agent, scenario=paper_random)
    for scene in shown[::9]:
        gaps = [np.interp(scene.time_s, record.time_s, record.gaps_m[:, p]) for p in range(2)]
        assert scene.gaps_m == pytest.approx(gaps, abs=0.01)
    assert shown[-1].first_harm == pytest.approx(float(record.ledger.world_harm("first")[0]))


def test_film__as_mp4_plays_in_real_time(tmp_path: Path) -> None:
    library = pytest.importorskip("imageio_ffmpeg", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    path = tmp_path / "film.mp4"
    path.write_bytes(film(WORLD, {"a": make_agent("coast")}, ".mp4", scenario=CRASH))
    frames, seconds = library.count_frames_and_secs(str(path))
    assert frames == len(COASTING) and seconds == pytest.approx(len(COASTING) / 25, abs=0.02)


def test_film__is_evenly_spaced_and_plays_in_real_time() -> None:
    # See CRASH: an impact of 6 m/s at 1 s. A GIF ends with the longest.
    assert [round(scene.time_s, 9) for scene in COASTING] == [*(k / 25 for k in range(33)), 1.3]
    assert [scene.ended for scene in COASTING].index(True) == 33
    assert next(round(s.time_s, 9) for s in COASTING if s.total_harm > 0) == 1.0
    assert round(COASTING[-1].total_harm, 9) == 36.0
    agents = {"a": make_agent("coast"), "b": make_agent("full_brake")}
    shown = Image.open(io.BytesIO(film(WORLD, agents, ".gif", scenario=CRASH)))
    assert (shown.n_frames, shown.size) == (34, (800, 608))
    assert {frame.info["duration"] for frame in ImageSequence.Iterator(shown)} == {40}


def test_film__of_the_readme_is_that_of_its_command(paper_random: eb.Scenario) -> None:
    named = {f"{name}: world 0 of paper-random": make_agent(name) for name in ("full_brake", "universal")}
    made = film(paper_random.sample(1, 7).worlds, named, ".png", scenario=paper_random)
    now, then = (Image.open(file).convert("RGB") for file in (io.BytesIO(made), DOCS / "figures" / "emergency.png"))
    assert now.size == then.size
    assert (np.abs(np.array(now, int) - np.array(then, int)).max(axis=2) > 8).mean() < 1e-3


def test_film_scenes__follow_scripts_that_decide_within_a_step(swinging: eb.Scenario) -> None:
    worlds, agent = swinging.sample(4, 7).worlds, make_agent("constant:3")
    for k in range(4):
        record = record_episode(worlds.take([k]), agent, scenario=swinging)
        scene = film_scenes(worlds.take([k]), agent, scenario=swinging)[-1]
        assert scene.total_harm == pytest.approx((record.impacts.closing_speed_mps**2).sum())
        assert scene.front_m[0] == pytest.approx(record.positions_m[-1, 0], abs=1e-6)
