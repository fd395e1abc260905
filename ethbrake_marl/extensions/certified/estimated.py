"""The estimated world of one vehicle: the information that the vehicle received, completed from the scenario's ranges.

A vehicle is *known* if its message has arrived or it is in sight. The estimate combines these sources:

* A known vehicle is the source of its capacities, its mass, its own latency, and the newest state that was received
  from it. The estimate extrapolates this state to the present. If a command was in force at the time of this state, the
  vehicle is assumed to follow its script from that time on. Otherwise, the vehicle is assumed to coast until the time
  at which it is expected to react.
* The scenario is the source for a vehicle that is not known. Each quantity of an unknown vehicle is the median of its
  distribution, or a chosen value of its range. An unknown vehicle is assumed to follow its script from the alert on.
* The scenario is also the source for each quantity that the messages of a known vehicle lack (``v2x: tells``). The
  received position of a vehicle is used only if its speed was received, too. The received command of a vehicle is used
  only if its position and speed were received, too. A received intent (announced command) is not used, because the
  script already predicts what the vehicle does.
* The estimating vehicle measures its own state, its distance since the alert, and its impacts with known neighbours.

The estimate reads nothing else of the true world, so information that was not received cannot change the estimate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.agents.protocol import fixed_commands
from ethbrake_marl.first_edition.agents.received import Received, places_of
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.physics.estimates import move_on
from ethbrake_marl.first_edition.physics.messages import BRAKING_CAPACITY, LATENCY, MASS
from ethbrake_marl.first_edition.physics.motion import has_acted
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Vehicles, Worlds
from ethbrake_marl.first_edition.scenario.sampling import middle_world
from ethbrake_marl.first_edition.scenario.schema import Scenario

TOUCHING_M = 1e-9  # a gap below this counts as contact, because received positions are rounded

OF_OTHERS = (
    "place",
    "speeds_mps",
    "braking_capacity_mps2",
    "mass_t",
    "latency_s",
    "news_s",
)  # quantities that may be uncertain


@dataclass(frozen=True, slots=True)
class Ranges:
    """Ranges that a scenario declares for quantities of the vehicles that the estimating vehicle does not know.

    Keys of the mappings ``middle``, ``low`` and ``high``: ``place`` (position relative to the estimating vehicle at the
    alert, m), ``speeds_mps``, ``braking_capacity_mps2``, ``mass_t``, ``latency_s`` (latency without the delay of the
    alert message, s) and ``news_s`` (time at which a vehicle has received the alert and may react, s; 0 without a
    channel).

    The argument ``share`` of the methods gives, for some pairs (quantity, vehicle index), the position of the value in
    its range: 0 is the smallest value, 1 the largest. Every other unknown quantity gets its median. If ``share`` is
    None, every unknown quantity gets its median.
    """

    vehicle: int  # index of the estimating vehicle
    others: Mapping[int, Script]  # scripts of the other vehicles, by index; a vehicle without a script brakes fully
    middle: Mapping[str, Floats]  # median of each quantity, [N]
    low: Mapping[str, Floats]  # smallest value of each quantity, [N]
    high: Mapping[str, Floats]  # largest value of each quantity, [N]
    obstacle_gap_m: float  # gap of vehicle_1 to the obstacle, m; infinite without an obstacle

    @classmethod
    def of(cls, scenario: Scenario, vehicle: int, others: Mapping[int, Script] | None = None) -> Ranges:
        """Return the ranges that ``scenario`` declares, for the estimates of the vehicle with index ``vehicle``.

        ``others`` contains the scripts of the other vehicles by vehicle index; None: the scripts of the scenario.
        Raises ``InvalidInput`` for a mixture of scenarios, because an unknown vehicle could belong to any scenario of
        the mixture.
        """
        if scenario.members:
            names = ", ".join(member.name for member in scenario.members)
            raise InvalidInput(
                f"scenario {scenario.name!r} is a mixture of scenarios, but estimated agents and shields need the"
                f" ranges of one scenario; give one of {names}"
            )
        world = middle_world(scenario)
        low, high = ({key: np.array(scenario.bounds(key)).T[k] for key in ("gaps_m", *OF_OTHERS[1:5])} for k in (0, 1))
        named = ("braking_capacity_mps2", "driving_capacity_mps2", "mass_t", "speed_limit_mps")
        one, N = np.ones((1, scenario.vehicles)), scenario.vehicles
        heard = Vehicles.at_once(
            one, one, np.zeros((1, N)), one, one, np.zeros(1)
        )  # no latency except that of the alert message
        if scenario.v2x.by_link:
            heard = scenario.v2x.with_news(heard, np.full((1, scenario.v2x.width(N)), 0.5), scenario.equipped())
        middle = {
            "place": _places(world.gaps_m[0], world.gaps_m[0], vehicle),
            "speeds_mps": world.speeds_mps[0],
            **{key: getattr(world.vehicles, key)[0] for key in named},
            "latency_s": world.vehicles.own_latency_s[0],
            "news_s": heard.latency_s[0],
        }
        low["place"] = _places(low["gaps_m"], high["gaps_m"], vehicle)
        high["place"] = _places(high["gaps_m"], low["gaps_m"], vehicle)
        low["news_s"] = np.zeros(scenario.vehicles)
        high["news_s"] = scenario.v2x.latest_reaction_s(low["news_s"], scenario.equipped())
        others = script_agents(scenario, except_for=vehicle) if others is None else others
        return cls(vehicle, others, middle, low, high, float(world.obstacle_gap_m[0]))

    def at(self, share: Mapping[tuple[str, int], float] | None, key: str) -> Floats:
        """Return the quantity ``key`` (a key of ``middle``) of every vehicle, [N]: the median, or the value at the
        position that ``share`` gives.
        """
        value = self.middle[key].copy()
        for (name, j), part in () if share is None else share.items():
            if name == key:
                value[j] = self.low[key][j] + part * (self.high[key][j] - self.low[key][j])
        return value

    @property
    def uncertain(self) -> tuple[tuple[str, int], ...]:
        """The quantities of the other vehicles for which the scenario declares a range instead of one value, as pairs
        (quantity, vehicle index).
        """
        others = [j for j in range(len(self.middle["place"])) if j != self.vehicle]
        return tuple((key, j) for j in others for key in OF_OTHERS if self.low[key][j] < self.high[key][j])

    def estimate(
        self,
        worlds: Worlds,
        way_m: Floats,
        share: Mapping[tuple[str, int], float] | None = None,
        foretold: tuple[Worlds, Bools] | None = None,
    ) -> Worlds:
        """Return the estimated worlds of the estimating vehicle at the present time, [n].

        Raises ``InvalidInput`` if brakes build up.

        Args:
            worlds: the true worlds; only the information that the vehicle received is read.
            way_m: [n] distance that the estimating vehicle has travelled since the alert, m.
            share: positions of unknown quantities in their ranges, as the class docstring explains.
            foretold: the predicted present worlds, including impacts, and a mask [n, N]: True for a vehicle whose
                predicted state replaces the state in its last message. None: the estimate uses no prediction.

        """
        worlds.refuse_build_up(":estimated")
        vehicle, (n, N) = self.vehicle, worlds.speeds_mps.shape
        known, own, v = Received.by(worlds, vehicle), np.arange(N) == vehicle, worlds.vehicles
        reported = {"mass_t": v.mass_t, "braking_capacity_mps2": v.braking_capacity_mps2,
                    "driving_capacity_mps2": v.driving_capacity_mps2, "speed_limit_mps": v.speed_limit_mps}  # fmt: skip
        some, pieces = known.pieces.any(axis=2), known.pieces
        has = {"mass_t": pieces[..., MASS], "speed_limit_mps": some}
        of = {
            key: np.where(has.get(key, pieces[..., BRAKING_CAPACITY]), values, self.at(share, key))
            for key, values in reported.items()
        }
        at_s = np.where(known.known, known.at_s, 0.0)
        own_part = np.where(pieces[..., LATENCY], v.own_latency_s, self.at(share, "latency_s"))
        latency = np.where(known.reacts, at_s, np.maximum(np.maximum(own_part, self.at(share, "news_s")), at_s))
        past = v.latency_s[:, vehicle] <= worlds.time_s
        latency[:, vehicle] = np.where(
            past, v.latency_s[:, vehicle], np.maximum(v.own_latency_s[:, vehicle], worlds.time_s)
        )
        vehicles = Vehicles.at_once(
            of["braking_capacity_mps2"], of["driving_capacity_mps2"], latency, of["mass_t"], of["speed_limit_mps"],
            v.restitution, harm_weight=v.harm_weight,
        )  # fmt: skip
        place = np.where(known.known, known.place_m, self.at(share, "place") - way_m[:, np.newaxis])
        speed = np.maximum(np.where(known.known, known.speed_mps, self.at(share, "speeds_mps")), 0.0)
        usual_gaps = np.repeat(-np.diff(self.middle["place"])[np.newaxis], n, axis=0)
        line = replace(
            worlds, vehicles=vehicles, speeds_mps=np.minimum(speed, of["speed_limit_mps"]), pair_hit=known.hit,
            command_mps2=np.zeros((n, N)), gaps_m=usual_gaps, messages=np.zeros((n, 0)),
            obstacle_hit=known.obstacle_hit, road=np.zeros((n, 0)),
        )  # fmt: skip
        command = fixed_commands(self.others, line, "estimated", vehicle=vehicle)
        speed, way = move_on(
            line.speeds_mps, command, latency - at_s, of["speed_limit_mps"], worlds.time_s[:, None] - at_s
        )
        speed[:, vehicle], way[:, vehicle] = line.speeds_mps[:, vehicle], 0.0
        place, hit = place + way, known.hit
        if foretold is not None:
            (expected, keeps), hit = foretold, hit | foretold[0].pair_hit
            place = np.where(keeps, places_of(expected, vehicle), place)
            speed = np.where(keeps, np.maximum(expected.speeds_mps, 0.0), speed)
        place = _in_order(place, known.known, vehicle)
        gaps = np.maximum(place[:, :-1] - place[:, 1:], 0.0)
        usual_obstacle = self.obstacle_gap_m + self.middle["place"][0] - way_m
        obstacle = np.where(np.isfinite(known.obstacle_m), known.obstacle_m, usual_obstacle)
        command[:, own] = worlds.command_mps2[:, own]
        return replace(
            line,
            pair_hit=hit,
            speeds_mps=speed,
            gaps_m=np.where(gaps < TOUCHING_M, 0.0, gaps),
            command_mps2=np.where(has_acted(latency, worlds.time_s[:, np.newaxis]), command, 0.0),
            obstacle_gap_m=np.maximum(obstacle - place[:, 0], 0.0),
        )


def _places(ahead_m: Floats, behind_m: Floats, vehicle: int) -> Floats:
    """Return the position of each vehicle relative to ``vehicle``, [N] m: positive ahead, negative behind.

    ``ahead_m`` and ``behind_m`` [P] are gaps of the pairs, m; only the gaps in front of ``vehicle`` are read from
    ``ahead_m``, and only the gaps behind ``vehicle`` from ``behind_m``.
    """
    front = np.cumsum(ahead_m[:vehicle][::-1])[::-1]
    return np.concatenate([front, [0.0], -np.cumsum(behind_m[vehicle:])])


def _in_order(place: Floats, known: Bools, vehicle: int) -> Floats:
    """Correct estimated positions so that no vehicle is ahead of the vehicle in front of it; return the positions, [n,
    N] m.

    ``place`` [n, N] is the position of each vehicle relative to ``vehicle``, m; the function changes this array in
    place. ``known`` [n, N] is True for vehicles whose position is certain; these positions do not change.
    """
    N = place.shape[1]
    for way in (-1, 1):  # first the vehicles ahead, then the vehicles behind
        side = np.arange(vehicle + way, -1 if way < 0 else N, way)
        limit = np.full(len(place), np.inf)
        for j in side[::-1]:  # from the far end: at most as far away as the next known vehicle beyond it
            far = np.where(known[:, j], -way * place[:, j], np.minimum(-way * place[:, j], limit))
            limit = np.where(known[:, j], np.minimum(far, limit), limit)
            place[:, j] = -way * far
        near = np.zeros(len(place))
        for j in side:
            near = np.maximum(near, -way * place[:, j])
            place[:, j] = -way * near
    return place
