"""Jobs on a Ray cluster, or on a Ray of this machine alone that nobody else can reach."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput, naming_extras
from ethbrake_marl.files.plugins import Plugin, load_the_same, loaded_plugins
from ethbrake_marl.studies.jobs import ONE_THREAD, Answer, WorkerLost, answer, process_name

LOCAL = "local"
_WAIT_S, _LOOK_S = 1.0, 10.0  # for an answer; between two looks at how large the cluster is
_AHEAD = 2  # jobs per core that Ray holds: one runs, one waits


class RayWorkers:
    """The cores of a cluster, a job each; Ray itself never repeats one.

    Args:
        address: of a running cluster, as Ray takes it, or ``local``: a Ray of this machine on loopback sockets, without
            a dashboard, which ends with ``close``.
        number: cores of the local one; of a cluster jobs at once at most, None: as many as it has cores.

    Raises ``MissingExtra`` without Ray, ``InvalidInput`` where there is no cluster at the address.

    """

    def __init__(self, address: str, number: int | None = None) -> None:
        plugins = loaded_plugins()
        load_the_same(plugins)  # a file that was changed since is told here, in one line
        self._plugins = tuple(_absolute(plugin) for plugin in plugins)
        self._ray = _connect(address, number)
        self._most = number if number is not None and address != LOCAL else None
        self._do = self._ray.remote(num_cpus=1, max_retries=0, max_calls=0)(_do)
        self._running: dict[Any, int] = {}
        self._cores, self._looked = 0, float("-inf")

    def room(self) -> int:
        """So many that no core has to wait for us, however many join the cluster or leave it."""
        if time.monotonic() - self._looked > _LOOK_S:
            self._cores, self._looked = int(self._ray.cluster_resources().get("CPU", 0)), time.monotonic()
        most = _AHEAD * self._cores if self._most is None else self._most
        return most - len(self._running)

    def begin(self, number: int, call: bytes) -> None:
        """Hand a job to Ray, which runs it when a core is free."""
        self._running[self._do.remote(call, self._plugins)] = number

    def wait(self) -> list[tuple[int, Answer]]:
        """What came back; a job that was lost with its worker or computer may be tried again."""
        if not self._running:
            time.sleep(_WAIT_S)  # a cluster without a core: one may join
            return []
        ended, _ = self._ray.wait(list(self._running), num_returns=1, timeout=_WAIT_S)
        return [(self._running.pop(reference), self._take(reference)) for reference in ended]

    def interrupt(self) -> None:
        """Pass Ctrl-C on: a training ends after its update, with a checkpoint; what waits is not begun."""
        for reference in self._running:
            self._ray.cancel(reference, force=False)

    def close(self) -> None:
        """Leave the cluster, which ends what still runs for us; a local one ends."""
        self._ray.shutdown()

    def _take(self, reference: Any) -> Answer:
        lasting = (self._ray.exceptions.RuntimeEnvSetupError, self._ray.exceptions.AuthenticationError)
        try:
            found = self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:  # the package could not even be loaded there
            return Answer(None, InvalidInput(f"a worker of the cluster cannot do the job: {error.cause!r}"))
        except lasting as error:
            return Answer(None, InvalidInput(f"the cluster refuses the job: {error}"))
        except self._ray.exceptions.RayError as error:
            return Answer(
                None, WorkerLost(f"the worker was lost in the middle of the job ({type(error).__name__})"), True
            )
        assert isinstance(found, Answer)
        return found


def _do(call: bytes, plugins: Sequence[Plugin]) -> Answer:
    """What a worker of the cluster runs."""
    return answer(call, plugins, process_name())


def _connect(address: str, number: int | None) -> Any:
    """Ray itself, connected."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address == LOCAL:
        # What Ray reads, once, when it is loaded: no cluster can be made of this, and 127.0.0.1 is its address. An
        # address that is given to ray.init would be changed to that of a network card.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    with naming_extras():
        import ray
        import ray.exceptions
    quiet = {"log_to_driver": False, "configure_logging": False, "runtime_env": {"env_vars": ONE_THREAD}}
    if address == LOCAL:
        ray.init(address=LOCAL, num_cpus=number, include_dashboard=False, **quiet)
        return ray
    try:
        ray.init(address=address, **quiet)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise InvalidInput(f"ray {address!r}: no cluster can be reached there ({error})") from None
    return ray


def _absolute(plugin: Plugin) -> Plugin:
    """The plug-in by a path that workers elsewhere understand."""
    is_file = plugin.source.endswith(".py") or os.sep in plugin.source
    return replace(plugin, source=str(Path(plugin.source).absolute())) if is_file else plugin
