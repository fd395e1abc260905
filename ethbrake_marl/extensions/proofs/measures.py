"""The measures ``contact_avoidable`` and ``proven_harm``: what the proofs say of each world.

They are computed only on request, because a proof is slow.
"""

from __future__ import annotations

import numpy as np

from ethbrake_marl.episode.counts import FIRST_IMPACTS
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.measures import MeasureValue, Statistic
from ethbrake_marl.extensions.proofs.avoidability import avoidability
from ethbrake_marl.extensions.proofs.lower_bound import LowerBound, lower_bound
from ethbrake_marl.motion.forces import capacities
from ethbrake_marl.motion.layout import BRAKING
from ethbrake_marl.registry import Part


def contact_avoidable(game: Game, alert: State, last: State) -> MeasureValue:
    """Whether some commands avoid all contact (proven), and if not, why: ``early``, ``front`` or ``rear``.

    The proof covers lines of three vehicles in which Vehicle 2 learns, or Vehicles 2 and 3, and lines of two vehicles
    in which one learns. All others must brake fully. The result is the same for every agent.
    """
    verdict = avoidability(alert, _controlled_body(game, alert, together=True))
    return {"": verdict.avoidable, "reason": verdict.reason_name}


_last_bound: list[tuple[bytes, LowerBound]] = []  # the last request, and its bounds


def proven_harm(game: Game, alert: State, last: State) -> MeasureValue:
    """Lower bound on the harm or honest cost, whatever the controlled vehicle commands at its decisions, [n] m2/s2.

    ``impact``: whether the bound is above 0. The result is the same for every agent.
    """
    bound = _bound(game, alert)
    return {"": bound.harm, "impact": bound.impact_proven}


def _bound(game: Game, alert: State) -> LowerBound:
    body, settings = _controlled_body(game, alert), game.settings
    ends = np.array([body, settings.horizon_s, settings.time_step_s])
    departures = " ".join(sorted(alert.departures)).encode()  # a stored bound must not pass worlds that are refused
    request = departures + ends.tobytes() + alert.line.tobytes() + alert.car.tobytes()
    for last_request, last_bound in _last_bound:
        if last_request == request:
            return last_bound
    bound = lower_bound(
        alert, body, harm_count=FIRST_IMPACTS, horizon_s=settings.horizon_s, time_step_s=settings.time_step_s
    )
    _last_bound[:] = [(request, bound)]
    return bound


def _controlled_body(game: Game, alert: State, *, together: bool = False) -> int:
    """The only learner of the game, or 2 if Vehicles 2 and 3 learn and may be controlled ``together``.

    Raises ``InvalidInput`` for any other learners, and if a vehicle that does not learn does not brake fully.
    """
    learners = game.settings.learners.tolist()
    scripted_bodies = [body for body in range(1, alert.vehicles + 1) if body not in learners]
    if game.scripts or (alert.wanted[:, scripted_bodies] != -capacities(alert.car, BRAKING)[:, scripted_bodies]).any():
        raise InvalidInput(
            "contact_avoidable, proven_harm: a vehicle that does not learn does not brake fully; all others must"
        )
    if len(learners) != 1 and not (together and learners == [2, 3]):
        names = ", ".join(f"vehicle_{body}" for body in learners)
        raise InvalidInput(f"contact_avoidable, proven_harm: {names} learn; the proofs cover one controlled vehicle")
    return int(learners[0])


CONTACT_AVOIDABLE = Part(
    contact_avoidable,
    statistics=(Statistic("contact_avoidable_rate", "rate", "Contact avoidable", "Contact\navoidable"),),
)
PROVEN_HARM = Part(
    proven_harm, unit="m2/s2",
    statistics=(
        Statistic("proven_harm", "mean", "Proven harm", "Proven\nharm"),
        Statistic("impact_proven_rate", "rate", "Impact proven", "Impact\nproven", "impact"),
    ),
)  # fmt: skip
