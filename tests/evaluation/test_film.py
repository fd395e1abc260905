from __future__ import annotations

import io
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput, MissingExtra
from ethbrake_marl.evaluation import episodes
from ethbrake_marl.evaluation.episodes import film_bytes, film_scenes
from tests.contract.interfaces import CRASH

SVG = "{http://www.w3.org/2000/svg}"
README = Path(__file__).resolve().parents[2] / "README.md"
WORLD = CRASH.sample(1, seed=0).worlds


def test_film_scenes__are_evenly_spaced_from_the_alert_to_the_end() -> None:
    shown = film_scenes(WORLD, eb.make_agent("coast"), scenario=CRASH, fps=25)
    times = [scene.time_s for scene in shown]
    assert times == pytest.approx([*(np.arange(33) / 25), 1.3])
    assert [scene.ended for scene in shown] == [False] * (len(shown) - 1) + [True]
    hit = [scene.time_s for scene in shown if scene.total_harm > 0.0]
    assert hit[0] == pytest.approx(1.0, abs=0.0401) and shown[-1].total_harm == pytest.approx(36.0)


def test_film_scenes__are_those_of_the_recorded_episode() -> None:
    scenario = eb.load_scenario("paper-random")
    world = scenario.sample(1, seed=7).worlds
    record = eb.record_episode(world, eb.make_agent("e_v2x_bm"), scenario=scenario)
    shown = film_scenes(world, eb.make_agent("e_v2x_bm"), scenario=scenario)
    for scene in shown[::9]:
        gaps = [np.interp(scene.time_s, record.time_s, record.gaps_m[:, p]) for p in range(2)]
        assert scene.gaps_m == pytest.approx(gaps, abs=0.01)
    assert shown[-1].first_harm == pytest.approx(float(record.ledger.world_harm("first")[0]))


def test_film__as_gif_plays_in_real_time_and_ends_with_the_longest() -> None:
    short = film_scenes(WORLD, eb.make_agent("coast"), scenario=CRASH, fps=10)
    shown = Image.open(io.BytesIO(film_bytes({"a": short, "b": short[:3]}, ".gif", fps=10)))
    assert (shown.n_frames, shown.size) == (len(short), (800, 608))
    durations = []
    for k in range(shown.n_frames):
        shown.seek(k)
        durations.append(shown.info["duration"])
    assert durations == [100] * len(short)
    with pytest.raises(InvalidInput, match="fps = 30: must divide 100"):
        film_bytes({"a": short}, ".gif", fps=30)
    with pytest.raises(InvalidInput, match="no films given"):
        film_bytes({}, ".gif")


def test_film__a_title_of_any_length_and_kind_stays_left_of_the_clock() -> None:
    shown = film_scenes(WORLD, eb.make_agent("coast"), scenario=CRASH)[:1]
    frames = [shown[0]._replace(title=title).frame() for title in ("", "\u202e\x1b" + "long/name " * 400)]
    differs = (frames[0] != frames[1]).any(axis=2)
    assert differs[:30, :560].any() and not differs[:, 560:].any() and not differs[30:].any()


def test_film__as_mp4_plays_in_real_time(tmp_path: Path) -> None:
    library = pytest.importorskip("imageio_ffmpeg", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    shown = film_scenes(WORLD, eb.make_agent("coast"), scenario=CRASH)
    path = tmp_path / "film.mp4"
    path.write_bytes(film_bytes({"a": shown}, ".mp4"))
    frames, seconds = library.count_frames_and_secs(str(path))
    assert frames == len(shown) and seconds == pytest.approx(len(shown) / 25, abs=0.02)


def test_film__as_mp4_without_its_library_says_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(MissingExtra, match=r"pip install 'ethbrake-marl\[render\]'"):
        episodes.check_film(".mp4")


def test_film__as_svg_moves_every_vehicle_as_its_scenes_say() -> None:
    shown = film_scenes(WORLD, eb.make_agent("coast"), scenario=CRASH)
    drawn = ElementTree.fromstring(film_bytes({"<b>": shown, "c": shown[:5]}, ".svg"))
    assert not [each for each in drawn.iter() if each.tag.endswith("script") or "href" in str(each.attrib)]
    left, right = shown[0].view
    moved = [each.attrib["values"].split(";") for each in drawn.iter(f"{SVG}animateTransform")]
    assert len(moved) == 2 * len(shown[0].front_m)
    for i, values in enumerate(moved[: len(shown[0].front_m)]):
        places = [800 * (scene.front_m[i] - left) / (right - left) for scene in shown]
        held = [float(value.split()[0]) for value in values]
        assert held == pytest.approx(places + places[-1:] * (len(held) - len(places)), abs=0.051)
    told = [each.text for each in drawn.iter(f"{SVG}text")]
    assert "<b>" in told and "harm 36.0 by first impacts, 36.0 in total" in told
    assert "Vehicles 1 and 2: 6.0 m/s" in told


def test_film__of_the_readme_is_that_of_its_command(tmp_path: Path) -> None:
    made = tmp_path / "made.svg"
    text = " ".join(README.read_text("utf-8").split())
    command = re.search(r"`ethbrake (watch record .*?) --output docs/figures/emergency.svg`", text)
    assert command is not None
    assert run_command([*command[1].split(), "--output", str(made)]) == 0
    kept = (README.parent / "docs" / "figures" / "emergency.svg").read_text("utf-8")
    number = re.compile(r"-?\d+\.\d+")
    assert number.split(made.read_text("utf-8")) == number.split(kept)
    now, then = (np.array(number.findall(text), float) for text in (made.read_text("utf-8"), kept))
    assert now == pytest.approx(then, abs=0.21)


def test_record_command__writes_the_film_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "film.gif"
    arguments = ["watch", "record", "--agents", "full_brake", "--world", "2", "--output", str(path)]
    assert run_command(arguments) == 0
    assert path.read_bytes()[:6] == b"GIF89a"
    assert run_command(arguments) == 2
    assert run_command(["watch", "record", "--output", str(tmp_path / "film.avi")]) == 2
    assert "films are written as .gif, .mp4, .svg" in capsys.readouterr().err


def test_film__has_a_limit_of_agents_and_of_pictures(monkeypatch):
    scene = film_scenes(WORLD, eb.make_agent("coast"), scenario=CRASH)[:1]
    with pytest.raises(InvalidInput, match="film: 13 agents, one below the other; at most 12 are shown"):
        film_bytes({str(k): scene for k in range(13)}, ".gif")
    with pytest.raises(InvalidInput, match=r"film of 2 agents for 200 s: needs 10,000 pictures, .* shorter horizon_s"):
        film_bytes({str(k): scene * 5000 for k in range(2)}, ".gif")
