"""The folder of a study: it holds the results of one set of settings, and one process at a time works in it."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import check_folder, hold_lock, remove_unfinished, write_file

_LOCK = ".lock"


class StudyFolder:
    """Folder of a study's results, so that the same command continues after an interruption.

    Args:
        path: the folder; it is created when work begins.
        kind: what the folder holds, for messages: ``a sweep``.
        question: all settings and versions that the results depend on, as plain data, so that a folder with other ones
            is refused; None if each result stores its own.
        record: name of the file inside the folder that stores ``question``.
        more: further entries of that file, which are not compared.
        advice: what the user can do about a folder with another ``question``, for messages.
        beside: names of files that may exist in a folder without that file; None: any.
        writes: names of files that the work replaces, and that must therefore be writable.

    """

    def __init__(
        self,
        path: Path,
        kind: str,
        question: Mapping[str, Any] | None = None,
        *,
        record: str = "question.json",
        more: Mapping[str, Any] | None = None,
        advice: str = "give another folder (--output)",
        beside: Collection[str] | None = None,
        writes: Collection[str] = (),
    ) -> None:
        self.path, self._kind, self._advice, self._beside, self._writes = path, kind, advice, beside, writes
        self._question: dict[str, Any] | None = None if question is None else json.loads(json.dumps(question))
        self._record, self._more = path / record, dict(more or {})

    def check(self) -> bool:
        """Check that work may begin in this folder, and return whether the file ``record`` must still be written.

        Writes nothing. Raises ``InvalidInput`` if the path is not a folder, if it or one of ``writes`` cannot be
        written, or if it belongs to other settings (the message lists the differences); ``AlreadyExists`` for a folder
        with other content.
        """
        check_folder(self.path, self._writes, force=True)
        if self._question is None:
            if self._record.is_file():
                raise AlreadyExists(
                    f"{self.path}: is no folder of {self._kind}: {self._record.name} of another command is there;"
                    f" {self._advice}"
                )
            return False
        if not self._record.is_file():
            held = {each.name for each in self.path.iterdir()} if self.path.is_dir() else set()
            if self._beside is not None and held - {*self._beside, _LOCK}:
                raise AlreadyExists(f"{self.path}: is there already, and holds no {self._kind}; give another folder")
            return True
        try:
            stored = read_object(self._record)
        except InvalidInput as error:
            raise InvalidInput(f"{error}; {self._advice}") from None
        other = _differences({key: stored[key] for key in stored if key not in self._more}, self._question)
        if other:
            raise InvalidInput(
                f"{self.path}: holds {self._kind} with other settings ({'; '.join(other)}); {self._advice}"
            )
        return False

    @contextmanager
    def work(self) -> Iterator[None]:
        """Context manager that creates the folder, and locks it against other processes while the block runs.

        At the start it also removes unfinished files of processes that were killed.

        Raises the exceptions of ``check``, and ``InvalidInput`` if another process works in the folder.
        """
        self.check()
        self.path.mkdir(parents=True, exist_ok=True)
        with hold_lock(self.path / _LOCK, "another process works in it; wait for it, or end it"):
            is_new = self.check()
            remove_unfinished(self.path)
            if is_new:
                write_file(
                    self._record, (json.dumps({**self._more, **(self._question or {})}, indent=2) + "\n").encode()
                )
            yield


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> list[str]:
    """Return the differences of the settings ``now`` from ``before``, in words: ``["seeds 2, here 5", "recipes"]``.

    For a list or an object, only the name is given. ``inside`` is the text before each name.
    """
    differences: list[str] = []
    for name in dict.fromkeys([*now, *before]):
        old, new = before.get(name), now.get(name)
        name_here = f"{inside}{name.replace('_', '-')}"
        if isinstance(old, dict) and isinstance(new, dict):
            differences += _differences(old, new, f"{name_here} ")
        elif old != new:
            plain = not isinstance(old, list | dict) and not isinstance(new, list | dict)
            differences.append(f"{name_here} {old!s:.40}, here {new!s:.40}" if plain else name_here)
    return differences
