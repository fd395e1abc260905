"""What all environments share: a game, the sequence of its worlds, the running episodes, and pictures of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.infos import dictionaries
from ethbrake_marl.episode.state import ENDED, State
from ethbrake_marl.episode.step import Step
from ethbrake_marl.errors import InvalidInput, check_whole_number
from ethbrake_marl.faces.rendering import Renderer, make_renderer
from ethbrake_marl.faces.stream import Stream
from ethbrake_marl.motion.layout import Floats, Ints
from ethbrake_marl.worlds.scenario import Scenario


class Face:
    """Base class of all environments. ``bodies`` [B]: vehicles whose observations and rewards are returned."""

    bodies: Ints
    episode: State = None  # type: ignore[assignment]  # until the first reset
    begins_again = False  # whether the next episode starts by itself when one has ended
    renderer: Any = Renderer()  # until it is opened

    def _open(
        self, scenario_and_game: tuple[Scenario, Game], render_mode: str | None, most_steps: int | None = None
    ) -> None:
        """``most_steps``: None: only the horizon truncates an episode."""
        (self.scenario, self.game), self.render_mode = scenario_and_game, render_mode
        if most_steps is not None:
            check_whole_number("number of steps of an episode", most_steps, 1)
            self.game = self.game._replace(settings=self.game.settings._replace(most_steps=float(most_steps)))
        self.stream, self.renderer = Stream(self.scenario, self.game), make_renderer(self, render_mode)
        self._of_state = self.scenario.horizon_s, self.scenario.has_obstacle

    def _need_learner(self) -> None:
        if not len(self.game.settings.learners):
            raise InvalidInput(f"scenario {self.scenario.name!r} has no learner; pass learners=['vehicle_2']")

    def _begun(self, what: str) -> State:
        if self.episode is None:
            raise InvalidInput(f"{what}: no episode is running; call reset first")
        return self.episode

    def _running(self) -> State:
        """It changes only in ``_keep``. Raises ``InvalidInput`` if none is running."""
        running = self._begun("step")
        if not self.begins_again and running.clock[0, ENDED] == 1.0:
            raise InvalidInput("step: no episode is running; call reset first")
        return running

    def _keep(self, stream: Stream, state: State, show: Callable[[State], None]) -> None:
        """Show the state by ``show``, a method of the renderer; replace the running episode and its sequence of worlds.

        A reset or step does this last, so a call that fails earlier changes nothing and can be repeated.
        """
        show(state)
        self.stream, self.episode = stream, state

    def _rewards(self, step: Step) -> Floats:
        """[n, B], or vector rewards, [n, B, K]."""
        rewards: Floats = (step.reward if step.vector is None else step.vector).take(self.bodies - 1, axis=1)
        return rewards

    def _infos(self, stream: Stream, state: State, step: Step | None) -> list[dict[str, Any]]:
        return dictionaries(self.game, state, step, stream.seeds_of(state), self.bodies)

    def describe_worlds(self) -> dict[str, Any]:
        """Drawn values of each running world: name such as ``gap_1_m`` or ``scenario`` -> [n]."""
        return self.stream.describe(self._begun("describe_worlds"))

    def describe_world(self) -> dict[str, Any]:
        """The first of ``describe_worlds``, as plain numbers and texts."""
        return {name: column.tolist()[0] for name, column in self.describe_worlds().items()}

    def render(self) -> Any:
        return self.renderer.render()

    def close(self, **kwargs: Any) -> None:
        self.renderer.close()
