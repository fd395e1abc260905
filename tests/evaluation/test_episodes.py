"""Single episodes: recorded, as exact motion, as a film; and datasets of them, Parquet and Minari."""

import io
import json
import re
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from xml.etree import ElementTree

import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from PIL import Image, ImageSequence

import ethbrake_marl as eb
from ethbrake_marl.agents.driving import drive
from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.evaluation.motion import EpisodeMotion, follow_episodes, state_at
from ethbrake_marl.evaluation.record import record_episode
from ethbrake_marl.extensions.datasets import minari as minari_module, recording
from ethbrake_marl.extensions.datasets.minari import env_spec, write_dataset
from ethbrake_marl.extensions.datasets.parquet import KEY, decision_columns
from ethbrake_marl.extensions.datasets.recording import Recording, Task, record_episodes
from ethbrake_marl.extensions.report.film import film_bytes, film_scenes
from ethbrake_marl.game.rewards import reward_params
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.scenario.tables import worlds_from_state
from ethbrake_marl.shield.drivers import ShieldedDriver
from tests.contract.interfaces import CRASH, FIVE, PAPER

IMPACT_S = 0.5 + 0.25 / 3.0  # see PAIR
BRAKE = make_agent("full_brake")

# ---------------------------------------------------------------- records


def test_record__one_impact_by_hand(pair: eb.Scenario) -> None:
    record = record_episode(pair.sample(1, 0).worlds, BRAKE, scenario=pair)
    impacts, time = record.impacts, record.time_s
    assert (impacts.first.tolist(), [*impacts.time_s], [*impacts.closing_speed_mps]) == (
        [True], pytest.approx([IMPACT_S]), pytest.approx([3.0]),
    )  # fmt: skip
    before, coasting = time < IMPACT_S, time <= 0.5
    np.testing.assert_allclose(record.positions_m[before, 0], (20.0 * time - 3.0 * time**2)[before], atol=1e-11)
    np.testing.assert_allclose(record.positions_m[coasting, 1], 20.0 * time[coasting] - 1.0, atol=1e-11)
    # braking with 6 m/s2 from the speed after the impact
    stopped = 20.0 * IMPACT_S - 3.0 * IMPACT_S**2 + 18.315**2 / 12.0
    np.testing.assert_allclose(record.positions_m[-1], [stopped, stopped - 0.90825], atol=1e-10)
    np.testing.assert_allclose(record.positions_m[:, 0] - record.positions_m[:, 1], record.gaps_m[:, 0], atol=1e-10)


class Countdown:
    name = "countdown"

    def act(self, worlds: Any, vehicle: int) -> np.ndarray:
        return np.where(worlds.time_s < 1.05, -1.0, -5.0)


def test_record__a_command_is_in_force_from_the_latency_and_its_decision_on(pair: eb.Scenario) -> None:
    record = record_episode(pair.sample(1, 0).worlds, Countdown(), scenario=pair)
    expected = np.select([record.time_s < 0.5, record.time_s < 1.1 - 1e-9], [0.0, -1.0], -5.0)
    assert record.command_mps2[:, 1].tolist() == expected.tolist() and set(expected) == {0.0, -1.0, -5.0}
    assert (record.command_mps2[:, 0] == -6.0).all() and 0.5 in record.time_s


def test_record__agrees_with_the_evaluation_to_the_last_bit(evaluation: Evaluation, gap_agent: Any) -> None:
    outcome = evaluation.outcome("gap")
    for k in (0, int(np.argmax(outcome.impacts))):
        record = record_episode(evaluation.worlds.take([k]), gap_agent, scenario=evaluation.scenario)
        ends = [record.ledger.total_harm[0], record.gaps_m[-1], record.speeds_mps[-1], record.time_s[-1]]
        final = outcome.final
        expected = [outcome.ledger.total_harm[k], final.gaps_m[k], final.speeds_mps[k], final.time_s[k]]
        assert [np.asarray(each).tolist() for each in ends] == [np.asarray(each).tolist() for each in expected]
        assert len(record.impacts.time_s) == outcome.impacts[k]
        assert np.sum(record.impacts.closing_speed_mps**2) == pytest.approx(outcome.total_harm[k], rel=1e-12)


