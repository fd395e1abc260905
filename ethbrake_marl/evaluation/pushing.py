"""Measures of dangerous conduct besides impacts: pushes, driving before the first impact, motion at the end."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, require
from ethbrake_marl.episode.step import Step
from ethbrake_marl.evaluation.measures import MeasureValue, Statistic
from ethbrake_marl.evaluation.resimulation import advance_worlds, simulate_again
from ethbrake_marl.evaluation.summary_row import PUSHED_FAR_M
from ethbrake_marl.motion.layout import FAR_M, GAP, IMPACTS, LATENCY, NEXT_TIME, PUSHED, Floats, scratch_for
from ethbrake_marl.registry import Part

POST_M = 1e5  # distance to an imaginary post that no vehicle reaches; its gap gives distances to 1e-10 m
HARD_MPS2 = 1.0  # a command above this is hard driving


def own_way_m(alert: State, body: int, until_s: float) -> Floats:
    """Distance that a vehicle travels from the alert to ``until_s`` if no other vehicle touches it, [n] m."""
    require(alert, "pushed_m", simulates=True)
    line, wanted = alert.line[:, :, [0, body]], alert.wanted[:, [0, body]]
    line[:, GAP, 0], line[:, GAP, 1] = POST_M, np.inf
    end_s = np.full(alert.n, until_s)
    advance_worlds(line, alert.car[:, :, [0, body]], alert.time_s.copy(), end_s, wanted, scratch_for(2))
    return POST_M - line[:, GAP, 0]


def with_post(state: State) -> Floats:
    """Copy of ``state.line`` with an imaginary post far ahead of Vehicle 1, except in worlds with an obstacle.

    The gap ahead of Vehicle 1 then shows how far the vehicle moves.
    """
    line = state.line.copy()
    line[:, GAP, 0] = np.where(line[:, GAP, 0] < FAR_M, line[:, GAP, 0], POST_M)
    return line


class PushedAway:
    """Measures how far vehicles end beyond the place that they would reach by the horizon if untouched (a ``Watch``).

    The distance is negative if a vehicle ends short of that place, for instance because an obstacle threw it back.
    """

    def __init__(self, bodies: list[int], game: Game, alert: State) -> None:
        self.own_way_m = {body: own_way_m(alert, body, game.settings.horizon_s) for body in bodies}
        self.gaps_m, self.way_m = alert.gaps_m.copy(), np.zeros(alert.n)

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Simulate the step again (``with_post``), and add the distance that Vehicle 1 travels."""
        line = with_post(before)
        from_m = line[:, GAP, 0].copy()
        advance_worlds(line, before.car, before.time_s, after.time_s, after.wanted, scratch_for(line.shape[2]))
        self.way_m += from_m - line[:, GAP, 0]

    def result(self, last: State) -> MeasureValue:
        """Excess distance of each vehicle, vehicle number -> [n] m.

        ``1_far`` [n]: whether the distance of Vehicle 1 exceeds ``PUSHED_FAR_M``.
        """
        wider_m = np.cumsum(last.gaps_m - self.gaps_m, axis=1)
        metres = {
            f"{body}": self.way_m - (wider_m[:, body - 2] if body > 1 else 0.0) - untouched_m
            for body, untouched_m in self.own_way_m.items()
        }
        return {**metres, **({"1_far": metres["1"] > PUSHED_FAR_M} if "1" in metres else {})}


def pushed_m(game: Game, alert: State) -> PushedAway | None:
    """How far a vehicle ends beyond the place where it would stop untouched, because of impacts and pushes. In reality
    the vehicle brakes for something there, so this is dangerous. Defined for vehicles that neither learn nor observe
    the state.
    """
    bodies = [i for i in range(1, alert.vehicles + 1) if i not in game.settings.learners and i not in game.scripts]
    return PushedAway(bodies, game, alert) if bodies else None


def pushed_mps(game: Game, alert: State, last: State) -> MeasureValue:
    """Push: closing speed that vehicles build up and contacts absorb, while a contact lasts and in the impacts after a
    pair's first. Without a number: sum over the line; with the number of a vehicle: push by the vehicle behind it;
    obstacle: push of Vehicle 1 against the obstacle.
    """
    require(last, "pushed_mps", simulates=True)
    of_pair = last.line[:, PUSHED]
    behind = {f"{i}": of_pair[:, i] for i in range(1, last.vehicles)}
    return {"": of_pair.sum(axis=1), **behind, "obstacle": of_pair[:, 0]}


