"""An action becomes a command, and a command an action."""

from __future__ import annotations

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.episode.commands import action_of, actions_of, command_of, commands_of
from ethbrake_marl.motion.layout import BRAKING, DRIVING


def test_commands_and_actions__are_each_others_inverse_and_clipped() -> None:
    state = eb.load_scenario("paper-random").sample(200, 7)
    state.car[:, DRIVING, 2] = 3.0
    actions = np.random.default_rng(1).uniform(-1.0, 1.0, 200)
    commands = commands_of(state, 2, actions)
    assert (commands == actions * np.where(actions < 0.0, state.car[:, BRAKING, 2], state.car[:, DRIVING, 2])).all()
    assert np.abs(actions_of(state, 2, commands) - actions).max() < 1e-15
    assert (actions_of(state, 2, np.sign(actions) * 100.0) == np.sign(actions)).all()
    state.car[:, DRIVING, 2] = 0.0
    assert (actions_of(state, 2, np.ones(200)) == 0.0).all()


def test_kernels__have_the_bits_of_the_functions_for_arrays() -> None:
    state = eb.load_scenario("realistic-mixed").sample(40, 7)
    actions = np.random.default_rng(2).uniform(-1.5, 1.5, (40, 2))
    commands = commands_of(state, [2, 3], actions)
    again = actions_of(state, [2, 3], 1.2 * commands)
    for k in range(40):
        for j, body in enumerate((2, 3)):
            assert command_of(state.car[k], body, actions[k, j]) == commands[k, j]
            assert action_of(state.car[k], body, 1.2 * commands[k, j]) == again[k, j]
