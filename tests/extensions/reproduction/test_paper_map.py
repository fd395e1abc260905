"""The paper's fixed-step map: impacts by hand, a slow reference, figures of version 0.5, reward, what it refuses."""

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.episode.reward import RewardParams
from ethbrake_marl.extensions.reproduction.paper_map import paper_collision, sample
from ethbrake_marl.motion.layout import GAP, HIT, IMPACTS, LATENCY, SPEED
from ethbrake_marl.training.experiment import run_experiment
from tests.refused import refused

MAPPED = eb.load_scenario("paper-random-map")


def at_a_sample(gaps, speeds) -> eb.State:
    """One world of the random test, in which nobody commands anything, at a sample with these gaps and speeds."""
    state = MAPPED.sample(1, 7)
    line, wanted, clock = state.line.copy(), np.zeros(state.wanted.shape), state.clock.copy()
    line[0, GAP, 1:3], line[0, SPEED, 1:] = gaps, speeds
    clock[0, 0] = clock[0, 1] = 2.0
    return state._replace(line=line, wanted=wanted, clock=clock)


def test_impact__by_hand() -> None:
    """Masses 4.5 and 5.5 t, e = 0.1, closing at 10 m/s: changes of 0.55 * 1.1 * 10 and 0.45 * 1.1 * 10 m/s."""
    after = sample(at_a_sample([-0.5, 50.0], [10.0, 20.0, 15.0]), 0.1)
    assert after.speeds_mps[0].tolist() == pytest.approx([16.05, 15.05, 15.0])
    assert after.harm("first")[0] == after.harm("total")[0] == 100.0
    assert after.gaps_m[0].tolist() == pytest.approx([-0.5 + 0.1 * (16.05 - 15.05), 50.0 + 0.1 * (15.05 - 15.0)])
    again = sample(at_a_sample([-0.5, 50.0], [10.0, 9.0, 9.0]), 0.1)  # overlapping, but separating
    assert not again.line[0, IMPACTS].any() and again.harm("total")[0] == 0.0


def test_impact__second_of_a_pair_is_total_harm_only_and_vehicles_stop_at_0() -> None:
    state = at_a_sample([0.0, 50.0], [10.0, 12.0, 0.4])
    state.line[0, HIT, 1], state.wanted[0, 3] = 1.0, -6.0
    after = sample(state, 0.1)
    assert (after.harm("first")[0], after.harm("total")[0], after.speeds_mps[0, 2]) == (0.0, 4.0, 0.0)


def test_impacts__of_one_sample_go_from_the_rear_to_the_front() -> None:
    """Vehicle 2 first gets 5.9 * 1.1 * 5 / 11.4 = 2.846 m/s from Vehicle 3, and then strikes Vehicle 1 with more."""
    after = sample(at_a_sample([0.0, 0.0], [10.0, 12.0, 17.0]), 0.1)
    pushed = 2.0 + 5.9 * 1.1 * 5.0 / 11.4
    assert after.pair_harm("total")[0].tolist() == pytest.approx([pushed * pushed, 25.0])


@pytest.mark.parametrize(
    ("step_s", "agent", "harm"),
    [
        (0.1, "full_brake", 23.479299909088144), (0.25, "full_brake", 36.812182133604814),
        (0.1, "constant:5", 27.97726529370422),
    ],
)  # fmt: skip
def test_game__has_the_figures_of_version_0_5(step_s: float, agent: str, harm: float) -> None:
    result = eb.evaluate(MAPPED.replace(time_step_s=step_s), agent, episodes=2_000, harm_count="first")
    assert result[agent]["first_impact_harm"].mean() == harm


def test_game__world_does_not_depend_on_the_others_and_its_end_stays() -> None:
    alert = MAPPED.sample(3, 7)
    alert.car[1, LATENCY, 2] = 0.31
    _, game = eb.open_game(MAPPED, reward="first-impact-harm")
    states = [game.reset(alert), *(game.reset(alert.take([k])) for k in range(3))]
    for step in range(90):
        action = -0.5 + 0.3 * np.sin(step)
        before, states = states[0], [game.step(each, np.full((each.n, 1), action))[0] for each in states]
        assert all(np.array_equal(states[0].line[k], states[k + 1].line[0]) for k in range(3))
    assert before.ended.all() and np.array_equal(before.line, states[0].line)
    assert before.time_s.max() <= 8.1


