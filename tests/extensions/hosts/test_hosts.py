"""Driving in somebody else's simulator: hosts that are right, and hosts that are not."""

import math
import re
from dataclasses import fields

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.hosts.protocol import HostFailed, HostState, drive_host
from ethbrake_marl.physics.left_out import Impacts
from ethbrake_marl.physics.paper_map import advance_sampled
from ethbrake_marl.shields.drivers import ShieldedDriver
from ethbrake_marl.shields.step import StepShield
from tests.docs.site import DOCS

PAPER = eb.load_scenario("paper-random")


class EngineHost:
    """Our own physics behind the protocol: it moves to any moment, with its own impacts."""

    dt = math.inf

    def __init__(self, worlds):
        self.worlds, self.impacts = worlds, None

    def state(self):
        return HostState(self.worlds.time_s, self.worlds.gaps_m, self.worlds.speeds_mps, self.impacts)

    def apply(self, command):
        self.worlds, self.impacts = eb.advance(self.worlds, command.wanted_mps2, until_s=command.until_s)


PAGE = (DOCS / "extensions" / "hosts.md").read_text("utf-8")
(SHOWN, PRINTED), *_ = re.findall(r"```python\n(.*?)```\n\n```\n(.*?)```", PAGE, re.DOTALL)
NAMES: dict = {}
exec(SHOWN.partition("\n\nscenario = ")[0], NAMES)
Bench = NAMES["Bench"]  # that of the page: vehicles that hold an acceleration for a step


def test_page__host_runs_as_it_is_printed(capsys):
    exec(SHOWN, {})
    assert capsys.readouterr().out == PRINTED and SHOWN.count("\n") <= 33


def same(one, other):
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))


@pytest.mark.parametrize(
    ("agent", "scenario"),
    [
        ("full_brake", "paper-random"),
        ("e_v2x_bm", "paper-random"),
        ("ppo", "paper-random"),
        ("r157_human", "paper-random"),
        ("ppo+step", "paper-random"),
        ("planner:8+step:estimated", "paper-random"),
        ("constant:3+episode", "paper-random"),
        ("full_brake+step", "cooperation-3-pair"),
    ],
)
def test_host__that_is_the_engine_equals_evaluate_to_the_bit(agent, scenario):
    scenario = eb.load_scenario(scenario)
    worlds, driver = scenario.sample(40, 7).worlds, eb.make_agent(agent, scenario=scenario)
    ours = eb.evaluate(worlds, {agent: driver}, scenario=scenario, aftermath=False).outcome(agent)
    found = drive_host(EngineHost(worlds), driver, scenario, worlds)
    compares = agent.endswith("+step")
    assert same(found.outcome.ledger, ours.ledger) and (found.distrusted is not None) == compares
    assert not compares or not found.distrusted.any()
    for name in ("gaps_m", "speeds_mps", "time_s", "pair_hit", "command_mps2"):
        assert np.array_equal(getattr(found.outcome.final, name), getattr(ours.final, name)), name
    assert np.array_equal(found.outcome.at_rest, ours.at_rest) and found.outcome.knows == ours.knows
    for name in ("predicted_harm", "chosen_policy"):
        assert np.array_equal(getattr(found.outcome, name), getattr(ours, name), equal_nan=False) or (
            getattr(ours, name) is None
        )


class SampledHost(EngineHost):
    """The paper's fixed-step map, which has impacts of its own at the decisions of Vehicle 2."""

    harm = 0.0

    def apply(self, command):
        self.worlds, self.impacts = advance_sampled(self.worlds, command.wanted_mps2, until_s=command.until_s)
        self.harm = self.harm + self.impacts.total_harm.sum(axis=1)  # in the order in which the paper's sum is made


@pytest.mark.parametrize("agent", ["full_brake", "e_v2x_bm"])
def test_host__that_is_the_sampled_map_equals_the_papers_sum(agent):
    worlds, driver = PAPER.sample(100, 7).worlds, eb.make_agent(agent, scenario=PAPER)
    paper = eb.evaluate(worlds, {agent: driver}, scenario=PAPER).outcome(agent).sampled_harm
    assert paper is not None
    host = SampledHost(worlds)
    found = drive_host(host, driver, PAPER, worlds).outcome
    assert np.array_equal(host.harm, paper) and paper.mean() > 10.0
    assert found.total_harm == pytest.approx(paper, abs=1e-9)


