"""The folder of a study, such as an ablation: used by one process at a time, and always with the same settings."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.store import check_folder, hold_lock, remove_unfinished, write_file


@contextmanager
def work_in(
    folder: Path, kind: str, settings: Mapping[str, Any], *, record: str, advice: str, writes: Collection[str] = ()
) -> Iterator[None]:
    """Create and lock a study's folder. The same command continues there after an interruption.

    ``kind`` and ``advice``: words for messages. ``settings``: all on which results depend, stored in the file
    ``record``. ``writes``: files that the study overwrites. Raises ``InvalidInput`` for a folder that cannot be
    written, has other settings, or is in use.
    """
    check_folder(folder, writes, force=True)
    folder.mkdir(parents=True, exist_ok=True)
    now = json.loads(json.dumps(settings))
    with hold_lock(folder / ".lock", "another process works in this folder; wait until it ends, or end it"):
        if (folder / record).is_file():
            try:
                before = read_object(folder / record)
            except InvalidInput as error:
                raise InvalidInput(f"{error}; {advice}") from None
            if differences := _differences(before, now):
                raise InvalidInput(
                    f"{folder}: the folder contains {kind} with other settings ({differences}); {advice}"
                )
        remove_unfinished(folder)
        write_file(folder / record, (json.dumps(now, indent=2) + "\n").encode())
        yield


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    differences = []
    for name in dict.fromkeys([*now, *before]):
        old, new = before.get(name), now.get(name)
        plain = not isinstance(old, list | dict) and not isinstance(new, list | dict)
        if old != new:
            differences.append(name.replace("_", "-") + (f" {old!s:.40}, now {new!s:.40}" if plain else ""))
    return "; ".join(differences)
