"""Measures of what harm does not count: pushes, driving before the first impact, motion at the end; sampled harm."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.conduct import driving_s, first_impact_s
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, check_exact
from ethbrake_marl.episode.step import Step, advance_worlds
from ethbrake_marl.evaluation.measures import Given, Statistic
from ethbrake_marl.evaluation.summary_row import PUSHED_FAR_M
from ethbrake_marl.motion.compiling import kernel, large
from ethbrake_marl.motion.impact import TOUCH_MPS
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    FAR_M,
    GAP,
    LATENCY,
    LIMIT,
    MASS,
    PUSHED,
    RELEASE_RATE,
    RESTITUTION,
    SPEED,
    Floats,
    scratch_for,
)
from ethbrake_marl.registry import Part

POST_M = 1e5  # distance of a post that nobody reaches, from which ways are measured to 1e-10 m
HARD_MPS2 = 1.0  # a command above this is hard driving
ON_SAMPLE = 1e-6  # part of a step: times this close count as one sample, because times are rounded


def alone(alert: State, body: int, until_s: Floats) -> tuple[Floats, Floats]:
    """Return speed (m/s) and way (m) of a vehicle at ``until_s`` [n], if nobody touches it, [n] each."""
    check_exact(alert, "pushed_m")
    line, wanted = alert.line[:, :, [0, body]], alert.wanted[:, [0, body]]
    line[:, GAP, 0], line[:, GAP, 1] = POST_M, np.inf
    advance_worlds(line, alert.car[:, :, [0, body]], alert.time_s.copy(), until_s, wanted, scratch_for(2))
    return line[:, SPEED, 1], POST_M - line[:, GAP, 0]


def with_post(state: State) -> Floats:
    """Return a copy of the lines, with a far post where there is no obstacle, whose gap shows Vehicle 1's way."""
    line = state.line.copy()
    line[:, GAP, 0] = np.where(line[:, GAP, 0] < FAR_M, line[:, GAP, 0], POST_M)
    return line


class PushedAway:
    """Way of a vehicle minus the way that it would drive until the horizon if nobody touched it.

    Negative if the vehicle ends short of that place, for instance because an obstacle threw it back.
    """

    def __init__(self, bodies: list[int], game: Game, alert: State) -> None:
        until_s = np.full(alert.n, game.rules.horizon_s)
        self.own_way_m = {body: alone(alert, body, until_s)[1] for body in bodies}
        self.gaps_m, self.way_m = alert.gaps_m.copy(), np.zeros(alert.n)

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Add the way of Vehicle 1: with a post where there is no obstacle, the step is driven again."""
        line = with_post(before)
        from_m = line[:, GAP, 0].copy()
        times = np.ascontiguousarray(before.time_s), np.ascontiguousarray(after.time_s)
        advance_worlds(line, before.car, *times, after.wanted, scratch_for(line.shape[2]))
        self.way_m += from_m - line[:, GAP, 0]

    def result(self, last: State) -> Given:
        """Return the metres of each vehicle, and whether those of Vehicle 1 are more than 5."""
        wider_m = np.cumsum(last.gaps_m - self.gaps_m, axis=1)
        metres = {
            f"{body}": self.way_m - (wider_m[:, body - 2] if body > 1 else 0.0) - own
            for body, own in self.own_way_m.items()
        }
        return {**metres, **({"1_far": metres["1"] > PUSHED_FAR_M} if "1" in metres else {})}


def pushed_m(game: Game, alert: State) -> PushedAway | None:
    """How far a vehicle ends beyond the place where it would stop by itself. In reality it brakes for something, so
    pushing is dangerous. Defined for vehicles that neither learn nor look at the state.
    """
    bodies = [i for i in range(1, alert.vehicles + 1) if i not in game.rules.learners and i not in game.scripts]
    return PushedAway(bodies, game, alert) if bodies else None


def pushed_mps(game: Game, alert: State, last: State) -> Given:
    """Push: closing speed that vehicles build up and contacts take up, as long as a contact lasts and in the impacts
    after a pair's first. Of the line; with the number of a vehicle: by the vehicle behind it; obstacle: by Vehicle 1
    against it.
    """
    check_exact(last, "pushed_mps")
    of_pair = last.line[:, PUSHED]
    behind = {f"{i}": of_pair[:, i] for i in range(1, last.vehicles)}
    return {"": of_pair.sum(axis=1), **behind, "obstacle": of_pair[:, 0]}


class DroveTowards:
    """Keeps, until the first impact of each line, the time and how long a positive command was in force."""

    def __init__(self, game: Game, alert: State) -> None:
        self.learners, self.time_s = game.rules.learners, np.zeros(alert.n)
        self.driving_s, self.hard = np.zeros((alert.n, alert.vehicles)), np.zeros(alert.n, np.bool_)

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Add the time between two states."""
        driving = driving_s(before, after)
        hard = (driving > 0.0) & (after.commands_mps2 > HARD_MPS2)
        self.time_s += first_impact_s(before, after) - before.time_s
        self.driving_s += driving
        self.hard |= hard[:, self.learners - 1].any(axis=1)

    def result(self, last: State) -> Given:
        """Return the shares of the time, and whether a learner drove hard."""
        share = self.driving_s / np.where(self.time_s > 0.0, self.time_s, 1.0)[:, np.newaxis]
        each = {f"{i + 1}": column for i, column in enumerate(share.T)}
        return {"": share[:, self.learners - 1].max(axis=1, initial=0.0), **each, "hard": self.hard}


