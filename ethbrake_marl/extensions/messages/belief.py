"""What one vehicle knows and estimates: the state of the line according to its messages and sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ethbrake_marl.episode.plans import PLANS_KEY
from ethbrake_marl.episode.reach import within_reach
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.messages.links import (
    AT,
    INTENT,
    MESSAGE_NUMBER,
    MESSAGES_KEY,
    P_ACCELERATION,
    P_BRAKING,
    P_INTENT,
    P_LATENCY,
    P_MASS,
    P_PLACE,
    P_PLAN,
    P_SPEED,
    PIECES,
    PLAN,
    MessageMemory,
    estimated_line,
    newest_samples,
)
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    DRIVING,
    FORCE,
    LATENCY,
    MASS,
    OWN_LATENCY,
    RELEASE_RATE,
    SPEED,
    Bools,
    Floats,
)

LINE_PIECES = {SPEED: P_SPEED, FORCE: P_ACCELERATION}  # row of `State.line` -> the piece that it is
CAR_PIECES = {  # the same of `State.car`; all vehicles know the other rows, such as restitution, of all
    BRAKING: P_BRAKING,
    DRIVING: P_BRAKING,
    BRAKE_RATE: P_BRAKING,
    RELEASE_RATE: P_BRAKING,
    LATENCY: P_LATENCY,
    OWN_LATENCY: P_LATENCY,
    MASS: P_MASS,
}
LOOK_AHEAD = ("place", "speed", "braking_capacity", "latency", "mass")  # pieces that a simulation of the others needs


def known_pieces(state: State, observer: int) -> Bools:
    """Whether body ``observer`` knows each quantity in ``PIECES`` of each body, [n, N + 1, PIECES] (body 0: the
    obstacle).

    *Pieces* are the quantities that a message can contain. Of another vehicle the observer knows nothing before
    ``state.know`` and, with periodic messages, before it has a sample. Then it knows the pieces that this vehicle's
    messages contain (intent and plan only after its first message) and, if the vehicle is in sight,
    place, speed and acceleration. It knows all pieces of itself and of the obstacle.
    """
    memory: MessageMemory = state.memories[MESSAGES_KEY]
    time = state.time_s[:, np.newaxis]
    known = state.know[:, observer] <= time
    if memory.is_periodic:
        known &= memory.news[:, AT, observer] >= 0.0
    pieces = memory.contents.copy()
    has_message = (memory.links[:, MESSAGE_NUMBER, observer] > 0.0) | (memory.heard_s[:, observer] <= time)
    pieces[:, :, [P_INTENT, P_PLAN]] &= has_message[:, :, np.newaxis]
    pieces[:, :, [P_PLACE, P_SPEED, P_ACCELERATION]] |= (memory.seen_s[:, observer] <= time)[:, :, np.newaxis]
    pieces &= known[:, :, np.newaxis]
    pieces[:, [0, observer]] = True
    return pieces


def belief_of(state: State, observer: int) -> State:
    """State as the body ``observer`` estimates it. Unknown quantities are NaN, except gaps.

    Gaps add up to the distances between bodies with a known place. Old samples are extrapolated to the present
    (``links.estimate_worlds``). ``know`` is infinite for a body of which the observer knows nothing. ``wanted``
    contains the newest intents (commands) received, the memory ``plans`` the newest plans.
    """
    known = known_pieces(state, observer)
    news = newest_samples(state, observer)
    line, car = estimated_line(state, observer, known, news), state.car.copy()
    for rows, array in ((LINE_PIECES, line), (CAR_PIECES, car)):
        for row, piece in rows.items():
            array[:, row][~known[:, :, piece]] = np.nan
    wanted = np.where(known[:, :, P_INTENT], news[:, INTENT], np.nan)
    wanted[:, [0, observer]] = state.wanted[:, [0, observer]]  # the obstacle, and the observer itself
    state = _with_plans(state, known, news)
    return state._replace(
        line=line, car=car, know=_known_if(state, observer, np.asarray(known.any(axis=2))), wanted=wanted
    )


def predictable_belief_of(state: State, observer: int) -> State:
    """State as the body ``observer`` estimates it, without the vehicles that it cannot predict.

    The observer can predict a vehicle of which it knows all quantities, except perhaps intent and plan. ``know`` is
    infinite for all other bodies, and for those that cannot matter (``episode.reach``). If the observer knows something
    of a neighbour that it cannot predict, it cannot predict itself either: then its own ``know`` is infinite, too.
    """
    known, news = known_pieces(state, observer), newest_samples(state, observer)
    line = estimated_line(state, observer, known, news)
    predictable: Bools = np.asarray(known[:, :, :P_INTENT].all(axis=2))
    first, last = within_reach(belief_of(state, observer), observer).T[:, :, np.newaxis]
    bodies = np.arange(known.shape[1])
    matters = (bodies == 0) | ((first <= bodies) & (bodies <= last))
    is_neighbour = np.abs(bodies - observer) == 1
    unpredicted = known.any(axis=2) & ~predictable & matters & is_neighbour
    predictable[unpredicted.any(axis=1), observer] = False
    state = _with_plans(state, known, news)
    return state._replace(line=line, know=_known_if(state, observer, predictable & matters))


def _with_plans(state: State, known: Bools, news: Floats) -> State:
    """State with the newest plans that have been received, if messages tell plans."""
    if not state.memories[MESSAGES_KEY].contents[:, 1:, P_PLAN].any():
        return state
    plans = np.where(known[:, np.newaxis, :, P_PLAN], news[:, PLAN], np.nan)
    return state._replace(memories={**state.memories, PLANS_KEY: plans})


def _known_if(state: State, observer: int, holds: Bools) -> Floats:
    know = state.know.copy()
    know[:, observer][~holds] = np.inf
    return know


def ages_s(state: State) -> Floats:
    """Age of the newest sample that body i has of body j, [n, N + 1, N + 1] s; infinite if i has none.

    Body 0 is the obstacle. Without periodic messages all ages are 0: once body i knows of body j (time ``state.know``),
    it always knows the present state of j.
    """
    memory: MessageMemory = state.memories[MESSAGES_KEY]
    if not memory.is_periodic:
        return np.zeros(state.know.shape)
    at = memory.news[:, AT]
    ages = np.where(at >= 0.0, state.time_s[:, np.newaxis, np.newaxis] - at, np.inf)
    ages[:, np.arange(ages.shape[1]), np.arange(ages.shape[1])] = 0.0
    return ages


def require_pieces(
    state: State,
    observers: Sequence[int],
    who: str,
    needs: Sequence[str] = LOOK_AHEAD,
    senders: Sequence[int] | None = None,
) -> None:
    """Raise ``InvalidInput`` if messages lack a quantity that an agent needs.

    ``who``: words for the agent, which controls the vehicles ``observers``. ``needs``: names in ``PIECES``.
    ``senders``: vehicles whose messages are needed; None: all. An agent that controls one vehicle does not need that
    vehicle's messages; an agent of several needs the messages of its own vehicles, too.
    """
    senders = range(1, state.vehicles + 1) if senders is None else senders
    for sender in senders if MESSAGES_KEY in state.memories else ():
        contents = state.memories[MESSAGES_KEY].contents[:, sender]
        missing = [piece for piece in needs if not contents[:, PIECES.index(piece)].all()]
        if missing and tuple(observers) != (sender,):
            raise InvalidInput(
                f"{who}: messages of vehicle_{sender} do not contain its {missing[0]} (key v2x.tells), but"
                f" {', '.join(needs)} of the other vehicles are needed; add them to v2x.tells, or use a policy"
                " without a shield, which needs only its observation"
            )