def test_impacts__of_a_host_without_any_are_ours_to_the_second_order_of_its_step():
    worlds, driver = PAPER.sample(300, 7).worlds, eb.make_agent("full_brake")
    ours = eb.evaluate(worlds, {"ours": driver}, scenario=PAPER, aftermath=False).outcome("ours").ledger
    alone = (ours.count > 0).sum(axis=1) == 1
    for dt, most in ((0.1, 0.1), (0.01, 0.001)):
        found = drive_host(Bench(worlds, dt), driver, PAPER, worlds).outcome.ledger
        off = np.abs(found.first_impact_harm - ours.first_impact_harm)
        assert off[alone].mean() < most and off.mean() < 5.0 * dt


class Jittery(Bench):
    """Its clock tells up to 0.04 s too much or too little, and began before the alert."""

    def state(self):
        wrong = 0.04 * math.sin(1e3 * self.time_s)
        return super().state()._replace(time_s=500.0 + self.time_s + wrong)


def test_host__with_a_jittery_clock_gives_the_same_bits():
    worlds = PAPER.sample(100, 7).worlds
    for agent in ("ppo+step:estimated", "r157_human"):
        driver = eb.make_agent(agent, scenario=PAPER)
        one, other = (drive_host(make(worlds), driver, PAPER, worlds).outcome for make in (Bench, Jittery))
        assert same(one.ledger, other.ledger) and one.ledger.collided.any()


def test_latencies__are_rounded_up_to_whole_steps_and_everybody_is_told():
    scenario = eb.load_scenario("stress-wide")
    worlds, told = scenario.sample(60, 7).worlds, []

    class Asked:
        name = "asked"

        def act(self, seen, vehicle):
            told.append(seen)
            return -seen.vehicles.braking_capacity_mps2[:, vehicle]

    found = drive_host(Bench(worlds, 0.01), Asked(), scenario, worlds).outcome
    latency, given = told[0].vehicles.latency_s, worlds.vehicles.latency_s
    assert (latency >= given - 1e-9).all() and (latency < given + 0.01).all() and (latency != given).mean() > 0.5
    assert np.abs(latency / 0.01 - np.rint(latency / 0.01)).max() < 1e-9
    for seen in told:
        acting = (seen.command_mps2[:, 1] != 0.0) & (seen.time_s < 2.0)
        assert (latency[acting, 1] <= seen.time_s[acting] + 1e-9).all()
    ours = eb.evaluate(worlds, {"ours": eb.make_agent("full_brake")}, scenario=scenario, aftermath=False)
    assert found.first_impact_harm.mean() == pytest.approx(ours.outcome("ours").first_impact_harm.mean(), rel=0.02)


@pytest.mark.parametrize("agent", ["r157_human", "r157_human+robust", "e_v2x_bm:estimated+step"])
def test_world__fares_the_same_alone_and_among_others_that_decide_at_other_times(agent):
    scenario = eb.load_scenario("stress-wide")
    options = {"uncertainty": "gaps_m=0.1"} if "robust" in agent else {}
    worlds, driver = scenario.sample(6, 7).worlds, eb.make_agent(agent, scenario=scenario, **options)
    together = drive_host(Bench(worlds, 0.01), driver, scenario, worlds).outcome.ledger
    for k in range(6):
        one = worlds.take([k])
        assert same(drive_host(Bench(one, 0.01), driver, scenario, one).outcome.ledger, together.take([k]))


class Creeping(Bench):
    """Nothing in it ever comes to rest."""

    creep = 0.005

    def apply(self, command):
        super().apply(command)
        self.speeds = np.maximum(self.speeds, self.creep)


def test_rest__is_below_a_millimetre_a_second(monkeypatch):
    worlds = PAPER.sample(20, 7).worlds
    monkeypatch.setattr(Creeping, "creep", 0.0009)
    assert drive_host(Creeping(worlds), eb.make_agent("full_brake"), PAPER, worlds).outcome.at_rest.all()


class DrivesOff:
    """Brakes until it stands, or nearly, and then drives."""

    name = "drives_off"

    def act(self, worlds, vehicle):
        v, stands = worlds.vehicles, worlds.speeds_mps[:, vehicle] <= 0.01
        return np.where(stands, v.driving_capacity_mps2[:, vehicle], -v.braking_capacity_mps2[:, vehicle])


