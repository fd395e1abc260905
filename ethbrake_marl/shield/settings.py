"""Checks of what a shield is built with: amounts, scenario, policy, environment."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from numbers import Real

import numpy as np

from ethbrake_marl.agents.learned import LearnedAgent, LearnedPolicy
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.team import Team
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput, check_one_learner
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.scenario import Scenario


def is_amount(value: object, below: float = np.inf) -> bool:
    """Whether this is a number, at least 0 and ``below`` that."""
    return isinstance(value, Real) and not isinstance(value, bool) and 0.0 <= float(value) < below


def check_amount(name: str, value: object, where: str, unit: str = "") -> None:
    """Raise ``InvalidInput`` for what is not a finite number, at least 0."""
    if not is_amount(value):
        raise InvalidInput(f"{where}: {name} = {value!r}: must be a number, at least 0{unit}")


def check_scenario(scenario: object, where: str) -> None:
    """Raise ``InvalidInput`` for what is not a ``Scenario``, its name among that."""
    if not isinstance(scenario, Scenario):
        raise InvalidInput(f"{where}: scenario = {scenario!r}: must be a Scenario; eb.load_scenario(name) loads one")


def proposing_agent(policy: object, where: str) -> Agent:
    """An agent as it is, a loaded policy as an agent. Raises ``InvalidInput`` for anything else."""
    if not isinstance(policy, type):
        if isinstance(policy, Agent):
            return policy
        if callable(policy) and isinstance(getattr(policy, "observation", None), ObservationSpec):
            return LearnedAgent(policy)  # type: ignore[arg-type]  # it is callable, and says what it observes
    raise InvalidInput(
        f"{where}: policy = {policy!r}: must be an agent or a policy (eb.load_policy), which says what it observes"
    )


def checked_vehicles(vehicle: object, scenario: Scenario) -> int | tuple[int, ...]:
    """An index as it is, several as a tuple; ``InvalidInput`` unless they are there, each once, front to rear."""
    several = isinstance(vehicle, Sequence) and not isinstance(vehicle, str)
    each = tuple(vehicle) if isinstance(vehicle, Sequence) and several else (vehicle,)
    known = range(scenario.vehicles)
    if not each or not all(isinstance(i, int | np.integer) and not isinstance(i, bool) and i in known for i in each):
        raise InvalidInput(f"shield: vehicle = {vehicle!r}: must be an index from 0 to {scenario.vehicles - 1}")
    if list(each) != sorted(set(each)):
        raise InvalidInput(f"shield: vehicle = {vehicle!r}: several are named front to rear, each once")
    return tuple(map(int, each)) if several else int(each[0])


def policies_of(
    policy: Agent | Mapping[int, Agent] | None, vehicle: int | tuple[int, ...]
) -> Mapping[int, Agent] | None:
    """Who proposes, by vehicle, front to rear. Raises ``InvalidInput`` for another one than is shielded."""
    if policy is None:
        return None
    vehicles = (vehicle,) if isinstance(vehicle, int) else vehicle
    given = policy if isinstance(policy, Mapping) else dict.fromkeys(vehicles[:1], policy)
    if set(given) != set(vehicles):
        raise InvalidInput(f"shield: policies for vehicles {sorted(given)}, shielded are {list(vehicles)}")
    return {i: given[i] for i in vehicles}


def engine_of(env: object, interface: type, where: str, maker: str) -> Engine:
    """The engine of one of this package's environments, whatever wraps it.

    Raises ``InvalidInput`` for another interface, and where a shield follows that engine already.
    """
    engine = getattr(getattr(env, "unwrapped", env), "engine", None)
    for watcher in engine.watchers if isinstance(engine, Engine) else ():
        if (options := getattr(watcher, "options", None)) is not None:
            raise InvalidInput(
                f"{where}: a {options.where} (mode {options.mode}) shields this environment already, and its bound"
                " holds for one shield alone; give that one other options, or close() it first"
            )
    if not (isinstance(env, interface) and isinstance(engine, Engine)):
        raise InvalidInput(f"{where}: {env} is not one of this package's environments ({maker})")
    return engine


def shielded_vehicles(engine: Engine, where: str, mode: str | None) -> int | tuple[int, ...]:
    """Index of the learner, which is shielded, or indices of all of them, front to rear.

    Raises ``InvalidInput`` when there is none, or more than one in another mode than ``step``.
    """
    if mode == "step" and len(engine.learners) > 1:
        return tuple(sorted(engine.learners))
    if not engine.learners:
        raise InvalidInput(
            f"{where}: no vehicle of scenario {engine.scenario.name!r} learns, so there is nobody to shield; pass"
            " learners=['vehicle_2'] to the environment"
        )
    check_one_learner(
        engine.scenario.name,
        [engine.scenario.vehicle_names[i] for i in engine.learners],
        f"{where} needs exactly one learner in mode {mode}: what it certifies is known only if every other vehicle"
        " follows a script; mode step shields several together; or pass learners=['vehicle_2'] to the environment",
    )
    return engine.learners[0]


def proposing_agents(
    policy: Agent | LearnedPolicy | Team | Mapping[str, Agent | LearnedPolicy], vehicles: Sequence[int], where: str
) -> dict[int, Agent]:
    """Who proposes for each shielded vehicle: a team, policies by name of vehicle, or copies of one for all.

    Raises ``InvalidInput`` for what is none of these, a team of other vehicles, and one agent given for two of them,
    which may remember its episodes.
    """
    if isinstance(policy, Team):
        given: dict[int, Agent] = policy.drivers
    elif isinstance(policy, Mapping):
        by_name = {f"vehicle_{i + 1}": i for i in vehicles}
        given = {by_name.get(name, -1): proposing_agent(each, where) for name, each in policy.items()}
    else:
        agent = proposing_agent(policy, where)
        return {i: agent if k == 0 else copy.deepcopy(agent) for k, i in enumerate(vehicles)}
    if set(given) != set(vehicles):
        names = ", ".join(f"vehicle_{i + 1}" for i in vehicles)
        raise InvalidInput(f"{where}: policy: one for each of {names} is needed, and for nobody else")
    if len({id(agent) for agent in given.values()}) < len(given):
        raise InvalidInput(f"{where}: policy: one object drives two vehicles; alone it is copied for each of them")
    return {i: given[i] for i in vehicles}