@pytest.mark.parametrize("sample_s", [0.02, 0.007, 5.0])
def test_record__samples_are_as_fine_as_asked_and_never_change_the_motion(
    evaluation: Evaluation, sample_s: float
) -> None:
    world, scenario = evaluation.worlds.take([1]), evaluation.scenario
    record = record_episode(world, BRAKE, scenario=scenario, sample_s=sample_s)
    coarse = record_episode(world, BRAKE, scenario=scenario)
    steps = np.diff(record.time_s)
    assert record.time_s[0] == 0.0 < steps.min() and steps.max() <= min(sample_s, 0.5) + 1e-12
    np.testing.assert_array_equal(record.gaps_m[-1], coarse.gaps_m[-1], strict=True)
    common, shared = np.isin(record.time_s, coarse.time_s), np.isin(coarse.time_s, record.time_s)
    assert common.sum() > 30
    np.testing.assert_allclose(record.positions_m[common], coarse.positions_m[shared], atol=1e-10)


def test_record__an_impact_at_the_very_alert_is_there(pair: eb.Scenario) -> None:
    at_once = pair.replace(latency_s=[0.0, 0.0])
    world = worlds_from_state(at_once, {"gaps_m": [0.0], "speeds_mps": [18.0, 20.0]})
    record = record_episode(world, BRAKE, scenario=at_once)
    assert (record.impacts.time_s[0], record.impacts.closing_speed_mps[0], record.time_s[0]) == (0.0, 2.0, 0.0)
    assert (np.diff(record.time_s) > 0.0).all() and len(record.impacts.time_s) == record.ledger.count.sum()


# ---------------------------------------------------------------- motion


def at(motion: EpisodeMotion, time_s: float) -> Floats:
    """Place of Vehicle 1, gaps, speeds, accelerations at a time."""
    k = max(int(np.searchsorted(motion.pieces[:, 0], time_s, side="right")) - 1, 0)
    return state_at(motion.pieces[k], time_s, motion.world.N)


@pytest.mark.parametrize(
    ("name", "spec"),
    [("paper-random", "constant:4.5"), ("paper-random", "ppo@shipped"), ("paper-random-obstacle", "full_brake"),
     ("pair", "full_brake")],
)  # fmt: skip
def test_motion__is_exact_at_every_moment(name: str, spec: str, pair: eb.Scenario) -> None:
    scenario = pair if name == "pair" else eb.load_scenario(name)
    worlds, agent = scenario.sample(3, 7).worlds, make_agent(spec, scenario=scenario)
    for k, motion in enumerate(follow_episodes(worlds, agent, scenario)):
        record, N = record_episode(worlds.take([k]), agent, scenario=scenario), worlds.N
        found = np.array([at(motion, float(time))[: 2 * N] for time in record.time_s])
        recorded = np.column_stack([record.positions_m[:, 0], record.gaps_m, record.speeds_mps])
        np.testing.assert_allclose(found, recorded, atol=1e-9)
        assert motion.impacts.pair.tolist() == record.impacts.pair.tolist()
        assert motion.at_rest and motion.stepped_in_s.size == 0


def test_motion__counts_what_the_evaluation_counts(evaluation: Evaluation) -> None:
    motions = follow_episodes(evaluation.worlds.take(np.arange(60)), make_agent("constant:4.5"), evaluation.scenario)
    o = evaluation.outcome("constant:4.5")
    expected = zip(o.first_impact_harm, o.total_harm, o.impacts, o.final.time_s, strict=True)
    assert [(*each.harm, len(each.impacts.time_s), each.end_s) for each in motions] == list(expected)[:60]


