"""Best known commands of one vehicle where scripts react to it: candidates are played in the game itself."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ethbrake_marl.agents.team import Team, play, play_to_end
from ethbrake_marl.episode.counts import HONEST, HarmCount
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.layer import MODEL
from ethbrake_marl.episode.objectives import Declared, amounts, objectives_of
from ethbrake_marl.episode.state import LAST, State
from ethbrake_marl.motion.layout import Floats, Ints

GAME_CANDIDATES = 500  # plays of each world
DRAWN_SHARE = 0.3  # part of the candidates whose changes are of any size; those of the others become ever smaller
LEAST_CHANGE = 0.02  # size of the last changes, as part of the range of commands
CONSTANTS = 9  # constant commands with which the search begins


class Commands:
    """Agent that applies commands that are fixed at the alert. Memory: number of the decision, [n]."""

    name, knows = "commands", MODEL

    def __init__(self, commands_mps2: Floats) -> None:
        self.commands_mps2 = commands_mps2  # [n, T]

    def begin(self, alert: State, body: int) -> Ints:
        return np.zeros(alert.n, np.int64)

    def act(self, state: State, memory: Ints, body: int) -> tuple[Floats, Ints]:
        last = self.commands_mps2.shape[1] - 1
        return self.commands_mps2[np.arange(state.n), np.minimum(memory, last)], memory + 1


def search_in_game(
    game: Game,
    alert: State,
    *,
    candidates: int = GAME_CANDIDATES,
    harm_count: HarmCount = HONEST,
    objective: Declared = "total",
    teams: Iterable[Team] = (),
) -> tuple[Floats, Floats]:
    """Best commands of the game's only learner at every decision, [n, T] m/s2, and what they cost, [n] m2/s2.

    The search begins with constant commands and the commands of ``teams``; each candidate then changes the best
    commands for a while. The result of a world does not depend on other worlds.
    """
    (body,) = game.settings.learners.tolist()
    steps = int(game.reset(alert).clock[:, LAST].max())
    low = -alert.braking_capacity_mps2[:, body - 1, np.newaxis]
    span = alert.driving_capacity_mps2[:, body - 1, np.newaxis] - low
    numbers = np.stack([generator.random((candidates, 3)) for generator in alert.generators(body)], axis=2)
    proposals = [low + share * span * np.ones(steps) for share in np.linspace(0.0, 1.0, CONSTANTS)]
    proposals += [commands_of(game, alert, team, steps) for team in teams]
    best, least = proposals[0].copy(), np.full(alert.n, np.inf)
    for k in range(len(proposals) + candidates):
        proposal = proposals[k] if k < len(proposals) else changed(best, low, span, numbers, k - len(proposals))
        rows = np.flatnonzero(least > 0.0)
        if not len(rows):
            break
        last = play_to_end(game, alert.take(rows), Team("commands", {body: Commands(proposal[rows])}))
        harm = amounts(objectives_of(objective, alert.vehicles), None, last, harm_count)[:, body - 1]
        better = rows[harm < least[rows]]
        best[better] = proposal[better]
        least[rows] = np.minimum(least[rows], harm)
    return best, least


def changed(best: Floats, low: Floats, span: Floats, numbers: Floats, k: int) -> Floats:
    """Candidate k of ``len(numbers)``: ``best`` [n, T] with another command for a while, which begins rather early."""
    begin, length, height = numbers[k][:, :, np.newaxis]
    steps, progress = best.shape[1], k / len(numbers)
    first = np.floor(begin**2 * steps)
    at = np.arange(steps)
    is_changed = (at >= first) & (at < first + np.ceil(steps**length))
    if progress < DRAWN_SHARE:
        return np.where(is_changed, low + height * span, best)
    size = LEAST_CHANGE ** ((progress - DRAWN_SHARE) / (1.0 - DRAWN_SHARE))
    return np.where(is_changed, np.clip(best + (2.0 * height - 1.0) * size * span, low, low + span), best)


def commands_of(game: Game, alert: State, team: Team, steps: int) -> Floats:
    """Commands of a team's only agent at every decision, [n, steps] m/s2; at the end the last one repeats."""
    (body,) = team.drivers
    commands = [state.wanted[:, body] for step, state in play(game, alert, team) if step is not None]
    return np.pad(np.stack(commands, axis=1), ((0, 0), (0, steps - len(commands))), mode="edge")
