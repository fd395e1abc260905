"""Policies of bundles and of other libraries drive as agents: alone and behind every shield."""

from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import stable_baselines3 as stable

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.learned import LearnedAgent
from ethbrake_marl.first_edition.agents.protocol import Source, policy_sha256
from ethbrake_marl.first_edition.game.actions import action_to_command
from ethbrake_marl.first_edition.game.observations import ObservationSpec, observe
from tests.first_edition.rest.fixture_asked import Asked

SCENARIO = eb.load_scenario("paper-random")
WORLDS = SCENARIO.sample(12, 7).worlds
AROUND = ("+episode", "+episode:pairwise", "+step")


def harms(agent, worlds=WORLDS):
    return drive(worlds, agent, SCENARIO, 1).ledger.world_harm("first")


def shielded(agent, around):
    """The agent with this around it, through a name of its own."""
    eb.register_agent(f"theirs_{id(agent)}", lambda argument, settings: agent)
    return eb.make_agent(f"theirs_{id(agent)}{around}", scenario=SCENARIO)


def brake(observation):
    return np.full((len(observation), 1), -0.5, np.float32)


@pytest.fixture(scope="module")
def model():
    return train_ppo()


def train_ppo():
    rows = eb.make_sb3_vec_env("paper-random", 4)
    return stable.PPO("MlpPolicy", rows, n_steps=8, batch_size=16, n_epochs=1, seed=1).learn(64)


@pytest.mark.parametrize("seed", [3, 4, 9])
def test_trained_model__drives_as_in_its_own_librarys_rollout(model, seed):
    env = eb.EthBrakeEnv()
    (observation, _), over, reward = env.reset(seed=seed), False, 0.0
    while not over:
        observation, more, terminated, truncated, _ = env.step(model.predict(observation, deterministic=True)[0])
        reward, over = reward + more, terminated or truncated
    worlds = SCENARIO.sample(1, seed, channel="training").worlds
    agent = eb.policy_agent(model, name="sb3", scenario=SCENARIO.name)
    assert harms(agent, worlds)[0] == pytest.approx(-reward, rel=1e-5, abs=1e-5)


def test_onnx__path_and_session_drive_as_the_policy_does(tmp_path: Path):
    policy, path = eb.load_shipped("ppo"), tmp_path / "shipped.onnx"
    path.write_bytes(policy.to_onnx())
    expected = harms(eb.LearnedAgent(policy))
    for given in (path, onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])):
        assert harms(eb.policy_agent(given)) == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert eb.policy_agent(path).name == "shipped" and harms(eb.policy_agent(policy)).tolist() == expected.tolist()


def ramp(observation, state):
    """Brakes harder with every step: what it does depends on its memory alone."""
    return -np.minimum(state["steps"], 10.0) / 10.0, {"steps": state["steps"] + 1.0}


def no_memory(n):
    return {"steps": np.zeros((n, 1), np.float32)}


class Recurrent:
    """A model with the interface of sb3-contrib's recurrent ones, which brakes harder with every step."""

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        kept = np.zeros((1, len(observation), 1), np.float32) if state is None else state[0]
        begun = np.zeros(len(observation), bool) if episode_start is None else np.asarray(episode_start)
        steps = np.where(begun[None, :, None], np.float32(0.0), kept)
        return -np.minimum(steps[0], 10.0) / 10.0, (steps + np.float32(1.0),)


@pytest.mark.parametrize(
    "make", [lambda: eb.policy_agent(ramp, initial_state=no_memory), lambda: eb.policy_agent(Recurrent())]
)
def test_memory__belongs_to_each_episode_and_goes_with_its_world(make):
    agent, capacity = Asked(make()), WORLDS.vehicles.braking_capacity_mps2[:, 1]
    agent.begin(WORLDS, 1, np.arange(12))
    for _ in range(3):
        agent.act(WORLDS, 1)
    agent.begin(WORLDS.take([4]), 1, np.array([4]))  # one episode is renewed
    part = agent.take(np.array([3, 4]))
    assert agent.act(WORLDS, 1) == pytest.approx(-np.where(np.arange(12) == 4, 0.0, 0.3) * capacity)
    assert part.act(WORLDS.take([3, 4]), 1) == pytest.approx([-0.3 * capacity[3], 0.0])  # left as it was
    assert harms(make()).tolist() == harms(eb.policy_agent(ramp, initial_state=no_memory)).tolist()


@pytest.mark.parametrize("around", AROUND)
@pytest.mark.parametrize("kind", ["model", "function with a memory"])
def test_policy__behind_every_shield_keeps_the_bound(kind, model, around):
    check_bound(kind, model, around)


def check_bound(kind, model, around):
    own = eb.policy_agent(model, name="sb3") if kind == "model" else eb.policy_agent(ramp, initial_state=no_memory)
    found = eb.evaluate(WORLDS, {"mine": shielded(own, around)}, scenario=SCENARIO).outcome("mine")
    harm = found.first_impact_harm
    if around != "+episode:pairwise":
        assert (harm <= found.predicted_harm + 1e-5).all()
    if around == "+step" and kind != "model":  # rolled out with a memory of its own: unhindered where it is good
        assert (harm[found.chosen_policy] == harms(own)[found.chosen_policy]).all() and found.chosen_policy.any()


