"""Datasets of episodes, Parquet and Minari."""

import json
import re
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import ethbrake_marl as eb
from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.errors import PhysicsError
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.evaluation.record import record_episode
from ethbrake_marl.extensions.datasets import minari as minari_module, recording
from ethbrake_marl.extensions.datasets.minari import env_spec, write_dataset
from ethbrake_marl.extensions.datasets.parquet import KEY, decision_columns
from ethbrake_marl.extensions.datasets.recording import Recording, Task, record_episodes
from ethbrake_marl.game.rewards import reward_params
from tests.contract.interfaces import FIVE, PAPER

BRAKE = make_agent("full_brake")


PAIR = eb.load_scenario("cooperation-3-pair")


LINKED = eb.load_scenario("cooperation-3-congested")


DOCS = Path(__file__).resolve().parents[3] / "docs" / "extensions" / "datasets.md"


BRAKING = {"full_brake": BRAKE}


def record(spec: str = "full_brake", scenario: eb.Scenario = PAPER, n: int = 12, reward: Any = "harm") -> Recording:
    task = Task(scenario, 7, reward_params(reward), eb.observation_for(scenario))
    ((name, driver),) = make_lineup([spec], scenario).items()
    return record_episodes(scenario.sample(n, 7), driver, name, task)


@pytest.mark.parametrize("spec", ["full_brake", "ppo"])
def test_record__an_agent_whose_commands_are_actions_is_as_in_an_evaluation(spec: str) -> None:
    found, expected = record(spec), eb.evaluate(PAPER.sample(12, 7), make_lineup([spec], PAPER), scenario=PAPER)
    ledgers = found.ledger, expected.outcome(spec).ledger
    assert found.off_by == 0.0
    np.testing.assert_array_equal(*(np.stack([each.world_harm(c) for c in ("first", "total")]) for each in ledgers))


@pytest.mark.parametrize("spec", ["best_harm", "e_v2x_bm", "full_brake+step", "ppo+search+episode"])
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


@pytest.mark.parametrize(
    ("scenario", "agents", "reward"),
    [
        (PAPER, "best_harm,ppo", "harm"),
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


def test_environment_of_gymnasium__survives_json() -> None:
    observation, reward = eb.choose_observation(["own", "front_1.gap"]), reward_params({"harm": 2.0, "jerk": 0.5})
    env = EnvSpec.from_json(env_spec(Task(FIVE, 7, reward, observation)).to_json()).make().unwrapped
    assert env.engine.scenario == FIVE
    assert env.engine.observation == observation
    assert env.learner == 3
    assert env.engine.reward == reward


def test_record__follows_scripts_that_decide_within_a_step(swinging: eb.Scenario) -> None:
    sample, agent = swinging.sample(4, 7), make_agent("constant:3")
    found = record_episodes(sample, agent, "it", Task(swinging, 7, eb.RewardParams(), eb.observation_for(swinging)))
    for k in range(4):
        alone = record_episode(sample.worlds.take([k]), agent, scenario=swinging)
        assert alone.positions_m[-1] == pytest.approx(found.positions_m[found.decisions[k], k], abs=1e-6)