def test_motion__tells_where_a_shield_stepped_in(paper_random: eb.Scenario) -> None:
    agent = make_agent("constant:3+episode", scenario=paper_random)
    times = [each.stepped_in_s for each in follow_episodes(paper_random.sample(4, 7).worlds, agent, paper_random)]
    assert any(each.size for each in times) and min(np.concatenate(times)) >= 0.5  # Vehicle 2 acts from then on


def test_motion__tells_where_the_shield_of_a_team_stepped_in_as_its_log_does() -> None:
    scenario = eb.load_scenario("cooperation-3-pair")
    worlds = scenario.sample(6, 7).worlds
    team = ShieldedDriver(Team.of(make_agent("constant:3"), (1, 2)), scenario, logging=True).on((1, 2))
    log = drive(worlds, team, scenario).guarded.shield.log
    motions = follow_episodes(worlds, make_agent("constant:3+step", scenario=scenario), scenario)
    told = [sorted({entry.time_s for entry in log if entry.world == k}) for k in range(6)]
    np.testing.assert_allclose(np.concatenate([each.stepped_in_s for each in motions]), np.concatenate(told))
    assert list(map(len, told)) == [each.stepped_in_s.size for each in motions] and sum(map(len, told)) > 10


def test_motion__cascade_of_bounces_stays_small_and_ends_right(pair: eb.Scenario) -> None:
    bouncy = pair.replace(restitution=0.9)
    (motion,) = follow_episodes(bouncy.sample(1, 0).worlds, make_agent("coast"), bouncy)
    assert len(motion.impacts.time_s) > 10 and (np.diff(motion.pieces[:, 0]) > 0.0).all()
    np.testing.assert_allclose(at(motion, motion.end_s)[1], motion.final.gaps_m[0, 0], atol=1e-6)


# ---------------------------------------------------------------- films

SVG = "{http://www.w3.org/2000/svg}"
README = Path(__file__).resolve().parents[2] / "README.md"
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
    command = re.search(r"`ethbrake (watch .*?) --output docs/figures/emergency.svg`", text)[1]
    assert run_command([*command.split(), "--output", str(made)]) == 0
    texts = [file.read_text("utf-8") for file in (made, README.parent / "docs" / "figures" / "emergency.svg")]
    number = re.compile(r"-?\d+\.\d+")
    assert number.split(texts[0]) == number.split(texts[1])
    now, then = (np.array(number.findall(text), float) for text in texts)
    assert now == pytest.approx(then, abs=0.21)


# ---------------------------------------------------------------- datasets


PAIR = eb.load_scenario("cooperation-3-pair")
LINKED = eb.load_scenario("cooperation-3-congested")
DOCS = Path(__file__).resolve().parents[2] / "docs" / "datasets.md"
BRAKING = {"full_brake": BRAKE}


def record(spec: str = "full_brake", scenario: eb.Scenario = PAPER, n: int = 12, reward: Any = "harm") -> Recording:
    task = Task(scenario, 7, reward_params(reward), eb.observation_for(scenario))
    ((name, driver),) = make_lineup([spec], scenario).items()
    return record_episodes(scenario.sample(n, 7), driver, name, task)


# ---------------------------------------------------------------- recording


@pytest.mark.parametrize("spec", ["full_brake", "ppo@shipped"])
def test_record__an_agent_whose_commands_are_actions_is_as_in_an_evaluation(spec: str) -> None:
    found, expected = record(spec), eb.evaluate(PAPER.sample(12, 7), make_lineup([spec], PAPER), scenario=PAPER)
    ledgers = found.ledger, expected.outcome(spec).ledger
    assert found.off_by == 0.0
    np.testing.assert_array_equal(*(np.stack([each.world_harm(c) for c in ("first", "total")]) for each in ledgers))