def test_model_trained_under_vec_normalize__drives_by_what_was_counted():
    normalised = stable.common.vec_env.VecNormalize(eb.make_sb3_vec_env("paper-random", 4), clip_obs=2.0)
    model = stable.PPO("MlpPolicy", normalised, n_steps=64, batch_size=256, n_epochs=1, seed=1).learn(256)

    def with_statistics(seen):
        return model.predict(normalised.normalize_obs(seen), deterministic=True)[0]

    agent = eb.policy_agent(model)
    assert harms(agent).tolist() == harms(eb.policy_agent(with_statistics)).tolist()
    before, mean = policy_sha256(agent), normalised.obs_rms.mean.copy()
    normalised.obs_rms.mean = mean + 1.0
    assert policy_sha256(agent) not in (before, None)
    normalised.obs_rms.mean = mean
    assert policy_sha256(agent) == before  # asking has counted nothing
    assert harms(eb.policy_agent(model.policy)).tolist() != harms(agent).tolist()  # the statistics do matter


@pytest.mark.parametrize("appended", ["number", "state"])
def test_model_trained_on_rows_with_something_appended__drives_as_there(appended):
    scenario = eb.load_scenario("cooperation-3-pair")
    rows = eb.make_sb3_vec_env(scenario, 4, seed=3, appended=appended)
    model = stable.PPO("MlpPolicy", rows, n_steps=8, batch_size=16, n_epochs=1, seed=1)
    told = {"scenario": scenario, "appended": appended}  # a model that has its environment needs none of it
    agents = {1: eb.policy_agent(model.policy, **told), 2: eb.policy_agent(model)}
    assert agents[1].knows == (Source.STATE if appended == "state" else "messages")
    team = drive(scenario.sample(4, 3, channel="training").worlds, eb.Team(agents, "theirs"), scenario)
    rows.seed(3)  # the model has set its own
    seen, over, harm = rows.reset(), np.zeros(4, bool), np.full(4, np.nan)
    while not over.all():
        seen, _, done, infos = rows.step(model.predict(seen, deterministic=True)[0])
        for k in np.flatnonzero(done[::2] & ~over):
            over[k], harm[k] = True, infos[2 * k]["world_first_impact_harm"]
    assert team.ledger.world_harm("first") == pytest.approx(harm, rel=1e-4, abs=1e-4)


@pytest.mark.parametrize(("beyond", "clip"), [(1.5, True), (float(np.nextafter(np.float32(1), np.float32(2))), False)])
def test_clip__means_the_nearest_and_one_float32_step_beyond_is_always_1(beyond, clip):
    agent = Asked(eb.policy_agent(lambda seen: np.full((len(seen), 1), -beyond), clip=clip)).begin(WORLDS, 1)
    assert agent.act(WORLDS, 1).tolist() == (-WORLDS.vehicles.braking_capacity_mps2[:, 1]).tolist()


FILE = """
import numpy as np
import ethbrake_marl.first_edition as eb

def make_agent():
    return eb.policy_agent(lambda seen: np.full((len(seen), 1), -0.5), name="half")

def harder(argument, settings):
    return eb.policy_agent(lambda seen: np.full((len(seen), 1), -float(argument)), scenario=settings.scenario)
"""


@pytest.mark.parametrize("around", ["", *AROUND])
def test_file__makes_an_agent_alone_and_behind_every_shield(tmp_path: Path, around):
    check_file(tmp_path, around)


def check_file(tmp_path, around):
    file = tmp_path / "My+File.py"
    file.write_text(FILE)
    agent = eb.make_agent(f"{file}:harder:0.5{around}", scenario=SCENARIO)
    assert harms(agent).tolist() == harms(shielded(eb.policy_agent(brake), around)).tolist()
    assert harms(eb.make_agent(f"{file}:make_agent")).tolist() == harms(eb.policy_agent(brake)).tolist()


def test_bundle__acts_in_fractions_of_the_own_capacity(policy: eb.Policy) -> None:
    class Fixed:
        observation = ObservationSpec()

        def __call__(self, seen):
            return np.array([[-1.0], [-0.25], [0.0], [0.5]], np.float32)

    worlds = eb.make_worlds(
        [7.0, 7.0], np.tile([20.0, 18.0, 20.0], (4, 1)), braking_capacity_mps2=[6.0, 8.0, 6.0],
        driving_capacity_mps2=[1.0, 2.0, 3.0], latency_s=[0.0, 0.5, 0.8], mass_t=5.0, restitution=0.1,
    )  # fmt: skip
    wanted = LearnedAgent(Fixed()).act(worlds, 1)
    assert wanted.dtype == np.float64 and wanted.tolist() == [-8.0, -2.0, 0.0, 1.0]
    action = policy(observe(WORLDS, 2, policy.observation))[:, 0].astype(np.float64)  # as the vehicle itself sees it
    assert np.array_equal(LearnedAgent(policy).act(WORLDS, 2), action_to_command(action, WORLDS.vehicles, 2))
