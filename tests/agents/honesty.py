"""The test of what agents say they know: what was not received is altered, and their actions are compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from ethbrake_marl.actions import action_to_command, command_to_action
from ethbrake_marl.agents.registry import Agent, script_agents
from ethbrake_marl.engine import Engine, Memory, Script, ask_script, begin_script
from ethbrake_marl.physics import Bools, Floats, Packed, Worlds
from ethbrake_marl.physics.messages import CHANNEL, LINK, Messages, link_at, place_at, ring_at
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.shield import ShieldedDriver
from ethbrake_marl.shield.step_shield import Proposer, proposed_action, seen_columns


def changed_decisions(
    agent: Agent, scenario: Scenario, *, vehicle: int | None = None, n: int = 100, decisions: int = 8, seed: int = 11
) -> int:
    """How many decisions change when all is altered that has not reached the vehicle by then: 0 for an honest agent.

    The agent drives twice the first ``n`` worlds of a list, or are asked what it would do in them: once it sees
    the worlds as they are, once with random numbers for what was not received, at the alert and anew at each
    of the first ``decisions``. Take a scenario with a channel that hides something, or nothing is altered.

    Args:
        agent: any; it is left as it is.
        scenario: whose worlds.
        vehicle: the driven one, from 0, beside which other learners brake fully; None: the scenario's only learner.
        n: number of worlds; more find rarer leaks.
        decisions: in each world.
        seed: of the list, and of the random numbers.

    """
    if vehicle is None:
        (vehicle,) = scenario.learners
    scenario = scenario.with_learners([vehicle])
    rng, alert = np.random.default_rng(seed), scenario.sample(n, seed).worlds
    scripts = script_agents(scenario, except_for=vehicle)
    if isinstance(agent, ShieldedDriver):
        agent = Hosted(agent)
    engine = Engine(scenario, n, learners=[vehicle], scripts=scripts, worlds=alert)
    seen = (alert, alter_unreceived(alert, vehicle, rng))
    knowing, wondering = (begin_script(agent, at_alert, vehicle, scripts) for at_alert in seen)
    changed = 0
    for _ in range(decisions):
        now = engine.worlds
        command, knowing = ask_script(agent, now, knowing, vehicle)
        other, wondering = ask_script(agent, alter_unreceived(now, vehicle, rng), wondering, vehicle)
        changed += int((other != command).sum())
        engine.step({vehicle: command_to_action(command, now.vehicles, vehicle)})
    return changed


class Hosted:
    """Who is behind a shield, asked in worlds of the caller's as an agent is."""

    name = "hosted"
    __module__ = "ethbrake_marl.hosted"  # its memory holds a shield, which that of no agent from outside may

    def __init__(self, driver: ShieldedDriver) -> None:
        self.driver, self.policy = driver, driver.policy

    def begin(self, alert: Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        options, scenario = self.driver.options, self.driver.scenario
        if options.believed:
            shield = options.believed_shield(scenario, vehicle, scripts)
            shield.begin(alert, np.arange(alert.n))
        else:
            shield = options.step_shield(scenario, vehicle, scripts)
            shield.begin(alert, np.arange(alert.n), {vehicle: self.policy})
        return np.array([shield] * alert.n), begin_script(self.policy, alert, vehicle, scripts)

    def act(self, worlds: Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        (shield, *_), policy = memory
        proposed, policy = proposed_action(self.policy, worlds, policy, vehicle)
        proposer = Proposer({vehicle: self.policy}, {vehicle: policy}, worlds)
        if self.driver.options.believed:
            applied = shield.decide(worlds, proposed, proposer)
        else:
            applied = shield.decide(
                proposed, seen=seen_columns(Packed.of(worlds))[:, : 3 * worlds.N - 2], proposer=proposer
            ).applied
        return action_to_command(applied, worlds.vehicles, vehicle), (memory[0], policy)


def alter_unreceived(worlds: Worlds, vehicle: int, rng: np.random.Generator) -> Worlds:
    """The same worlds with random numbers for all that has not reached ``vehicle`` by now, the future included."""
    vehicles, now = worlds.vehicles, worlds.time_s[:, np.newaxis]
    n, N = worlds.speeds_mps.shape
    unknown = vehicles.known_from_s[:, vehicle] > now
    unknown[:, vehicle] = False  # of itself it knows
    stale = unknown.copy()  # whose present it does not know
    if Messages.of(worlds).periodic.all():
        stale |= Messages.of(worlds).age_s(worlds.time_s)[:, vehicle] > 0.0
    far = np.array([pair if pair < vehicle else pair + 1 for pair in range(N - 1)])  # of each pair, seen from here

    def other(values: Floats, low: float, high: float, where: Bools) -> Floats:
        return np.where(where, rng.uniform(low, high, values.shape), values)

    own = vehicles.own_latency_s
    waits = (vehicles.latency_s > now) & ((vehicles.latency_s > own) | (np.arange(N) == vehicle))  # for its own news
    latency = np.where(waits, np.maximum(own, now) + rng.uniform(0.01, 1.0, (n, N)), vehicles.latency_s)
    latency = np.where(unknown, rng.uniform(0.0, 2.0, (n, N)), latency)
    news = vehicles.known_from_s
    heard = np.zeros(news.shape, np.bool_)  # by this vehicle: what others have heard it is not told
    heard[:, vehicle] = ~unknown
    changed = replace(
        vehicles,
        braking_capacity_mps2=other(vehicles.braking_capacity_mps2, 3.0, 9.0, unknown),
        driving_capacity_mps2=other(vehicles.driving_capacity_mps2, 0.0, 9.0, unknown),
        mass_t=other(vehicles.mass_t, 1.0, 40.0, unknown),
        speed_limit_mps=other(vehicles.speed_limit_mps, 30.0, 60.0, unknown),
        latency_s=latency,
        own_latency_s=other(own, 0.0, 2.0, unknown),
        known_from_s=np.where(heard | np.eye(N, dtype=np.bool_), news, _altered_news(now, news.shape, vehicle, rng)),
    )
    hit = stale[:, far]
    beside = [pair for pair in (vehicle - 1, vehicle) if 0 <= pair < N - 1]
    hit[:, beside] &= unknown[:, far[beside]]  # an own impact with somebody who is known is felt
    gaps = other(worlds.gaps_m, 2.0, 15.0, stale[:, far])
    hidden = unknown[:, 0] & np.isfinite(worlds.obstacle_gap_m)
    return replace(
        worlds,
        vehicles=changed,
        messages=_alter_messages(worlds, vehicle, rng),
        gaps_m=gaps,
        obstacle_gap_m=other(worlds.obstacle_gap_m, 5.0, 80.0, hidden),
        speeds_mps=other(worlds.speeds_mps, 5.0, 30.0, stale),
        command_mps2=other(worlds.command_mps2, -6.0, 6.0, stale),
        pair_hit=worlds.pair_hit ^ (hit & (now > 0.0)),  # at the alert nobody has hit anything
    )


def _altered_news(now: Floats, shape: tuple[int, ...], vehicle: int, rng: np.random.Generator) -> Floats:
    """When who is known of by whom, [n, N, N] s; often never. Of what this vehicle waits for, not before now."""
    since = np.zeros((len(now), shape[1], 1))
    since[:, vehicle] = now
    never = rng.random(shape) < 0.25
    return np.where(never, np.inf, since + rng.uniform(0.01, 2.0, shape))


def _alter_messages(worlds: Worlds, vehicle: int, rng: np.random.Generator) -> Floats:
    """The columns of messages with all altered that is unheard: chance, what is on its way, what others know."""
    columns, N = worlds.messages.copy(), worlds.N
    if not columns.shape[1]:
        return columns
    kept = Messages.of(worlds).links[:, vehicle].copy()
    own = columns[:, place_at(N) + vehicle].copy()
    columns[:, [CHANNEL.KEY, CHANNEL.TAKEN]] += 5.0
    columns[:, place_at(N) :] += rng.uniform(0.5, 3.0, columns[:, place_at(N) :].shape)
    links = columns[:, link_at(0, 0, N) : ring_at(N)].reshape(-1, N, N, LINK.WIDTH)
    heard = (worlds.vehicles.known_from_s[:, vehicle] <= worlds.time_s[:, np.newaxis])[..., np.newaxis]
    told = np.arange(LINK.WIDTH) >= LINK.TOLD_S
    links[:, vehicle] = np.where(heard & told, kept, links[:, vehicle])
    columns[:, place_at(N) + vehicle] = own
    return columns