def test_step__reports_and_rewards_what_happens() -> None:
    scenario, game = eb.open_game(MAPPED, reward={"harm": 2.0, "terminal": 5.0, "harm_count": "total"})
    state, total, rewards = game.reset(scenario.sample(50, 7)), np.zeros(50), np.zeros(50)
    ends = np.zeros((3, 50))
    while not state.ended.all():
        state, step = game.step(state, np.full((50, 1), -0.8))
        total += step.total_harm
        rewards += step.reward[:, 1]
        ends += step.terminated, step.truncated, step.safe_end
    assert total == pytest.approx(state.harm("total"))
    assert np.array_equal(ends[0] + ends[1], np.ones(50)) and np.array_equal(ends[2] == 1.0, ~state.collided)
    assert 0 < ends[2].sum() < 50
    assert rewards == pytest.approx(5.0 * ends[2] - 2.0 * total)


def test_collision__counts_every_sample_of_an_overlap_with_the_weight_of_its_pair() -> None:
    overlap = at_a_sample([-0.5, -0.1], [10.0, 20.0, 15.0])  # the front pair closes at 10, the rear one separates at 5
    params = RewardParams(harm=0.0, collision=1.0, k_energy=(0.5, 2.0))
    assert paper_collision(params, overlap, None, None).tolist() == [-(0.5 * 100.0 + 2.0 * 25.0)]
    apart = at_a_sample([0.5, 0.1], [10.0, 20.0, 15.0])
    assert paper_collision(params, apart, None, None).tolist() == [0.0]


def test_k_energy__of_each_pair_in_exact_physics() -> None:
    def rewards(energy) -> float:
        env = eb.parallel_env(scenario="paper-random", reward={"harm": 0.0, "collision": 1.0, "k_energy": energy})
        env.reset(seed=7)
        total = 0.0
        while env.agents:
            total += env.step({"vehicle_2": np.array([-1.0], np.float32)})[1]["vehicle_2"]
        return total

    assert rewards([0.0, 1.0]) + rewards([1.0, 0.0]) == pytest.approx(rewards(1.0))
    assert rewards([0.0, 1.0]) != 0.0
    with refused("reward: k_energy has 3 entries; must be a number, or have one for each of the 2 pairs"):
        rewards([1.0, 1.0, 1.0])


def test_observation__is_the_state_of_the_paper() -> None:
    env = eb.EthBrakeEnv("paper-random-map", reward="first-impact-harm")
    observation, _ = env.reset(seed=7)
    assert observation.shape == (8,)
    assert env.unwrapped.game.views[2].names == (
        "own.speed", "own.acceleration", "front_1.gap", "front_1.closing_speed", "front_1.acceleration", "rear_1.gap",
        "rear_1.closing_speed", "rear_1.acceleration",
    )  # fmt: skip
    with refused("observation: own.speed is listed twice"):
        eb.load_scenario("paper-random").replace(observation=["own", "paper"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"physics": "paper-mop"}, "physics: unknown physics 'paper-mop'; did you mean 'paper-map'?"),
        ({"obstacle_margin_m": 1.7}, "obstacle_margin_m: is not known to physics: paper-map"),
        ({"v2x": {"preset": "nominal", "persistence": "periodic"}}, "v2x: is not known to physics: paper-map"),
    ],
)
def test_scenario__refuses_what_the_map_has_not(changes, message: str) -> None:
    with refused(message):
        MAPPED.replace(**changes)


def test_early_impacts__are_refused() -> None:
    early = MAPPED.replace(gaps_m=0.2, speeds_mps=[18, 22, 22], early_impacts="keep")
    with refused("row 0 has an impact before the first decision, which physics: paper-map does not know"):
        eb.evaluate(early, "full_brake", episodes=3, harm_count="first")


@pytest.mark.parametrize("agent", ["ppo+step", "best_harm", "plan"])
def test_agents__that_plan_with_exact_impacts_are_refused(agent: str) -> None:
    with refused("does not cover map, by which world 0 departs from the plain game"):
        eb.evaluate(MAPPED, agent, episodes=3, harm_count="first")


