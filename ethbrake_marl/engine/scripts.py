"""Scripts: what drives a vehicle that does not learn, and what it remembers."""

from __future__ import annotations

from typing import Any, Protocol

SAMPLED_AT_ONCE = 1024  # training worlds are drawn in blocks of at least this many


class Script(Protocol):
    """Drives one vehicle in every world of a batch of ``n``. An ``Agent`` is one with a name.

    It is asked when the latency of its vehicle has elapsed, and every time step from then on, whoever learns.

    One that remembers nothing has ``act(worlds, vehicle)``, which gives the wanted signed acceleration of ``vehicle``
    (index from 0) in every world, [n] m/s2. One that remembers has two methods, and keeps nothing in itself:

    - ``begin(alert, vehicle, scripts) -> memory``: episodes start in the worlds ``alert``, at t = 0. ``scripts`` drive
      the vehicles that are scripted, by index; all others are free to decide.
    - ``act(worlds, memory, vehicle) -> (command, memory)``: the command [n] m/s2, and what it remembers then. Not each
      world need have a decision now: of the others neither is used.

    A memory is None, an array whose first axis is the world, or a tuple or mapping of such. Whoever runs the episodes
    owns it: takes rows of it, begins some anew, tries what would be. So it is never changed in place. What a mapping
    holds as ``predicted_harm`` [n] (m2/s2) is what the agent expected when the episode began.

    With an attribute ``state_free = True`` it is asked only once per episode, right after ``begin``: its command is
    fixed at the alert and never changes.
    """

    def act(self, *args: Any, **kwargs: Any) -> Any:
        """The command [n] m/s2, of one that remembers with its memory."""
