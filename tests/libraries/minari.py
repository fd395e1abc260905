"""Minari."""

from __future__ import annotations

from tests.libraries.library import Library

LIBRARY = Library(
    title="Minari",
    package="minari",
    requires=("minari[create,hdf5]==0.5.4",),
    about=(
        "Infos are recorded, too: harm, cost, and the world's number. Whatever the settings were, objects "
        "included, `recover_environment` makes the same environment again. `ethbrake_marl`'s own data sets "
        "are told of in [the command line](cli.md)."
    ),
    in_ci=True,
)


@LIBRARY.way("record with infos, and `recover_environment`", "5 episodes, observed by an `ObservationSpec`")
def record():
    import gymnasium as gym
    import minari

    import ethbrake_marl as eb

    env = minari.DataCollector(gym.make("EthBrake-v0", observation=eb.ObservationSpec(2, 0)), record_infos=True)
    for k in range(5):
        env.reset(seed=k)
        while not any(env.step(env.action_space.sample())[2:4]):
            pass
    data = env.create_dataset("ethbrake/random-v0", algorithm_name="random")
    return replay(data)


def replay(data: object) -> None:
    """The recovered environment plays every episode again, to the bit."""
    import numpy as np

    env = data.recover_environment()
    assert env.unwrapped.engine.observation.front == 2
    for k, episode in enumerate(data.iterate_episodes()):
        observation, _ = env.reset(seed=k)
        assert np.array_equal(observation, episode.observations[0])
        for t, action in enumerate(episode.actions):
            observation, reward, *_, info = env.step(action)
            assert np.array_equal(observation, episode.observations[t + 1])
            assert reward == episode.rewards[t]
            assert info["cost"] == episode.infos["cost"][t + 1]
