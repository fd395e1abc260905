"""Command line of the programmes: ``python -m tests.programmes [NAME [options]]``; without a name it lists them.

A programme is a module of this folder. Its function ``cases(given)`` yields the name of each case and a function that
runs it and returns ``Told``: True (good), False (failed) or None (skipped, or without a claim), and one line of text.
An ``AssertionError`` is a failure. The optional table ``OPTIONS`` has arguments of ``add_argument``.
"""

import argparse
import math
import sys
import time
from importlib import import_module
from pathlib import Path

from tests.programmes import Told

WORDS = {True: "ok", False: "FAILED", None: "-"}
FOLDER = Path(__file__).parent


def programmes() -> dict[str, str]:
    """First line of each programme's docstring, by name."""
    texts = {file.stem: file.read_text("utf-8") for file in sorted(FOLDER.glob("*.py"))}
    return {name: text.partition("\n")[0].strip('"') for name, text in texts.items() if "\ndef cases(" in text}


def main(words: list[str]) -> int:
    """Run the cases of a programme. Return 0 if a case ran and none failed, 1 if not, 2 for an unknown name."""
    if not words or words[0] not in programmes():
        print("\n".join(f"{name:12} {line}" for name, line in programmes().items()))
        return 2 if {*words} - {"-h", "--help"} else 0
    programme = import_module(f"tests.programmes.{words[0]}")
    parser = argparse.ArgumentParser(
        f"python -m tests.programmes {words[0]}",
        description=programme.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", default="", metavar="TEXT", help="run only cases whose name contains this")
    parser.add_argument("--within", type=float, default=math.inf, metavar="SECONDS", help="start no case later")
    parser.add_argument("--list", action="store_true", help="list the cases without running them")
    for option, how in getattr(programme, "OPTIONS", {}).items():
        parser.add_argument(option, **how)
    given = parser.parse_args(words[1:])
    given.until = time.monotonic() + given.within  # cases may use it
    ended: list[bool | None] = []
    for name, run in programme.cases(given):
        if given.only not in name:
            continue
        if given.list:
            print(name, flush=True)
            continue
        begun = time.monotonic()
        try:
            good, text = run() if begun < given.until else Told(None, "skipped: no time left")
        except AssertionError as error:
            good, text = False, str(error)
        ended.append(good)
        print(f"{WORDS[good]:6} {time.monotonic() - begun:7.1f} s  {name}{text and ': '}{text}", flush=True)
    if given.list:
        return 0
    failed, skipped = ended.count(False), ended.count(None)
    verdict = "FAIL" if failed or not ended else "PASS"
    print(f"{verdict}: {ended.count(True)} of {len(ended)} good, {failed} failed, {skipped} without a verdict")
    return int(verdict == "FAIL")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
