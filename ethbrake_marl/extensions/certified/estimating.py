"""The agent ``plan:estimated``: the best plan in phases for the mean cost in several possible lines.

Lines count less once an impact that they had foretold has not come, or one has come that they had not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.episode.counts import HONEST, HarmCount
from ethbrake_marl.episode.layer import ESTIMATED, Observer, see_through
from ethbrake_marl.episode.plans import COMMANDS, PHASES, PLAN_NUMBERS, no_plans
from ethbrake_marl.episode.state import TIME, State
from ethbrake_marl.episode.step import hold_commands
from ethbrake_marl.extensions.certified.estimated import News, PossibleLines, check_predictable
from ethbrake_marl.extensions.forecasts.phases import Forecast, empty_forecast
from ethbrake_marl.extensions.forecasts.planner import make_plans
from ethbrake_marl.extensions.messages.game import MessagesLayer
from ethbrake_marl.extensions.messages.links import SAMPLE_FORCE
from ethbrake_marl.motion.layout import FORCE, GAP, HIT, LATENCY, SPEED, Floats
from ethbrake_marl.registry import Part
from ethbrake_marl.worlds.roles import LEARNER
from ethbrake_marl.worlds.scenario import Scenario

LINES = 8  # possible lines
CANDIDATES = 150  # of a decision
UNLIKELY = 1e-3  # factor of the weight of a line that has foretold another impact of the vehicle
LEAST_WEIGHT = 0.01  # lines with less do not count
SAME = 1e-9  # by which arrays of equal lines may differ
FELT_GAP_M = 0.01  # to a vehicle whose impact was felt, but not foretold


class LinesMemory(NamedTuple):
    """Possible lines at the last decision, M for each of n worlds, and the plan."""

    plan: Floats  # [n, PLAN_NUMBERS]
    line: Floats  # [n, M, LINE_ROWS, N + 1]
    car: Floats  # [n, M, CAR_ROWS, N + 1]
    wanted: Floats  # [n, M, N + 1]
    weight: Floats  # [n, M] largest: 1
    time_s: Floats  # [n]


def memory_of(plan: Floats, lines: State, weight: Floats, time_s: Floats) -> LinesMemory:
    line, car, wanted = (
        array.reshape(*weight.shape, *array.shape[1:]) for array in (lines.line, lines.car, lines.wanted)
    )
    return LinesMemory(plan, line, car, wanted, weight, time_s)


@dataclass(frozen=True, kw_only=True)
class EstimatingPlanner(Observer):
    """Plans for the mean over possible lines. Other learners are assumed to brake fully, or to keep a known force."""

    scenario: Scenario
    lines: int = LINES
    harm_count: HarmCount = HONEST
    candidates: int = CANDIDATES
    name: str = "plan:estimated"
    knows: str = ESTIMATED

    @cached_property
    def possible(self) -> dict[int, PossibleLines]:
        """Body -> lines at the alert."""
        return {body: PossibleLines.of(self.scenario, body, self.lines) for body in self.scenario.learners}

    def begin(self, alert: State, body: int) -> LinesMemory:
        n, model = alert.n, self.possible[body].for_worlds(alert.n)
        rows = alert.take(np.repeat(np.arange(n), self.lines))
        plan, weight = np.full((n, PLAN_NUMBERS), np.nan), np.ones((n, self.lines))
        return memory_of(plan, model.at_alert(rows, rows), weight, np.zeros(n))

    def act(self, state: State, memory: LinesMemory, body: int) -> tuple[Floats, LinesMemory]:
        for layer in self.layers:
            if not isinstance(layer, MessagesLayer):  # what messages tell is read below
                state = see_through(layer, state, body)
        n, M, model = state.n, self.lines, self.possible[body].for_worlds(state.n)
        rows = state.take(np.repeat(np.arange(n), M))
        lines = moved_on(rows, memory, body)
        pairs = slice(body - 1, body + 1)
        wrong = lines.line[:, HIT, pairs] != rows.line[:, HIT, pairs]
        missed = lines.line[:, HIT, pairs] < rows.line[:, HIT, pairs]
        news = model.received(rows)
        lines = model.with_received(rows, lines)
        lines.line[:, SPEED, body] = rows.line[:, SPEED, body]
        for side, j in enumerate((body - 1, body + 1)):
            if 0 < j <= state.vehicles:
                felt = missed[:, side] & ~news.located[:, j]
                lines.line[felt, GAP, body - 1 + side] = FELT_GAP_M
                lines.line[felt, SPEED, j] = lines.line[felt, SPEED, body]
        weight = memory.weight * np.where(wrong.any(axis=1).reshape(n, M), UNLIKELY, 1.0)
        weight /= weight.max(axis=1, keepdims=True)
        forecast = forecast_of(rows, lines, held_commands(model, news, lines.wanted), weight, body)
        last = no_plans(state)
        last[:, :, body] = memory.plan
        plans, _ = make_plans(
            state, forecast, last, np.full(n, np.inf), np.array([body]), phases=PHASES, reaction_s=0.0,
            time_step_s=self.scenario.time_step_s, count=self.harm_count, candidates=self.candidates,
        )  # fmt: skip
        memory = memory_of(plans[:, :, body], lines, weight, state.time_s.copy())
        return plans[:, COMMANDS.start, body].copy(), memory


def moved_on(rows: State, memory: LinesMemory, body: int) -> State:
    """The possible lines now, [n M]; ``rows`` is the present state, M times for each world."""
    M, clock, line, car, wanted = memory.line.shape[1], rows.clock.copy(), *memory[1:4]
    clock[:, TIME] = np.repeat(memory.time_s, M)
    line, car, wanted = (array.reshape(rows.n, *array.shape[2:]).copy() for array in (line, car, wanted))
    wanted[:, body] = rows.wanted[:, body]
    lines = rows._replace(line=line, car=car, clock=clock, wanted=wanted, memories={})
    return hold_commands(lines, rows.time_s)


def held_commands(model: PossibleLines, news: News, wanted: Floats) -> Floats:
    """Commands [n M, N + 1] (m/s2): ``wanted``, but a learner keeps a force that was received."""
    force = news.sample[:, SAMPLE_FORCE]
    learns = np.array([False, *(role == LEARNER for role in model.roles)])
    return np.where(learns & news.with_force & (force != 0.0), force, wanted)


def forecast_of(rows: State, lines: State, commands: Floats, weight: Floats, body: int) -> Forecast:
    (n, M), bodies = weight.shape, rows.vehicles + 1
    forecast = empty_forecast(n, M, bodies)
    line, car = lines.line.reshape(n, M, -1, bodies), lines.car.reshape(n, M, -1, bodies)
    for row in (SPEED, FORCE, GAP, HIT):
        forecast.line[:, :, row] = line[:, :, row]
    forecast.car[:] = car
    forecast.car[:, :, LATENCY] = np.maximum(car[:, :, LATENCY] - rows.time_s.reshape(n, M, 1), 0.0)
    forecast.commands[:] = commands.reshape(n, M, 1, bodies)
    forecast.ends[:] = np.inf
    forecast.weight[:] = np.where(weight > LEAST_WEIGHT, weight, 0.0)
    finite = [np.nan_to_num(array, posinf=1e12) for array in (forecast.line, forecast.car, forecast.commands)]
    alike = np.all([np.ptp(array, axis=1).reshape(n, -1).max(axis=1) < SAME for array in finite], axis=0)
    forecast.weight[alike] = np.arange(M) == 0
    forecast.weight[:] /= forecast.weight.sum(axis=1, keepdims=True)
    forecast.known[:] = 1, rows.vehicles
    return forecast


def make_estimating_planner(argument: str | None, settings: Any) -> EstimatingPlanner:
    scenario = settings.needed_scenario()
    for body in scenario.learners:
        check_predictable(scenario, body)
    return EstimatingPlanner(scenario=scenario, harm_count=settings.harm_count)


AGENT = Part(
    make_estimating_planner,
    form="plan:estimated",
    about="as plan, for the mean cost in eight lines that are possible after what was received",
    knows=ESTIMATED,
)