@pytest.mark.parametrize("spec", ["best_harm", "e_v2x_bm", "full_brake+step", "ppo@shipped+search+episode"])
def test_record__of_any_agent_the_harm_is_that_of_its_float32_actions(spec: str) -> None:
    found = record(spec)
    assert found.actions.dtype == np.float32 and np.abs(found.actions).max() <= 1.0
    env = eb.EthBrakeVectorEnv(12, PAPER)
    env.reset(seed=7, options={"listed_world": {"seed": 7, "number": 0}})
    for t, actions in enumerate(found.actions):
        running = found.running[:, t]
        seen, reward, *_ = env.step(actions)
        assert np.array_equal(reward[running], found.steps[t].reward[running, 1])
        going_on = found.decisions > t + 1  # elsewhere a new episode begins
        assert np.array_equal(seen[going_on], found.observations[t + 1, going_on, 0])


def test_record__on_the_edge_of_an_impact_takes_the_rounding_that_keeps_the_harm() -> None:
    # Rounded to the nearest action, the optimum of one of these worlds loses an impact worth 2.3 m2/s2.
    assert record("e_v2x_bm", n=60).off_by < 1e-3


@pytest.mark.parametrize(
    "scenario", [PAPER, FIVE, PAIR, eb.load_scenario("paper-random-obstacle")], ids=lambda s: s.name
)
def test_record__knows_where_every_vehicle_is_and_when_each_episode_ends(scenario: eb.Scenario) -> None:
    found, worlds = record(scenario=scenario), scenario.sample(12, 7).worlds
    final = eb.evaluate(worlds, BRAKING, scenario=scenario).outcome("full_brake").final
    # Vehicle 1 brakes from the alert on by its full capacity b: v t - b t^2 / 2 until the first decision.
    start, speed, braking = (
        found.told("time_s")[0, :, 0],
        worlds.speeds_mps[:, 0],
        worlds.vehicles.braking_capacity_mps2,
    )
    assert found.positions_m[0, :, 0] == pytest.approx(speed * start - braking[:, 0] * start**2 / 2)
    assert (start == worlds.first_decision_s(scenario.learners)).all()
    gaps = found.positions_m[:, :, :-1] - found.positions_m[:, :, 1:]
    for k, end in enumerate(found.decisions):
        assert gaps[end, k] == pytest.approx(final.gaps_m[k], abs=1e-9)
        assert found.speeds_mps[end, k] == pytest.approx(final.speeds_mps[k], abs=1e-12)
        way = np.diff(found.positions_m[: end + 1, k], axis=0)
        most = np.maximum(found.speeds_mps[:end, k], found.speeds_mps[1 : end + 1, k]) * scenario.time_step_s
        undisturbed = np.diff(found.told("world_total_harm")[: end + 1, k, 0]) == 0.0
        assert (way[undisturbed] <= most[undisturbed] + 1e-9).all()
        over = [bool(step.terminated[k] | step.truncated[k]) for step in found.steps[:end]]
        assert over == [False] * (end - 1) + [True]


# ---------------------------------------------------------------- Parquet


def test_columns__tell_two_learners_step_by_step() -> None:
    columns = decision_columns(record(scenario=PAIR, n=5, reward={"harm": 1.0, "jerk": 0.1}))
    env = eb.parallel_env(scenario=PAIR, reward={"harm": 1.0, "jerk": 0.1})
    row = 0
    for world in range(5):
        seen, infos = env.reset(seed=0, options={"listed_world": {"seed": 7, "number": world}})
        decision = 0
        while env.agents:
            told: dict[str, Any] = {name: column[row] for name, column in columns.items()}
            expected = {"world": world, "decision": decision, "time_s": infos["vehicle_1"]["time_s"]}
            for i in (1, 2, 3):
                expected[f"command_in_force_{i}_mps2"] = infos[f"vehicle_{i}"]["command_in_force_mps2"]
            names = [f.name for f in env.engine.observation.features]
            observed = {f"vehicle_{i}": [told[f"observation_{i}.{name}"] for name in names] for i in (2, 3)}
            assert all(np.array_equal(values, seen[name]) for name, values in observed.items())
            actions = {f"vehicle_{i}": told[f"action_{i}"] for i in (2, 3)}
            seen, rewards, terminated, truncated, infos = env.step(actions)
            for i, name in ((2, "vehicle_2"), (3, "vehicle_3")):
                expected |= {
                    f"reward_{i}": rewards[name],
                    f"reward_harm_{i}": infos[name]["reward_harm"],
                    f"reward_jerk_{i}": infos[name]["reward_jerk"],
                    f"chosen_command_{i}_mps2": infos[name]["chosen_command_mps2"],
                    "cost": infos[name]["cost"],
                    "terminated": terminated[name],
                    "truncated": truncated[name],
                }
            assert {name: told[name] for name in expected} == expected
            row, decision = row + 1, decision + 1
        told = {name: columns[name][row - 1] for name in ("first_impact_harm", "total_harm")}
        assert told == {name: infos["vehicle_1"][f"world_{name}"] for name in told}
    assert {len(column) for column in columns.values()} == {row}


