"""An agent as the driver of one vehicle in another simulator, such as SUMO."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ethbrake_marl.agent_names import open_game, teams_of
from ethbrake_marl.episode.counts import HONEST, AnyCount
from ethbrake_marl.episode.script_calls import ask_script, begin_script, guard_scripts
from ethbrake_marl.episode.state import STEPS, TIME, State
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.motion.layout import FORCE, GAP, HIT, SPEED, Floats
from ethbrake_marl.worlds.open_game import AnyScenario
from ethbrake_marl.worlds.quantities import QUANTITIES

# least and largest value of what a simulator measures, and the unit: beyond them stand marks of missing values
RANGES = {
    "time_s": (0.0, 3600.0, "s"),
    "gaps_m": (-100.0, QUANTITIES["gaps_m"].high, "m"),
    "speeds_mps": (-QUANTITIES["speeds_mps"].high, QUANTITIES["speeds_mps"].high, "m/s"),
    "accelerations_mps2": (-100.0, 100.0, "m/s2"),
    "hit": (0.0, 1.0, "(truth values)"),
}
RANGES |= {
    "commands_mps2": RANGES["accelerations_mps2"],
    "obstacle_gap_m": RANGES["gaps_m"],
    "obstacle_hit": RANGES["hit"],
}


class Driver:
    """Commands of an agent for one vehicle of n worlds that another simulator moves.

    From what the simulator measures at a decision, the agent sees what it would see in this package: messages, delays
    and sensors of the scenario included. Call ``decide`` at ``first_s`` and then every ``time_step_s``; until then the
    vehicle coasts. A shield is refused: its bound holds only in this package's physics.

    Args:
        agent: name of an agent, an agent, or a mapping from vehicles to agents.
        worlds: the emergencies at the alert, from ``Scenario.sample`` or ``worlds_from_table``.
        scenario: scenario of the worlds. Its learners drive; the others follow its scripts.
        vehicle: the learner that this object drives. Each learner needs a driver of its own.
        harm_count: what an optimising agent minimises (``episode.counts``).

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random")
    >>> driver = eb.Driver("ppo", scenario.sample(1, seed=7), scenario=scenario)
    >>> driver.first_s, driver.time_step_s
    (array([0.5]), 0.1)
    >>> driver.decide(0.5, [[6.0, 5.0]], [[17.0, 20.0, 21.0]], [[-6.5, 0.0, 0.0]], [[False, False]]).round(1)
    array([5.5])

    """

    def __init__(
        self,
        agent: Any,
        worlds: State,
        *,
        scenario: AnyScenario,
        vehicle: str = "vehicle_2",
        harm_count: AnyCount = HONEST,
    ) -> None:
        loaded, game = open_game(scenario, reward={"harm_count": harm_count})
        team = teams_of({"driver": agent}, loaded, harm_count=harm_count)["driver"]
        if team.shield is not None:
            raise InvalidInput(
                f"Driver: agent {agent!r:.80} has a shield, whose bound holds only in the physics of this package;"
                " name an agent without it"
            )
        self.game, bodies = team.game(game), {f"vehicle_{body}": body for body in team.drivers}
        if vehicle not in bodies:
            raise unknown_name("learner", vehicle, bodies)
        self.body, self.time_step_s = bodies[vehicle], game.settings.time_step_s
        self.agent = self.game.agents(guard_scripts(team.drivers))[self.body]
        self.memory = begin_script(self.agent, self.game.marked(worlds), self.body)
        self.state = self.game.reset(worlds)
        self.command, self.first_s = self.state.wanted[:, self.body], self.state.time_s.copy()

    def decide(
        self,
        time_s: ArrayLike,
        gaps_m: ArrayLike,
        speeds_mps: ArrayLike,
        accelerations_mps2: ArrayLike,
        hit: ArrayLike,
        *,
        commands_mps2: ArrayLike | None = None,
        obstacle_gap_m: ArrayLike | None = None,
        obstacle_hit: ArrayLike = False,
    ) -> Floats:
        """Command of the vehicle in every world, [n] m/s2, negative brakes; to be held until the next decision.

        Raises ``InvalidInput`` for values of another shape or outside ``RANGES``, and if time goes back.

        Args:
            time_s: time since the alert, [n] or one number.
            gaps_m: gaps between neighbours, bumper to bumper, front to rear, [n, N - 1]; below 0 counts as 0.
            speeds_mps: [n, N]; below 0 only in a world that has had an impact.
            accelerations_mps2: what brakes and engines alone have caused until now, [n, N]. Brakes keep it at rest.
            hit: whether the pair has had an impact, [n, N - 1].
            commands_mps2: last command of each vehicle, [n, N]. Only agents need it that simulate the others, or hear
                of their intent. None: the others hold the commands that the scenario's scripts chose at the alert.
            obstacle_gap_m: gap between the obstacle and Vehicle 1, [n]; None without an obstacle.
            obstacle_hit: whether Vehicle 1 has struck the obstacle, [n].

        """
        before = self.state
        line, clock, wanted = before.line.copy(), before.clock.copy(), before.wanted.copy()
        measured = [
            ("time_s", clock[:, TIME], time_s),
            ("gaps_m", line[:, GAP, 1:-1], gaps_m),
            ("speeds_mps", line[:, SPEED, 1:], speeds_mps),
            ("accelerations_mps2", line[:, FORCE, 1:], accelerations_mps2),
            ("hit", line[:, HIT, 1:-1], hit),
            ("commands_mps2", wanted[:, 1:], commands_mps2),
            ("obstacle_gap_m", line[:, GAP, 0], obstacle_gap_m),
            ("obstacle_hit", line[:, HIT, 0], obstacle_hit),
        ]
        for name, target, values in measured:
            if values is not None:
                target[...] = checked_values(name, values, target.shape)
        line[:, GAP] = np.maximum(line[:, GAP], 0.0)
        backwards = np.argwhere((line[:, SPEED, 1:] < 0.0) & ~line[:, HIT].any(axis=1, keepdims=True))
        if len(backwards):
            raise InvalidInput(
                f"Driver.decide: speeds_mps{backwards[0].tolist()} is below 0: must be at least 0 m/s in a world"
                " without an impact"
            )
        if (clock[:, TIME] < before.time_s).any():
            raise InvalidInput(
                f"Driver.decide: time_s = {clock[:, TIME].min():g}: must be {before.time_s.max():g} or later, the time"
                " of the decision before (at first the time first_s)"
            )
        wanted[:, self.body] = self.command
        later = clock[:, TIME] > before.time_s
        clock[:, STEPS] += later
        state = before._replace(line=line, clock=clock, wanted=wanted)
        for layer in self.game.layers if later.any() else ():
            state = layer.after(self.game, before, state)
        self.command, self.memory = ask_script(self.agent, state, self.memory, self.body)
        self.state = state
        return self.command.copy()


def checked_values(name: str, values: Any, shape: tuple[int, ...]) -> Floats:
    """Measured values as an array of ``shape`` or one number. Raises ``InvalidInput``."""
    try:
        array = np.asarray(values)
    except ValueError:  # lists of different lengths
        array = np.empty(0, object)
    if array.dtype.kind not in "bfiu" or np.ma.is_masked(values):
        raise InvalidInput(f"Driver.decide: {name} = {values!r:.60}: must be numbers, none of them missing")
    if array.shape not in ((), shape):
        raise InvalidInput(f"Driver.decide: {name} has shape {array.shape}: must have shape {shape}")
    low, high, unit = RANGES[name]
    bad = np.argwhere(~((array >= low) & (array <= high)))
    if len(bad):
        place, value = bad[0].tolist() or "", array[tuple(bad[0])]
        right = f"must be finite and in [{low:g}, {high:g}] {unit}"
        raise InvalidInput(f"Driver.decide: {name}{place} = {value:g}: {right}")
    return array.astype(np.float64)
