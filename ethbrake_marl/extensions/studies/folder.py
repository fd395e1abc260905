"""The folder of a study, for instance of an ablation or of a reproduction of the paper.

Only one process at a time may work in the folder, and all processes must use the same settings.
"""

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
    """Folder for the results of a study. After an interruption, the same command continues the work in this folder.

    Args:
        path: folder, which ``work`` creates if necessary.
        kind: words for the content of the folder in messages, such as ``an ablation``.
        question: all settings and software versions on which the results depend, as plain data. If the folder stores
            other settings, ``check`` and ``work`` raise ``InvalidInput``. None: the folder stores no common settings,
            because each result stores its own.
        record: name of the file that stores ``question``.
        more: additional entries of the file ``record``, which are never compared.
        advice: last words of an error message, which say what the user can do.
        beside: names of the only files that an existing folder without the file ``record`` may contain; None: any
            files.
        writes: names of the files that the study will overwrite; they must be writable.

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
        """Check that the study may use this folder, and return whether the file ``record`` must still be written.

        The method writes nothing. Raises ``InvalidInput`` if the path is not a folder, if it or a file in ``writes`` is
        not writable, or if the folder stores other settings. Raises ``AlreadyExists`` if the folder contains the files
        of another command.
        """
        check_folder(self.path, self._writes, force=True)
        if self._question is None:
            if self._record.is_file():
                raise AlreadyExists(
                    f"{self.path}: the folder cannot be used for {self._kind}, because another command has written"
                    f" {self._record.name} into it; {self._advice}"
                )
            return False
        if not self._record.is_file():
            held = {each.name for each in self.path.iterdir()} if self.path.is_dir() else set()
            if self._beside is not None and held - {*self._beside, _LOCK}:
                raise AlreadyExists(
                    f"{self.path}: the folder exists, but does not contain {self._kind}; give another folder"
                )
            return True
        try:
            stored = read_object(self._record)
        except InvalidInput as error:
            raise InvalidInput(f"{error}; {self._advice}") from None
        other = _differences({key: stored[key] for key in stored if key not in self._more}, self._question)
        if other:
            raise InvalidInput(
                f"{self.path}: the folder contains {self._kind} with other settings ({'; '.join(other)});"
                f" {self._advice}"
            )
        return False

    @contextmanager
    def work(self) -> Iterator[None]:
        """Context manager that creates the folder, and locks it against other processes while the block runs.

        Before the block runs, unfinished files of killed processes are removed. Raises the exceptions of ``check``, and
        ``InvalidInput`` if another process works in the folder.
        """
        self.check()
        self.path.mkdir(parents=True, exist_ok=True)
        with hold_lock(self.path / _LOCK, "another process works in this folder; wait until it ends, or end it"):
            is_new = self.check()
            remove_unfinished(self.path)
            if is_new:
                write_file(
                    self._record, (json.dumps({**self._more, **(self._question or {})}, indent=2) + "\n").encode()
                )
            yield


def _differences(before: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> list[str]:
    """Return the differences between the settings ``before`` and ``now`` as texts: ``["seeds 2, now 5", "recipes"]``.

    If a value is a list or a mapping, the text is only the name of the setting. ``inside`` is put before each name.
    """
    differences: list[str] = []
    for name in dict.fromkeys([*now, *before]):
        old, new = before.get(name), now.get(name)
        name_here = f"{inside}{name.replace('_', '-')}"
        if isinstance(old, dict) and isinstance(new, dict):
            differences += _differences(old, new, f"{name_here} ")
        elif old != new:
            plain = not isinstance(old, list | dict) and not isinstance(new, list | dict)
            differences.append(f"{name_here} {old!s:.40}, now {new!s:.40}" if plain else name_here)
    return differences