def first_impact_s(before: State, after: State) -> Floats:
    """Time of the line's first impact if it lies between the two states, [n] s.

    Otherwise ``before.time_s`` after an earlier impact, and ``after.time_s`` if no impact has happened yet. There must
    be no decision between the two states.
    """
    until: Floats = np.where(before.collided, before.time_s, after.time_s)
    for k, scratch in simulate_again(before, after, ~before.collided & after.collided):
        struck = after.line[k, IMPACTS] > 0.0
        until[k] = before.time_s[k] + scratch[NEXT_TIME, struck].min()
    return until


def driving_s(before: State, after: State, until_s: Floats) -> Floats:
    """Time between ``before`` and ``until_s`` [n] in which each vehicle has a positive command in force, [n, N] s.

    ``after``: the state after the step, which holds the commands.
    """
    begun_s = np.maximum(before.car[:, LATENCY, 1:], before.time_s[:, np.newaxis])
    return np.where(after.commands_mps2 > 0.0, np.maximum(until_s[:, np.newaxis] - begun_s, 0.0), 0.0)


class DroveTowards:
    """Measures the share of the time before a line's first impact in which each vehicle has a positive command
    (drives).
    """

    def __init__(self, game: Game, alert: State) -> None:
        self.learners, self.time_s = game.settings.learners, np.zeros(alert.n)
        self.driving_s, self.hard = np.zeros((alert.n, alert.vehicles)), np.zeros(alert.n, np.bool_)

    def see(self, before: State, step: Step | None, after: State) -> None:
        until_s = first_impact_s(before, after)
        driving = driving_s(before, after, until_s)
        hard = (driving > 0.0) & (after.commands_mps2 > HARD_MPS2)
        self.time_s += until_s - before.time_s
        self.driving_s += driving
        self.hard |= hard[:, self.learners - 1].any(axis=1)

    def result(self, last: State) -> MeasureValue:
        share = self.driving_s / np.where(self.time_s > 0.0, self.time_s, 1.0)[:, np.newaxis]
        shares = {f"{i + 1}": column for i, column in enumerate(share.T)}
        return {"": share[:, self.learners - 1].max(axis=1, initial=0.0), **shares, "hard": self.hard}


def drove_towards(game: Game, alert: State) -> DroveTowards:
    """Share of the time before the line's first impact (of the whole episode, if there is none) in which a vehicle has
    a positive command (drives). With the number of a vehicle: for this vehicle; without: the largest share of a
    learner; hard: whether a learner drove at more than 1 m/s2.
    """
    return DroveTowards(game, alert)


def still_moving(game: Game, alert: State, last: State) -> MeasureValue:
    """Whether some vehicle still moves when the episode ends, which is then at the horizon."""
    return last.moving


FAR = "Share of worlds in which Vehicle 1 is pushed more than 5 m beyond the point where it would stop by itself."
PUSHED_M = Part(
    watch=pushed_m, unit="m",
    statistics=(
        Statistic("pushed_m_1", "mean", "Vehicle 1 pushed (m)", "Pushed\nm", "1"),
        Statistic("pushed_far_rate", "rate", "Vehicle 1 pushed > 5 m", "Pushed\n> 5 m", "1_far", FAR),
    ),
)  # fmt: skip
PUSHED_MPS = Part(pushed_mps, unit="m/s", statistics=(Statistic("pushed_mps", "mean", "Push (m/s)", "Push\nm/s"),))
DROVE_TOWARDS = Part(
    watch=drove_towards,
    statistics=(
        Statistic("drove_towards", "mean", "Drove before the first impact", "Drove\nshare"),
        Statistic("drove_hard_rate", "rate", "Drove at > 1 m/s2 before the first impact", "Drove\nhard", "hard"),
    ),
)  # fmt: skip
STILL_MOVING = Part(
    still_moving, unit="", statistics=(Statistic("still_moving_rate", "rate", "Still moving", "Still\nmoving"),)
)  # fmt: skip