def test_page__lists_every_column() -> None:
    text = DOCS.read_text("utf-8")
    for name in decision_columns(record(n=1)):
        listed = re.sub(r"_[123](?=_|$)", "_I", name)
        listed = "observation_I.FEATURE" if "." in name else re.sub("^reward_(harm|jerk)_I", "reward_TERM_I", listed)
        assert f"`{listed}`" in text, name


def test_file__has_the_columns_in_row_groups_and_tells_what_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(minari_module, "BATCH", 3)
    path = tmp_path / "a.parquet"
    path.write_text("stale")
    agents = {**BRAKING, "coast": eb.make_agent("coast")}
    summary = write_dataset(path, agents, scenario=PAPER, episodes=5, force=True)
    file = parquet.ParquetFile(path)
    assert (file.metadata.num_row_groups, file.metadata.num_rows) == (4, summary.decisions)
    table = file.read()
    first = table.filter(table["decision"].to_numpy() == 0)
    assert first["world"].to_pylist() == [0, 1, 2, 3, 4] * 2
    assert first["agent"].to_pylist() == ["full_brake"] * 5 + ["coast"] * 5
    assert table["action_2"].type == "float" and table["reward_2"].type == "double"
    told = json.loads(file.metadata.metadata[KEY.encode()])
    assert eb.Scenario(**told["scenario"]) == PAPER and told["versions"]["ethbrake-marl"] == eb.__version__
    names = ("agents", "seed", "episodes", "left_out", "off_by")
    policies = {name: {"vehicle_2": None} for name in agents}
    assert [told[name] for name in names] == [policies, 7, 5, [], dict.fromkeys(agents, 0.0)]
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.parquet"]