def test_host__that_never_ends_sees_the_shield_hold_the_brakes_after_its_own_end(monkeypatch):
    decide, held = StepShield.decide, []

    def told(self, proposed, *, only, **more):
        over = self.memory.running.finished & only
        decision = decide(self, proposed, only=only, **more)
        held.extend((decision.applied[over] == -1.0).tolist())
        return decision

    monkeypatch.setattr(StepShield, "decide", told)
    worlds = PAPER.sample(200, 7).worlds
    driver = ShieldedDriver(DrivesOff(), PAPER, uncertainty="gaps_m=0.1,speeds_mps=0.1")
    found = drive_host(Creeping(worlds, 0.01), driver, PAPER, worlds)
    outcome, after = found.outcome, held
    assert not outcome.at_rest.any() and len(after) > 200 and all(after)
    assert not (outcome.first_impact_harm > outcome.predicted_harm).any() and 0 < found.distrusted.sum() < 200


class Loses(Bench):
    """Forgets its twentieth call."""

    calls = 0

    def apply(self, command):
        self.calls += 1
        if self.calls != 20:
            super().apply(command)


def broken(**wrong):
    """A host that goes wrong after 2 s, once there were impacts."""

    class Broken(Bench):
        def state(self):
            told = super().state()
            return wrong["tells"](told) if "tells" in wrong and self.time_s > 2.0 else told

        def apply(self, command):
            if "does" in wrong and self.time_s > 2.0:
                wrong["does"](self, command)
            super().apply(command)

    return Broken


def moves(seconds):
    """Something else than the call moves the clock."""
    return lambda host, command: setattr(host, "time_s", host.time_s + seconds)


def off(*_):
    raise OSError("the bench is off")


def nothing(n, harm=0.0, obstacle=None):
    harms = np.full((n, 2), harm)
    return Impacts(harms, harms, np.zeros((n, 2), np.int64), *Impacts.no_obstacle(obstacle or n))


def first_nan(values):
    values = values.copy()
    values[3, 1] = np.nan
    return values


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Loses, "world 0 loses a step: its clock went from 1.9 s to 1.9 s, but should be at 2 s (tolerance 0.05 s)"),
        (broken(does=moves(-0.3)), "world 0 goes back: its clock went from 2 s to 1.8 s, but should be at 2.1 s"),
        (broken(does=moves(0.1)), "world 0 skips: its clock went from 2 s to 2.2 s, but should be at 2.1 s"),
        (broken(does=off), "apply raised OSError: the bench is off (test_hosts.py, line "),
        (broken(tells=off), "state raised OSError: the bench is off (test_hosts.py, line "),
        (broken(tells=lambda t: t._replace(speeds_mps=first_nan(t.speeds_mps))), "speeds_mps[3, 1] is nan; every"),
        (broken(tells=lambda t: t._replace(time_s=math.inf)), "time_s[0] is inf; every number must be finite"),
        (
            broken(tells=lambda t: t._replace(gaps_m=t.gaps_m[1:])),
            "gaps_m has shape (19, 2); must have shape (20, 2): (worlds, vehicles or pairs)",
        ),
        (broken(tells=lambda t: t._replace(speeds_mps=[[1.0], [1.0, 2.0]])), "state raised ValueError: "),
        (broken(tells=lambda t: t[:2]), "state raised TypeError: "),
        (broken(tells=lambda t: t._replace(impacts="two")), "impacts is of type str; must be None, or as"),
        (broken(tells=lambda t: t._replace(impacts=3)), "impacts is of type int; "),
        (broken(tells=lambda t: t._replace(impacts=nothing(20, obstacle=21))), "impacts.obstacle_first_harm must have"),
        (broken(tells=lambda t: t._replace(impacts=nothing(20, math.inf))), "impacts.first_impact_harm must have"),
        (broken(tells=lambda t: t._replace(speeds_mps=np.ma.masked_less(t.speeds_mps, 99))), "speeds_mps[0, 0] is nan"),
    ],
)
def test_host__that_goes_wrong_is_told_and_the_ledger_is_kept(make, message):
    worlds, driver = PAPER.sample(20, 7).worlds, eb.make_agent("full_brake")
    with pytest.raises(HostFailed) as failed:
        drive_host(make(worlds), driver, PAPER, worlds)
    assert f" s: {message}" in str(failed.value) and str(failed.value).startswith(f"host {make.__name__} at ")
    whole = drive_host(Bench(worlds), driver, PAPER, worlds).outcome.ledger
    kept = failed.value.ledger
    assert failed.value.worlds.time_s.min() >= 1.8 and (failed.value.worlds.pair_hit == (kept.count > 0)).all()
    assert 0 < kept.impacts.sum() <= whole.impacts.sum()
    assert (kept.total_harm <= whole.total_harm).all() and kept.total_harm.any()


