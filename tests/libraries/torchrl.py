"""TorchRL."""

from __future__ import annotations

from typing import Any

from tests.libraries.library import Library

LIBRARY = Library(
    title="TorchRL",
    package="torchrl",
    requires=("torchrl==0.14.1",),
    about=(
        'TorchRL wants vector environments that reset in the same step: `autoreset_mode="SameStep"`. '
        "`ethbrake_marl.learning.benchmarl.LineEnv` is the line as a batched TorchRL environment of its own "
        "(extra `marl`)."
    ),
    in_ci=True,
)


@LIBRARY.way("`PettingZooWrapper` with its defaults", "100 steps")
def petting_zoo():
    from torchrl.envs import PettingZooWrapper
    from torchrl.envs.utils import check_env_specs

    import ethbrake_marl as eb

    env = PettingZooWrapper(eb.parallel_env("cooperation-3-pair", agents="learners"))
    check_env_specs(env)
    env.rollout(100)


@LIBRARY.way("`GymWrapper` on `make`", "100 steps")
def gym_wrapper():
    import gymnasium as gym
    from torchrl.envs import GymWrapper
    from torchrl.envs.utils import check_env_specs

    env = GymWrapper(gym.make("ethbrake_marl:EthBrake-v0"))
    check_env_specs(env)
    env.rollout(100)


@LIBRARY.way("`GymWrapper` on `make_vec`, and PPO", "PPO, 40,960 steps in 32 worlds", learns=True)
def vector():
    import gymnasium as gym
    from torchrl.collectors import Collector
    from torchrl.envs import GymWrapper

    reward = {"harm": 0.05, "shaping": 0.05}
    env = gym.make_vec("ethbrake_marl:EthBrake-v0", num_envs=32, reward=reward, autoreset_mode="SameStep")
    worlds = GymWrapper(env)
    actor = make_actor()
    collector = Collector(worlds, actor, frames_per_batch=4_096, total_frames=40_960)
    return learn(actor, collector)


def make_actor() -> Any:
    from tensordict.nn import TensorDictModule
    from torch import manual_seed, nn
    from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

    manual_seed(0)
    net = nn.Sequential(MLP(27, 2, num_cells=[64, 64], activation_class=nn.Tanh), NormalParamExtractor())
    module = TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"])
    given = {"in_keys": ["loc", "scale"], "distribution_class": TanhNormal, "return_log_prob": True}
    return ProbabilisticActor(module, **given)


def learn(actor: Any, collector: Any) -> Any:
    """TorchRL's PPO: its loss, its advantages; leaves ``torchrl.pt``."""
    import torch
    from torchrl.modules import MLP, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    critic = ValueOperator(MLP(27, 1, num_cells=[64, 64], activation_class=torch.nn.Tanh), in_keys=["observation"])
    advantage = GAE(gamma=0.99, lmbda=0.9, value_network=critic)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.0)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
    for batch in collector:
        for _ in range(5):
            rows = advantage(batch).reshape(-1)
            for picked in torch.randperm(len(rows)).split(512):
                told = loss(rows[picked])
                optimiser.zero_grad()
                sum(value for name, value in told.items() if name.startswith("loss_")).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimiser.step()
    collector.shutdown()
    torch.save(actor.state_dict(), "torchrl.pt")
    return policy_of(actor), lambda n: own_rollout(actor, n)


def policy_of(actor: Any) -> Any:
    """Observations [n, F] -> actions [n, 1], without exploration."""
    import torch
    from tensordict import TensorDict
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    def torchrl(observations: Any) -> Any:
        given = TensorDict({"observation": torch.tensor(observations)}, batch_size=[len(observations)])
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            return actor(given)["action"]

    return torchrl


def own_rollout(actor: Any, n: int) -> Any:
    """Harm [n] by ``env.rollout``; what is told of it at the end of each episode."""
    import gymnasium as gym
    import torch
    from torchrl.envs import GymWrapper
    from torchrl.envs.utils import ExplorationType, set_exploration_type

    class Last(gym.Wrapper):
        """Keeps the last harm."""

        def step(self, action: Any) -> Any:
            told = self.env.step(action)
            self.harm = told[4]["world_first_impact_harm"]
            return told

    kept = Last(gym.make("ethbrake_marl:EthBrake-v0"))
    env, harm = GymWrapper(kept), []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for k in range(n):
            begun = env.reset(seed=7) if k == 0 else env.reset()
            env.rollout(200, actor, auto_reset=False, tensordict=begun)
            harm.append(kept.harm)
    return harm