def test_file__appears_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyarrow")
    monkeypatch.setattr(minari_module, "BATCH", 3)
    stop = Mock(side_effect=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(tmp_path / "a.parquet", BRAKING, scenario=PAPER, episodes=5, on_progress=stop)
    assert stop.called and list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------- Minari


@pytest.mark.parametrize(
    ("scenario", "agents", "reward"),
    [
        (PAPER, "best_harm,ppo@shipped", "harm"),
        (FIVE, "full_brake", {"harm": 1.0, "shaping": 0.05, "jerk": 0.1}),
        (LINKED.with_learners(["vehicle_2"]), "full_brake", "total-harm"),
    ],
    ids=["paper", "five", "linked"],
)
def test_replay__gives_the_recorded_bits(
    scenario: eb.Scenario, agents: str, reward: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    lineup = make_lineup(agents.split(","), scenario)
    summary = write_dataset("brakes-v0", lineup, scenario=scenario, episodes=4, seed=11, reward=reward)
    dataset = minari.load_dataset("brakes-v0")
    assert (dataset.total_episodes, dataset.total_steps) == (4 * len(lineup), summary.decisions)
    env = dataset.recover_environment()
    beside = dataset.storage.get_episode_metadata(range(dataset.total_episodes))
    for k, (episode, told) in enumerate(zip(dataset.iterate_episodes(), beside, strict=True)):
        assert (told["agent"], told["options"]["listed_world"]["number"]) == ([*lineup][k // 4], k % 4)
        first, info = env.reset(seed=told["seed"], options=told["options"])
        steps = [env.step(action) for action in episode.actions]
        observed, rewards, terminated, truncated, infos = zip(*steps, strict=True)
        assert np.array_equal([first, *observed], episode.observations)
        assert [*rewards] == episode.rewards.tolist() and episode.rewards.dtype == np.float64
        assert [*terminated] == episode.terminations.tolist() and [*truncated] == episode.truncations.tolist()
        assert (terminated[-1] or truncated[-1]) and set(info) == set(episode.infos)
        for name, values in episode.infos.items():
            assert np.array_equal([each[name] for each in (info, *infos)], values), name
        harms = infos[-1]["world_first_impact_harm"], infos[-1]["world_total_harm"]
        assert harms == (told["first_impact_harm"], told["total_harm"])


def test_folder__is_replaced_when_asked_and_only_then(tmp_path: Path) -> None:
    minari = pytest.importorskip("minari")
    pytest.importorskip("h5py")
    path = tmp_path / "brakes-v0"
    for number, force in ((2, False), (3, True)):
        write_dataset(path, BRAKING, scenario=PAPER, episodes=number, force=force)
        assert minari.MinariDataset(path / "data").total_episodes == number
    assert [entry.name for entry in tmp_path.iterdir()] == ["brakes-v0"]


# ---------------------------------------------------------------- writing


def test_work__leaves_a_failed_world_out_and_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real: Callable[..., Recording] = recording.record_episodes

    def failing(sample: Any, *rest: Any) -> Recording:
        if bad := {row: "planted" for row, number in enumerate(sample.index) if number == 4}:
            raise PhysicsError(bad)
        return real(sample, *rest)

    recorded, seen = Mock(), Mock()
    for name, planted in (("need", Mock()), ("record_episodes", failing), ("BATCH", 3)):
        monkeypatch.setattr(minari_module, name, planted)
    monkeypatch.setattr(minari_module, "parquet_dataset", lambda path, told: nullcontext(recorded))
    work = write_dataset(tmp_path / "some.parquet", BRAKING, scenario=PAPER, episodes=7, on_progress=seen)
    assert [call.args[0].index.tolist() for call in recorded.call_args_list] == [[0, 1, 2], [3, 5], [6]]
    assert [call.args for call in seen.call_args_list] == [("full_brake", 3), ("full_brake", 6), ("full_brake", 7)]
    assert [tuple(left) for left in work.left_out] == [(4, 7, "full_brake", "planted")]
    assert work.episodes == {"full_brake": 6}


def test_record__a_vehicle_pushed_above_its_speed_limit_goes_on() -> None:
    scenario = eb.Scenario(
        name="pushed", vehicles=2, gaps_m=5, speeds_mps=[20, 25], braking_capacity_mps2=6, driving_capacity_mps2=3,
        mass_t=[1.5, 10], latency_s=[0, 0.5], speed_limit_mps=[20, 30], time_step_s=1.0,
        roles={"vehicle_1": "coast", "vehicle_2": "learner"},
    )  # fmt: skip
    record = record_episode(scenario.sample(1, 0).worlds, make_agent("coast"), scenario=scenario)
    assert (record.speeds_mps[-1] > 24.0).all()  # momentum: 280/11.5 = 24.35 m/s in the mean
    # Struck at 1 s by 5 m/s, e = 0.1.
    np.testing.assert_allclose(record.positions_m[-1, 0], 20.0 + 7.0 * (20.0 + 1.1 * 5.0 * 10.0 / 11.5), rtol=1e-12)


def test_environment_of_gymnasium__survives_json() -> None:
    observation, reward = eb.choose_observation(["own", "front_1.gap"]), reward_params({"harm": 2.0, "jerk": 0.5})
    env = EnvSpec.from_json(env_spec(Task(FIVE, 7, reward, observation)).to_json()).make().unwrapped
    assert env.engine.scenario == FIVE
    assert env.engine.observation == observation
    assert env.learner == 3
    assert env.engine.reward == reward


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