# Hosts that say what is impossible: nothing may be reported of them as if it had happened.


class Deaf(Bench):
    """Goes on as if vehicles had not met."""

    def apply(self, command):
        super().apply(command._replace(speeds_mps=self.speeds))


class Forgets(EngineHost):
    """Resolves impacts by itself, and reports none."""

    def state(self):
        return super().state()._replace(impacts=None)


class ForgetsInSteps(Forgets):
    dt = 0.05


class ReportsNothing(EngineHost):
    """Resolves impacts by itself, and reports that there were none."""

    def state(self):
        return super().state()._replace(impacts=nothing(self.worlds.n))


class Coasts(Bench):
    """No vehicle follows a command."""

    ignores = slice(None)

    def apply(self, command):
        acceleration = command.acceleration_mps2.copy()
        acceleration[:, self.ignores] = 0.0
        super().apply(command._replace(acceleration_mps2=acceleration))


class OneCoasts(Coasts):
    ignores = 1


class Frozen(Bench):
    """Moves nothing but its clock."""

    def apply(self, command):
        self.time_s += self.dt


class Stops(Bench):
    """Whoever brakes stands at once."""

    def apply(self, command):
        super().apply(command._replace(speeds_mps=np.where(command.acceleration_mps2 < 0.0, 0.0, command.speeds_mps)))


class Flies(Bench):
    def state(self):
        told = super().state()
        return told._replace(speeds_mps=told.speeds_mps + (1e9 if self.time_s > 1.0 else 0.0))


class FliesOnceHit(EngineHost):
    def state(self):
        told = super().state()
        hit = self.worlds.pair_hit.any(axis=1, keepdims=True)
        return told._replace(speeds_mps=told.speeds_mps + 1e9 * hit)


class Leaps(Bench):
    """Puts 3 m between two vehicles in one step."""

    def state(self):
        return super().state()._replace(gaps_m=self.gaps + (3.0 if self.time_s > 1.0 else 0.0))


class Drifts(Bench):
    """Its gaps grow by a centimetre in each step of a hundredth of a second."""

    def state(self):
        return super().state()._replace(gaps_m=self.gaps + self.time_s)


STEP = r" goes from \S+ to \S+ m/s within \S+ s, but its command of \S+ m/s2 allows \S+ to \S+ m/s; begin each step"
GAP = r"the gap between vehicle_\d and vehicle_\d of world \d+ is \S+ m at \S+ s, but must be \S+ to \S+ m by the"
SPEED = r"of world \d+ drives at \S+ m/s at \S+ s, but should drive at \S+ to \S+ m/s; the host must"


@pytest.mark.parametrize("dt", [0.1, 0.01])
@pytest.mark.parametrize(
    ("make", "agent", "message"),
    [
        (Deaf, "full_brake", STEP),
        (Forgets, "full_brake", STEP),
        (ForgetsInSteps, "full_brake", STEP),
        (ReportsNothing, "full_brake", STEP),
        (Coasts, "full_brake", rf"vehicle_1 {SPEED}"),
        (OneCoasts, "full_brake", rf"vehicle_2 {SPEED}"),
        (OneCoasts, "constant:1.5", rf"vehicle_2 {SPEED}"),
        (OneCoasts, "constant:-1.5", rf"vehicle_2 {SPEED}"),
        (Frozen, "full_brake", GAP),
        (Stops, "full_brake", rf"vehicle_1 .*{STEP}"),
        (Flies, "full_brake", rf"vehicle_1 of world 0 goes from \S+ to 1e\+09 m/s within {'{dt}'} s, but"),
        (FliesOnceHit, "full_brake", r"vehicle_\d of world \d+ goes from \S+ to 1e\+09 m/s"),
        (Leaps, "full_brake", GAP),
        (Drifts, "full_brake", GAP),
    ],
)
def test_host__that_moves_as_nothing_can_is_refused_by_name(make, agent, message, dt):
    worlds = PAPER.sample(20, 7).worlds
    host = make(worlds, dt) if issubclass(make, Bench) else make(worlds)
    with pytest.raises(HostFailed) as failed:
        drive_host(host, eb.make_agent(agent), PAPER, worlds)
    assert re.match(rf"host {make.__name__} at \d\.\d\d s: ", str(failed.value))
    assert re.search(message.replace("{dt}", f"{dt:g}"), str(failed.value)), str(failed.value)
    assert "\n" not in str(failed.value) and failed.value.worlds.n == 20


