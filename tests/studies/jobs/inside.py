"""Workers without processes, for tests that are about what is done and not about where."""

from __future__ import annotations

from ethbrake_marl.studies.jobs import Answer, answer


class Inside:
    """Takes the place of ``LocalWorkers``: a job at a time, done in this process when it is waited for."""

    def __init__(self, number: int) -> None:
        self.begun: list[tuple[int, bytes]] = []

    def room(self) -> int:
        return 1 - len(self.begun)

    def begin(self, number: int, call: bytes) -> None:
        self.begun.append((number, call))

    def wait(self) -> list[tuple[int, Answer]]:
        number, call = self.begun.pop()
        return [(number, answer(call, ()))]

    def interrupt(self) -> None: ...

    def close(self) -> None: ...