def test_agents__that_drive_here() -> None:
    result = eb.evaluate(
        MAPPED, "full_brake,e_v2x_bm:pairwise,ppo,ppo+episode:pairwise", episodes=20, harm_count="first"
    )
    assert result["ppo"]["total_harm"].mean() < result["full_brake"]["total_harm"].mean()


MEASURES = ("pushed_m", "drove", "injury_gidas", "limits")


@pytest.mark.parametrize("measure", MEASURES)
def test_measures__of_exact_impacts_are_refused(measure: str) -> None:
    with refused("does not cover map, by which world 0 departs from the plain game"):
        eb.evaluate(MAPPED, "full_brake", episodes=3, measures=measure, harm_count="first")


@pytest.mark.parametrize(
    ("reward", "message"),
    [
        ("shaped", "harm_count honest needs exact impacts, and physics: paper-map has none; write harm_count first"),
        ({"harm": 1.0, "push": 1.0}, "the term push needs exact"),
    ],
)
def test_rewards__of_exact_impacts_are_refused(reward, message: str) -> None:
    with refused(message):
        eb.EthBrakeEnv(MAPPED, reward=reward)


def test_record__is_refused() -> None:
    with refused("a record of the motion between decisions does not cover map"):
        eb.record_episode(MAPPED, "coast", harm_count="first")


def test_watch__is_refused() -> None:
    with refused("a picture does not cover map"):
        eb.EthBrakeEnv(MAPPED, render_mode="ansi", reward="first-impact-harm").reset(seed=1)


def test_mixture__has_one_physics() -> None:
    exact = {"scenario": eb.load_scenario("paper-random").declared()}
    mapped = {"scenario": MAPPED.replace(observation=None, name="other").declared()}
    with refused("physics must be the same in all scenarios of the mixture"):
        eb.Scenario(name="mixed", mixture=[exact, mapped])
    both = eb.Scenario(name="mixed", physics="paper-map", mixture=[exact, mapped])
    assert eb.evaluate(both, "full_brake", episodes=10, harm_count="first").n == 10


def test_honest_cost__of_exact_impacts_is_missing() -> None:
    assert "honest_cost" not in eb.evaluate(MAPPED, "coast", episodes=3, harm_count="first")["coast"]
    assert "honest_cost" in eb.evaluate(MAPPED.replace(physics=None), "coast", episodes=3)["coast"]
    info = eb.parallel_env(MAPPED, reward={"harm_count": "total"}).reset(seed=7)[1]["vehicle_2"]
    assert np.isnan(info["world_honest_cost"]) and info["world_total_harm"] == 0.0
    for refusing in (MAPPED.sample(1, 7).harm, MAPPED.sample(1, 7).pair_harm, MAPPED.sample(1, 7).borne_harm):
        with refused("the honest cost does not cover map"):
            refusing("honest")


def test_worlds__of_another_scenario_depart_by_the_map_or_are_refused() -> None:
    exact = eb.load_scenario("paper-random").sample(3, 7)
    with refused("does not cover map, by which world 0 departs"):
        eb.evaluate(exact, "e_v2x_bm", scenario=MAPPED, harm_count="first")
    message = (
        "does not cover obstacle, by which world 0 departs from the plain game; departures that it covers: backward"
    )
    with refused(f"physics: paper-map {message}, map"):
        eb.evaluate(
            eb.load_scenario("paper-random-obstacle").sample(3, 7), "full_brake", scenario=MAPPED, harm_count="first"
        )
    with refused("scenario 'paper-random' does not cover map, by which world 0"):
        eb.evaluate(MAPPED.sample(3, 7), "full_brake", scenario="paper-random")


def test_tables__name_the_physics() -> None:
    exact = eb.load_scenario("paper-random")
    captions = [
        eb.summarise(eb.evaluate(scenario, "full_brake", episodes=3, harm_count="first")).tables()[0].note
        for scenario in (exact.replace(physics="paper-map"), exact)
    ]
    assert "Worlds: paper-random (physics: paper-map): 3 worlds" in captions[0]
    assert "Worlds: paper-random: 3 worlds" in captions[1]


def test_run__is_refused_before_the_training(tmp_path) -> None:
    with refused("ethbrake run compares shields, which need exact impacts, and physics: paper-map has none"):
        run_experiment(eb.load_recipe("ppo-paper"), MAPPED, tmp_path / "run")
    assert not (tmp_path / "run").exists()
