"""SuperSuit."""

from __future__ import annotations

from tests.libraries.library import Library

LIBRARY = Library(
    title="SuperSuit",
    package="supersuit",
    requires=("supersuit==3.11.0", "stable-baselines3==2.9.2"),
    about=(
        "From PettingZoo to Stable-Baselines3; the learners share one policy. SuperSuit's copies are not "
        "seeded, and it does not hand on truncation: `train/supersuit_ppo.py` closes these traps, and "
        "`eb.make_sb3_vec_env` has none of them and is many times faster. Two more traps: `black_death_v3` takes an "
        "episode for over only where every agent is terminated and truncated at once, so it steps on after the end, "
        "which is an error here (it is not needed: all agents end together); `agent_indicator_v0` marks the agent with "
        "the largest bound of all features (20) in place of 1, which lies outside the space that it states "
        '(`appended="number"` of `make_sb3_vec_env` does not). `frame_skip_v0` works.'
    ),
    in_ci=True,
)


@LIBRARY.way("PPO with one policy for all learners", "PPO, 30,000 steps in 8 worlds", learns=True)
def shared():
    import supersuit
    from stable_baselines3 import PPO

    import ethbrake_marl as eb

    rows = supersuit.pettingzoo_env_to_vec_env_v1(eb.parallel_env(agents="learners"))
    worlds = supersuit.concat_vec_envs_v1(rows, 8, num_cpus=0, base_class="stable_baselines3")
    model = PPO("MlpPolicy", worlds, n_steps=256, batch_size=256)
    model.learn(30_000)
    agent = eb.policy_agent(model)
    return agent
