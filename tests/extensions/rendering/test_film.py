"""Films of single episodes, and the command that writes them."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

import ethbrake_marl as eb
from ethbrake_marl.extensions.rendering.film import film, film_scenes
from ethbrake_marl.names import teams_of
from tests.fixtures.commands import Command, Refuse, check_refused

DOCS = Path(__file__).resolve().parents[3] / "docs"
# Vehicle 2, 6 m/s faster, strikes Vehicle 1 after 0.95 s: harm 36. The horizon is 1.3 s.
CRASH = eb.load_scenario("paper-random").replace(
    name="crash", gaps_m=[5.7, 100.0], speeds_mps=[10.0, 16.0, 16.0], horizon_s=1.3, restitution=0.0,
    roles={"vehicle_1": "coast", "vehicle_2": "learner"},
)  # fmt: skip


def scenes_of(scenario: eb.Scenario, agent: str, world: int = 0) -> list:
    loaded, game = eb.open_game(scenario)
    (team,) = teams_of(agent, loaded).values()
    return film_scenes(loaded.sample(1, 7, first=world), team, game)


def test_scenes__are_evenly_spaced_and_those_of_the_world_by_hand() -> None:
    scenes = scenes_of(CRASH, "coast")
    assert [round(scene.time_s, 9) for scene in scenes] == [*(k / 25 for k in range(33)), 1.3]
    assert [scene.ended for scene in scenes].index(True) == 33
    struck = [round(scene.time_s, 9) for scene in scenes if scene.impacts]
    assert (struck[0], struck[-1]) == (0.96, 1.24)  # shown for 0.3 s
    assert scenes[-1].line[5].sum() == pytest.approx(36.0) and scenes[23].line[5].sum() == 0.0
    assert scenes[10].fronts_m[0] == pytest.approx(4.0) and scenes[10].line[2, 1] == pytest.approx(5.7 - 0.4 * 6.0)


def test_scenes__are_those_of_the_recorded_episode() -> None:
    scenario, game = eb.open_game("paper-random")
    (team,) = teams_of("e_v2x_bm", scenario).values()
    record = eb.record_episode(scenario.sample(1, 7), team, game)
    scenes = scenes_of(scenario, "e_v2x_bm")
    for scene in scenes[::9]:
        gaps = [np.interp(scene.time_s, record.time_s, record.gaps_m[:, p]) for p in range(2)]
        assert scene.line[2, 1:3] == pytest.approx(gaps, abs=0.01)
    assert scenes[-1].line[4, :-1].sum() == record.last.harm("first")[0]


def test_film__plays_in_real_time_and_ends_with_the_longest() -> None:
    scenario, game = eb.open_game(CRASH)
    teams = {name: teams_of(agent, scenario)[agent] for name, agent in (("a", "coast"), ("b", "full_brake"))}
    shown = Image.open(io.BytesIO(film(scenario.sample(1, 7), teams, ".gif", game)))
    assert (shown.n_frames, shown.size) == (34, (800, 608))
    assert {frame.info["duration"] for frame in ImageSequence.Iterator(shown)} == {40}


def test_film__as_mp4_plays_in_real_time(tmp_path: Path) -> None:
    library = pytest.importorskip("imageio_ffmpeg", reason="needs the extra: pip install 'ethbrake-marl[render]'")
    scenario, game = eb.open_game(CRASH)
    path = tmp_path / "film.mp4"
    path.write_bytes(film(scenario.sample(1, 7), teams_of("coast", scenario), ".mp4", game))
    frames, seconds = library.count_frames_and_secs(str(path))
    assert frames == 34 and seconds == pytest.approx(34 / 25, abs=0.02)


def test_watch__makes_the_picture_of_the_readme(ethbrake: Command, empty_folder: Path) -> None:
    answer = ethbrake("watch", "--agents", "full_brake,universal", "--output", "now.png")
    assert (answer.status, answer.out, answer.err) == (0, "", "pictures: now.png\n")
    now, then = (Image.open(file).convert("RGB") for file in ("now.png", DOCS / "figures" / "emergency.png"))
    assert now.size == then.size
    assert (np.abs(np.array(now, int) - np.array(then, int)).max(axis=2) > 8).mean() < 1e-3


def test_watch__is_refused(refuse: Refuse, monkeypatch: pytest.MonkeyPatch) -> None:
    refuse("watch --agents nobody --output x.txt", "film with the file ending '.txt': the ending must be one of")
    refuse("watch --agents nobody --output x.gif", "unknown agent 'nobody'")
    refuse("watch --scenario cooperation-0-sensors --output x.gif", "has no learner that the agents could drive")
    monkeypatch.setattr("ethbrake_marl.extensions.rendering.film.MOST_PICTURES", 100)
    refuse("watch --agents full_brake,coast --output x.gif", "film of 2 agents: needs 392 pictures, but at most 100")
    Path("film.gif").write_text("precious")
    told = "film.gif: already exists; give another name, or pass force=True (--force) to overwrite the file"
    refuse("watch --agents full_brake --output film.gif", told)


def test_watch__of_an_extra_that_is_missing_says_the_line_that_installs_it(
    ethbrake: Command, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    missing = f"needs the package imageio_ffmpeg, which is not installed; install it with: {sys.executable} -m pip"
    check_refused(
        ethbrake("watch", "--agents", "coast", "--output", "film.mp4"), f"{missing} install 'ethbrake-marl[render]'\n"
    )
    assert list(Path().iterdir()) == []


def test_watch__target_that_cannot_be_replaced_is_refused(ethbrake: Command, empty_folder: Path) -> None:
    link = empty_folder / "mine.png"
    link.symlink_to("nowhere")
    check_refused(ethbrake("watch", "--agents", "coast", "--output", link, "--force"), "is a symbolic link")
    assert not (empty_folder / "nowhere").exists()


def test_film_scenes__needs_one_world() -> None:
    scenario, game = eb.open_game("paper-random")
    with pytest.raises(eb.EthBrakeError, match="world has 2 worlds; give exactly one"):
        film_scenes(scenario.sample(2, 7), teams_of("coast", scenario)["coast"], game)
