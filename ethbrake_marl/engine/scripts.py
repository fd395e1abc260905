"""Scripts: the drivers of vehicles that do not learn, and their memory."""

from __future__ import annotations

from typing import Any, Protocol

SAMPLED_AT_ONCE = 1024  # smallest number of training worlds that are drawn together


class Script(Protocol):
    """Driver of one vehicle in each world of a batch of ``n`` worlds. An ``Agent`` is a script with a name.

    A script is called when the latency of its vehicle has elapsed, and at every time step from then on.

    A script without memory has ``act(worlds, vehicle)``, which returns the commanded acceleration of ``vehicle`` (index
    from 0) in every world, [n] m/s2; negative values brake. A script with memory has two methods, and stores nothing in
    its attributes:

    - ``begin(alert, vehicle, scripts) -> memory``: episodes start in the worlds ``alert``, at t = 0. ``scripts`` maps
      the index of each scripted vehicle to its script; all other vehicles decide freely.
    - ``act(worlds, memory, vehicle) -> (command, memory)``: the command [n] m/s2, and the new memory. ``worlds`` may
      include worlds in which no decision is due at this moment; the results for these worlds are ignored.

    A memory is None, an array whose first axis is the world, or a tuple or mapping of memories. The caller may select
    rows of a memory, replace rows when new episodes start, or use a memory several times to try possible continuations.
    A script must therefore never change a memory in place. If a mapping contains ``predicted_harm`` [n] (m2/s2), this
    is the harm that the agent predicted when the episode began.

    For a script with the attribute ``state_free = True``, ``act`` is called only once per episode, right after
    ``begin``, because its command never changes.
    """

    def act(self, *args: Any, **kwargs: Any) -> Any:
        """Return the commanded acceleration in n worlds, [n] m/s2; a script with memory also returns its new memory.

        The arguments are ``(worlds, vehicle)`` for a script without memory, and ``(worlds, memory, vehicle)`` for a
        script with memory.
        """
