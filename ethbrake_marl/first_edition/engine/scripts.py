"""Scripts: the drivers of vehicles that do not learn, and their memory."""

from __future__ import annotations

from typing import Any, Protocol

SAMPLED_AT_ONCE = 1024  # smallest number of training worlds that are drawn together


class Script(Protocol):
    """A driver of the same vehicle in each of ``n`` worlds. An ``Agent`` is a script with a name.

    A script is called when the latency of its vehicle has elapsed, and at every time step from then on.

    A script without memory has the method ``act(worlds, vehicle)``. ``act`` returns the commanded acceleration of
    ``vehicle`` (index from 0) in every world, [n] m/s2; negative values brake. A script with memory has two methods,
    and stores nothing in its attributes:

    - ``begin(alert, vehicle, scripts) -> memory`` is called when episodes start in the worlds ``alert``, at t = 0.
      ``scripts`` maps the index of each scripted vehicle to the vehicle's script. Learners and, in an evaluation, the
      vehicles that the evaluated agent drives are not in ``scripts``.

    - ``act(worlds, memory, vehicle) -> (command, memory)`` returns the command [n] m/s2, and the new memory. ``worlds``
      can include worlds in which no decision is due; the results for these worlds are ignored.

    A memory is None, an array with one row per world, or a tuple or mapping of memories. The caller may select or
    replace rows of a memory, or pass the same memory to several calls. For this reason a script must never change a
    memory in place. If a memory is a mapping with the key ``predicted_harm``, its value [n] (m2/s2) is the harm that
    the agent predicted when the episode began.

    For a script with the attribute ``state_free = True``, ``act`` is called only once per episode, right after
    ``begin``, because the script's command never changes.
    """

    def act(self, *args: Any, **kwargs: Any) -> Any:
        """Return the commanded acceleration in n worlds, [n] m/s2; a script with memory also returns its new memory."""