# Hosts that are a little off, as simulators and test benches are: all of them are driven to the end.


class Euler(Bench):
    """Moves by the speed at the end of a step."""

    def apply(self, command):
        super().apply(command)
        self.gaps = self.gaps + self.dt / 2 * np.diff(command.speeds_mps - self.speeds, axis=1)


class EngineSteps(EngineHost):
    """Resolves impacts by itself and reports them, in steps of its own; keeps latencies by itself."""

    def __init__(self, worlds, dt):
        super().__init__(worlds)
        self.dt = dt


class Sluggish(Bench):
    """Brakes and engines are late by 0.3 s, and a seventh too weak."""

    force = 0.0

    def apply(self, command):
        self.force = self.force + self.dt / (0.3 + self.dt) * (command.acceleration_mps2 / 1.17 - self.force)
        stands = np.maximum(self.force, -np.maximum(command.speeds_mps, 0.0) / self.dt)
        super().apply(command._replace(acceleration_mps2=stands))


class Drags(Bench):
    """Loses 0.4 m/s2 on the way."""

    def apply(self, command):
        drag = np.minimum(0.4, np.maximum(command.speeds_mps / self.dt + command.acceleration_mps2, 0.0))
        super().apply(command._replace(acceleration_mps2=command.acceleration_mps2 - drag))


class Noisy(Bench):
    """Reads gaps and speeds to a decimetre."""

    def state(self):
        off = 0.0 if self.time_s == 0.0 else np.random.default_rng(round(1e3 * self.time_s)).uniform(-0.1, 0.1)
        alternating = off * (-1.0) ** np.arange(self.speeds.shape[1])
        return super().state()._replace(gaps_m=self.gaps + off, speeds_mps=self.speeds + alternating)

    def apply(self, command):
        super().apply(command._replace(speeds_mps=self.speeds + command.speeds_mps - self.state().speeds_mps))


class RealTime(Bench):
    """Its steps are up to half a step longer or shorter, and its clock says so."""

    def apply(self, command):
        dt, self.steps = self.dt, getattr(self, "steps", 0) + 1
        self.dt = dt * (self.steps + 0.49 * math.sin(1e3 * self.steps)) - self.time_s
        super().apply(command)
        self.dt = dt


class Shuffled:
    """Drives at random, so that its commands change as much as they can."""

    name = "shuffled"

    def act(self, worlds, vehicle):
        v, number = worlds.vehicles, round(1e3 * float(worlds.time_s.max()))
        share = np.random.default_rng((number, vehicle)).uniform(-1.0, 1.0, worlds.n)
        capacity = np.where(share < 0.0, v.braking_capacity_mps2[:, vehicle], v.driving_capacity_mps2[:, vehicle])
        return share * capacity


@pytest.mark.parametrize("dt", [0.1, 0.02])
@pytest.mark.parametrize("make", [EngineSteps, Euler, Sluggish, Drags, Noisy, RealTime])
def test_host__that_is_a_little_off_is_driven_to_the_end(make, dt):
    scenario = eb.load_scenario("stress-wide")
    worlds = scenario.sample(10, 7).worlds
    for agent in (eb.make_agent("full_brake"), eb.make_agent("coast"), Shuffled()):
        outcome = drive_host(make(worlds, dt), agent, scenario, worlds).outcome
        assert outcome.ledger.collided.any()


