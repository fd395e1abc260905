"""Films of single episodes."""

import io
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image, ImageSequence

import ethbrake_marl as eb
from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.evaluation.record import record_episode
from ethbrake_marl.extensions.report.film import film_bytes, film_scenes
from tests.contract.interfaces import CRASH

SVG = "{http://www.w3.org/2000/svg}"


README = Path(__file__).resolve().parents[3] / "README.md"


COASTING = film_scenes(CRASH.sample(1, seed=0).worlds, make_agent("coast"), scenario=CRASH)


def test_film_scenes__are_those_of_the_recorded_episode(paper_random: eb.Scenario) -> None:
    world, agent = paper_random.sample(1, seed=7).worlds, make_agent("e_v2x_bm")
    record = record_episode(world, agent, scenario=paper_random)
    shown = film_scenes(world, agent, scenario=paper_random)
    for scene in shown[::9]:
        gaps = [np.interp(scene.time_s, record.time_s, record.gaps_m[:, p]) for p in range(2)]
        assert scene.gaps_m == pytest.approx(gaps, abs=0.01)
    assert shown[-1].first_harm == pytest.approx(float(record.ledger.world_harm("first")[0]))


def test_film__a_title_of_any_length_and_kind_stays_left_of_the_clock() -> None:
    frames = [COASTING[0]._replace(title=title).frame() for title in ("", "\u202e\x1b" + "long/name " * 400)]
    differs = (frames[0] != frames[1]).any(axis=2)
    assert differs[:30, :560].any() and not differs[:, 560:].any() and not differs[30:].any()


def test_film__as_mp4_plays_in_real_time(tmp_path: Path) -> None:
    library = pytest.importorskip("imageio_ffmpeg", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    path = tmp_path / "film.mp4"
    path.write_bytes(film_bytes({"a": COASTING}, ".mp4"))
    frames, seconds = library.count_frames_and_secs(str(path))
    assert frames == len(COASTING) and seconds == pytest.approx(len(COASTING) / 25, abs=0.02)


def test_film__as_svg_moves_every_vehicle_as_its_scenes_say() -> None:
    drawn = ElementTree.fromstring(film_bytes({"<b>": COASTING, "c": COASTING[:5]}, ".svg"))
    assert not [each for each in drawn.iter() if each.tag.endswith("script") or "href" in str(each.attrib)]
    left, right = COASTING[0].view
    moved = [each.attrib["values"].split(";") for each in drawn.iter(f"{SVG}animateTransform")]
    vehicles = len(COASTING[0].front_m)
    assert len(moved) == 2 * vehicles
    for i, values in enumerate(moved[:vehicles]):
        places = [800 * (scene.front_m[i] - left) / (right - left) for scene in COASTING]
        held = [float(value.split()[0]) for value in values]
        assert held == pytest.approx(places + places[-1:] * (len(held) - len(places)), abs=0.051)
    told = {each.text for each in drawn.iter(f"{SVG}text")}
    assert told >= {"<b>", "harm 36.0 by first impacts, 36.0 in total", "Vehicles 1 and 2: 6.0 m/s"}


def test_film__of_the_readme_is_that_of_its_command(tmp_path: Path) -> None:
    made = tmp_path / "made.svg"
    text = " ".join(README.read_text("utf-8").split())
    command = re.search(r"`ethbrake (watch .*?) --output emergency.svg`", text)[1]
    assert run_command([*command.split(), "--output", str(made)]) == 0
    texts = [file.read_text("utf-8") for file in (made, README.parent / "docs" / "figures" / "emergency.svg")]
    number = re.compile(r"-?\d+\.\d+")
    assert number.split(texts[0]) == number.split(texts[1])
    now, then = (np.array(number.findall(text), float) for text in texts)
    assert now == pytest.approx(then, abs=0.21)


def test_film__is_evenly_spaced_and_plays_in_real_time() -> None:
    # See CRASH: an impact of 6 m/s at 1 s. A GIF ends with the longest.
    scenes = film_scenes(CRASH.sample(1, seed=0).worlds, make_agent("coast"), scenario=CRASH)
    assert [round(scene.time_s, 9) for scene in scenes] == [*(k / 25 for k in range(33)), 1.3]
    assert [scene.ended for scene in scenes].index(True) == 33
    assert len(scenes) == 34
    assert next(round(s.time_s, 9) for s in scenes if s.total_harm > 0) == 1.0
    assert round(scenes[-1].total_harm, 9) == 36.0
    shown = Image.open(io.BytesIO(film_bytes({"a": scenes[:14], "b": scenes[:3]}, ".gif", fps=10)))
    assert shown.n_frames == 14
    assert shown.size == (800, 608)
    assert {frame.info["duration"] for frame in ImageSequence.Iterator(shown)} == {100}


def test_film_scenes__follow_scripts_that_decide_within_a_step(swinging: eb.Scenario) -> None:
    worlds, agent = swinging.sample(4, 7).worlds, make_agent("constant:3")
    for k in range(4):
        record = record_episode(worlds.take([k]), agent, scenario=swinging)
        scene = film_scenes(worlds.take([k]), agent, scenario=swinging)[-1]
        assert scene.total_harm == pytest.approx((record.impacts.closing_speed_mps**2).sum())
        assert scene.front_m[0] == pytest.approx(record.positions_m[-1, 0], abs=1e-6)