def drove_towards(game: Game, alert: State) -> DroveTowards:
    """Share of the time before the line's first impact (without one: of the episode) in which a positive command was
    in force. With the number of a vehicle: its own, otherwise the largest of the learners; hard: whether a learner
    drove at more than 1 m/s2.
    """
    return DroveTowards(game, alert)


def still_moving(game: Game, alert: State, last: State) -> Given:
    """Whether a vehicle still moves at the end, which is then at the horizon."""
    return ~last.at_rest


@kernel
def held_motion(speed, command, limit, step):
    """Return speed (m/s) and way (m) after a step of the paper's map: ``v + h u`` and ``h v + h^2 u / 2``.

    The command u is first limited so that the speed does not pass 0 or the speed limit. An impact can leave a negative
    speed, which the brakes bring back to 0.
    """
    after = speed
    if command < 0.0:
        after = max(speed + command * step, 0.0) if speed >= 0.0 else min(speed - command * step, 0.0)
    elif command > 0.0 and speed < limit:
        after = min(speed + command * step, limit)
    return after, 0.5 * (speed + after) * step


@large
def sample_worlds(speed, gap, car, commands, samples, step, out):
    """Write the sampled harm of every world from its first sample on to ``out`` [n]; ``speed`` and ``gap`` are used up.

    ``speed`` [n, N + 1] and ``gap`` [n, N + 1] are those at the first sample, ``commands`` [T, n, N + 1] those from
    sample t on; the last repeats.
    """
    for k in range(len(out)):
        out[k] = 0.0
        for t in range(samples[k]):
            for p in range(speed.shape[1] - 2, 0, -1):  # from the rear pair to the front pair
                closing = speed[k, p + 1] - speed[k, p]
                if gap[k, p] > 0.0 or closing <= 0.0:
                    continue
                front, rear = car[k, MASS, p], car[k, MASS, p + 1]
                impulse = (1.0 + car[k, RESTITUTION, p]) * closing / (front + rear)
                speed[k, p] += rear * impulse
                speed[k, p + 1] -= front * impulse
                if closing > TOUCH_MPS:
                    out[k] += closing * closing
            now = car[k, LATENCY, 2] + (t + ON_SAMPLE) * step
            ahead = 0.0
            for i in range(1, speed.shape[1]):
                command = commands[min(t, commands.shape[0] - 1), k, i] if car[k, LATENCY, i] <= now else 0.0
                speed[k, i], way = held_motion(speed[k, i], command, car[k, LIMIT, i], step)
                if i > 1:
                    gap[k, i - 1] += ahead - way
                ahead = way