@pytest.mark.parametrize(
    ("host", "message"),
    [
        (
            object(),
            "host object: has no dt and no state and no apply; docs/extensions/hosts.md shows what a host needs",
        ),
        (Bench(PAPER.sample(20, 7).worlds, 0.03), "host: dt = 0.03 s: the time between decisions, 0.1 s, must be"),
        (Bench(PAPER.sample(20, 7).worlds, 0.2), "host: dt = 0.2 s: the time between decisions, 0.1 s, must be"),
        (Bench(PAPER.sample(20, 7).worlds, math.nan), "host: dt = nan: the step length must be a number"),
        (Bench(PAPER.sample(20, 7).worlds, "0.1"), "host: dt = '0.1': the step length must be a number"),
        (Bench(PAPER.sample(20, 8).worlds), "in worlds; the host must start with the gaps and speeds of worlds"),
    ],
)
def test_host__that_does_not_fit_is_refused_before_anything_moves(host, message):
    with pytest.raises(eb.EthBrakeError) as refused:
        drive_host(host, eb.make_agent("full_brake"), PAPER, PAPER.sample(20, 7).worlds)
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("scenario", "agent", "message"),
    [
        ("paper-random", "full_brake", "host: 'str' is not an agent, because it has no name and no act; to make"),
        ("paper-random-obstacle", None, "host: scenario 'paper-random-obstacle' has an obstacle ahead (obstacle_gap"),
        (
            "paper-random-buildup",
            None,
            "host: the result would not be exact, because brakes in world 0 build up at a finite rate",
        ),
        (PAPER.with_learners([]), None, "host: scenario 'paper-random' has no learner; give one with a learner"),
        (PAPER, PAPER, "is not an agent"),
    ],
)
def test_host__of_what_it_cannot_know_is_refused(scenario, agent, message):
    scenario = eb.load_scenario(scenario)
    worlds = scenario.sample(5, 7).worlds
    with pytest.raises(eb.EthBrakeError) as refused:
        drive_host(Bench(worlds), agent or eb.make_agent("full_brake"), scenario, worlds)
    assert message in str(refused.value)
    with pytest.raises(eb.EthBrakeError, match=r"host: worlds = .* must be a Worlds object"):
        drive_host(Bench(worlds), eb.make_agent("full_brake"), scenario, scenario.sample(5, 7))


# What a loop of one's own needs, without `drive_host`.


def test_running__worlds_go_on_as_if_they_had_never_left_the_engine():
    engine, other = (eb.make_engine(PAPER, 50, seed=7) for _ in range(2))
    for _ in range(12):
        engine.step(np.full((50, 1), -0.6))
    now = engine.worlds
    again = PAPER.sample(50, 7, channel="training").worlds.running(
        now.time_s, now.gaps_m, now.speeds_mps, command_mps2=now.command_mps2, pair_hit=now.pair_hit
    )
    other.place(again, engine.ledger)
    for _ in range(5):
        one, two = (each.step(np.full((50, 1), 0.3)) for each in (engine, other))
        assert np.array_equal(one.reward, two.reward) and np.array_equal(one.ended, two.ended)
    assert same(engine.ledger, other.ledger)
    assert np.array_equal(engine.worlds.gaps_m, other.worlds.gaps_m) and engine.ledger.collided.any()


def test_running__worlds_that_cannot_be_are_refused():
    alert, engine = PAPER.sample(3, 7).worlds, eb.make_engine(PAPER, 2)
    with pytest.raises(eb.EthBrakeError, match=r"gaps_m\[0, 1\] = -1: must be finite and in \[0, inf\]"):
        alert.running(1.0, [1.0, -1.0], 3.0)
    with pytest.raises(eb.EthBrakeError, match="place: got 3 worlds of 3 vehicles; 2 worlds of 3"):
        engine.place(alert)


@pytest.mark.parametrize("front", ["full_brake", "constant:2"])
def test_agent__is_told_in_public_who_else_drives(front):
    """A planner looks ahead with the scripts that `begin` is given, and decides otherwise where they brake less."""
    worlds = PAPER.sample(50, 7).worlds
    scripts = {0: eb.make_agent(front), 2: eb.make_agent("full_brake")}
    agent = eb.make_agent("e_v2x_bm", scenario=PAPER)
    memory = agent.begin(worlds, 1, scripts)
    command, _ = agent.act(worlds.running(0.5, worlds.gaps_m, worlds.speeds_mps), memory, 1)
    scenario = PAPER.replace(roles={"vehicle_1": front, "vehicle_2": "learner", "vehicle_3": "full_brake"})
    motion = eb.evaluate(worlds, {"a": agent}, scenario=scenario, aftermath=False).outcome("a")
    assert np.array_equal(memory["predicted_harm"], motion.predicted_harm) and (command <= 0.0).all()
