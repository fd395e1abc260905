"""Information that one vehicle has received about the other vehicles: who is known, and the newest state of each."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.messages import ACCELERATION, PLACE, SPEED, Messages
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Worlds


class Received(NamedTuple):
    """Information that one vehicle has received about the other vehicles up to the present time.

    Values in the columns of unknown vehicles have no meaning.
    """

    known: Bools  # [n, N] True for vehicles with known place and speed, and for the vehicle itself
    pieces: Bools  # [n, N, len(PIECES)] True for each known piece; all False for a vehicle without news
    at_s: Floats  # [n, N] time of the received state, s
    place_m: Floats  # [n, N] position at ``at_s`` relative to the receiving vehicle's present position
    speed_mps: Floats  # [n, N] speed at ``at_s``
    command_mps2: Floats  # [n, N] command in force at ``at_s``
    obstacle_m: Floats  # [n] distance of the obstacle from the vehicle's present position; infinite: no known obstacle
    obstacle_hit: Bools  # [n] True if an impact with the obstacle is known
    hit: Bools  # [n, P] True for a pair of the vehicle and a known neighbour that had an impact

    @property
    def reacts(self) -> Bools:
        """Mask [n, N]: True for a vehicle that is known to have a command in force."""
        reacts: Bools = self.known & self.pieces[..., ACCELERATION] & (self.command_mps2 != 0.0)
        return reacts

    @property
    def heard(self) -> Floats:
        """Amount of information about each vehicle, [n, N].

        The amount is 0 if nothing is known about the vehicle, 2 if its position and its speed are known, and otherwise
        1.
        """
        return self.pieces.any(axis=2).astype(np.float64) + self.known

    @classmethod
    def by(cls, worlds: Worlds, vehicle: int) -> Received:
        """Return the information that the vehicle with index ``vehicle`` has received up to the present time of
        ``worlds``.
        """
        n, N = worlds.speeds_mps.shape
        known = worlds.vehicles.known_from_s[:, vehicle] <= worlds.time_s[:, np.newaxis]
        known[:, vehicle] = True
        pieces = Messages.of(worlds).known_pieces(vehicle, worlds.time_s)
        pieces[:, vehicle] = True
        place = places_of(worlds, vehicle)
        hit = np.zeros((n, N - 1), np.bool_)
        at_s = np.repeat(worlds.time_s[:, np.newaxis], N, axis=1)
        received = cls(
            known, pieces, at_s, place, worlds.speeds_mps.copy(), worlds.command_mps2.copy(),
            worlds.obstacle_gap_m + place[:, 0], worlds.obstacle_hit.copy(), hit,
        )  # fmt: skip
        if (periodic := Messages.of(worlds).periodic).any():
            received._hear_messages(worlds, vehicle, periodic)
        pieces &= known[..., np.newaxis]
        known &= pieces[..., PLACE] & pieces[..., SPEED]
        for pair, other in ((vehicle - 1, vehicle - 1), (vehicle, vehicle + 1)):
            if 0 <= pair < N - 1:
                hit[:, pair] = worlds.pair_hit[:, pair] & known[:, other]
        unheard = ~pieces[:, 0, PLACE]
        received.obstacle_m[unheard], received.obstacle_hit[unheard] = np.inf, False
        return received

    def _hear_messages(self, worlds: Worlds, vehicle: int, periodic: Bools) -> None:
        """Overwrite the present states of other vehicles with the states in their newest messages, except for vehicles
        in sight.

        ``periodic`` [n] is True for worlds in which vehicles send messages periodically.
        """
        newest = Messages.of(worlds).newest_told(vehicle)
        other = periodic[:, np.newaxis] & (np.arange(worlds.N) != vehicle)
        stale = other & (newest.at_s < worlds.time_s[:, np.newaxis])
        self.place_m[stale] = (newest.place_m - newest.own_place_m[:, np.newaxis])[stale]
        self.speed_mps[stale] = newest.speed_mps[stale]
        self.command_mps2[stale] = newest.command_mps2[stale]
        self.at_s[stale] = newest.at_s[stale]
        if vehicle > 0:
            self.obstacle_m[periodic] = (newest.obstacle_place_m - newest.own_place_m)[periodic]
            self.obstacle_hit[periodic] = newest.obstacle_hit[periodic, 0] == 1.0
        self.known[:] &= ~other | (newest.at_s >= 0.0)


def places_of(worlds: Worlds, vehicle: int) -> Floats:
    """Compute from the gaps of ``worlds`` the position of each vehicle relative to ``vehicle``, [n, N] m.

    Positions ahead are positive, positions behind negative. The position of a direct neighbour is exactly plus or minus
    the gap to this neighbour.
    """
    ahead = np.concatenate([np.zeros((worlds.n, 1)), -np.cumsum(worlds.gaps_m, axis=1)], axis=1)
    place: Floats = ahead - ahead[:, [vehicle]]
    for j, step in ((vehicle - 1, -1), (vehicle + 1, 1)):
        if 0 <= j < worlds.N:
            place[:, j] = -step * worlds.gaps_m[:, min(vehicle, j)]
    return place