class Sampled:
    """The paper's eq. Jharm: the agents' commands, applied again in its fixed-step map (eq. dynamics2).

    Samples are at ``tau_2 + t h``, with the latency tau_2 of Vehicle 2 and the time step h, up to the horizon. At a
    sample every pair that overlaps and closes adds its squared closing speed, and its speeds change by eq. (13), from
    the rear pair to the front pair. Then each vehicle moves with the command in force at the sample. Before the first
    sample no impact is detected. Commands of an episode that has ended remain in force.
    """

    def __init__(self, game: Game, alert: State) -> None:
        self.alert, self.rules = alert, game.rules
        self.commands: list[Floats] = []

    def see(self, before: State, step: Step | None, after: State) -> None:
        """Keep the commands of a step."""
        if step is not None:
            ended = before.ended[:, np.newaxis]
            earlier = self.commands[-1] if self.commands else after.wanted
            self.commands.append(np.where(ended, earlier, after.wanted))

    def result(self, last: State) -> Given:
        """Return the sampled harm, [n] m2/s2."""
        alert, rules, start_s = self.alert, self.rules, np.ascontiguousarray(self.alert.car[:, LATENCY, 2])
        speed, gap = alert.line[:, SPEED].copy(), alert.line[:, GAP].copy()
        ways = np.zeros(speed.shape)
        for body in range(1, speed.shape[1]):
            speed[:, body], ways[:, body] = alone(alert, body, start_s)
        gap[:, 1:-1] += ways[:, 1:-1] - ways[:, 2:]
        samples = np.ceil((rules.horizon_s - start_s) / rules.time_step_s - ON_SAMPLE).astype(np.int64)
        harm = np.empty(alert.n)
        sample_worlds(speed, gap, alert.car, np.stack(self.commands), samples, rules.time_step_s, harm)
        return harm


def sampled(game: Game, alert: State) -> Sampled | None:
    """Harm as a sum over time samples (the paper's eq. Jharm): every pair that overlaps and closes at a sample adds its
    squared closing speed, so pushing adds harm for as long as it lasts. Defined if only Vehicle 2 learns, without
    obstacle, build-up of brakes, and scripts that look at the state.
    """
    usual = game.rules.learners.tolist() == [2] and not game.scripts
    obstacle = (alert.line[:, GAP, 0] < FAR_M).any()
    builds = np.isfinite(alert.car[:, [BRAKE_RATE, RELEASE_RATE], 1:]).any()
    return Sampled(game, alert) if usual and not obstacle and not builds else None


PUSHED_M = Part(
    watch=pushed_m, unit="m",
    shown=(
        Statistic("pushed_m_1", "mean", "Vehicle 1 pushed (m)", "Pushed\nm", "1"),
        Statistic("pushed_far_rate", "rate", "Vehicle 1 pushed > 5 m", "Pushed\n> 5 m", "1_far"),
    ),
)  # fmt: skip
PUSHED_MPS = Part(pushed_mps, unit="m/s", shown=(Statistic("pushed_mps", "mean", "Push (m/s)", "Push\nm/s"),))
DROVE_TOWARDS = Part(
    watch=drove_towards,
    shown=(
        Statistic("drove_towards", "mean", "Drove before the first impact", "Drove\nshare"),
        Statistic("drove_hard_rate", "rate", "Drove at > 1 m/s2 before the first impact", "Drove\nhard", "hard"),
    ),
)  # fmt: skip
STILL_MOVING = Part(
    still_moving, unit="", shown=(Statistic("still_moving_rate", "rate", "Still moving", "Still\nmoving"),)
)  # fmt: skip
SAMPLED = Part(watch=sampled, unit="m2/s2", shown=(Statistic("sampled_harm", "mean", "Sampled harm", "Sampled\nharm"),))
