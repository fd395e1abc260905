"""A sweep: one key of a scenario with several values. ``objective=social:0..90:15`` means 0, 15, ..., 90 degrees."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import NamedTuple

from ethbrake_marl.errors import InvalidInput, count_of

MOST = 100  # values of a sweep
NUMBER = r"-?\d+(?:\.\d+)?"
ITEM = re.compile(rf"(?P<low>{NUMBER})(?:\.\.(?P<high>{NUMBER}):(?P<step>{NUMBER}))?", re.ASCII)
WORD = re.compile(r"\s*([A-Za-z][\w-]*:)?", re.ASCII)


class Swept(NamedTuple):
    """The key of a scenario that a sweep varies, with one of its values."""

    key: str  # such as v2x.lost
    word: str  # text before the number in the value, such as ``social:``; usually empty
    text: str  # the number

    @property
    def number(self) -> float:
        return float(self.text)

    @property
    def setting(self) -> str:
        return f"{self.key}={self.word}{self.text}"

    @property
    def axis(self) -> str:
        return f"{self.key} = {self.word}…" if self.word else self.key

    @property
    def label(self) -> str:
        """Suffix of the level's name, such as ``social-15`` or ``v2x.lost-0.1``."""
        return f"{self.word.rstrip(':') or self.key}-{self.text}"


def parse_sweep(text: str) -> list[Swept]:
    """Read a sweep ``KEY=LOW..HIGH:STEP`` or ``KEY=A,B,...``; return its values in ascending order.

    A word may precede the numbers, as in ``objective=social:0..90:15``. Numbers and ranges may be mixed. Raises
    ``InvalidInput`` for any other text, a range that its step does not divide, a repeated number, and fewer than 2 or
    more than ``MOST`` numbers.
    """
    key, equals, values = (part.strip() for part in text.partition("="))
    match = WORD.match(values)
    word, numbers = (match[1] or "" if match else ""), list[Decimal]()
    for item in values.split(","):
        parsed = ITEM.fullmatch(item.strip().removeprefix(word).strip())
        if not (key and equals and parsed):
            raise InvalidInput(
                f"--sweep {text!r:.200}: must be KEY=LOW..HIGH:STEP or KEY=A,B,... with numbers, for instance"
                " objective=social:0..90:15 or v2x.lost=0,0.1,0.3; for other values, give scenarios with --levels"
            )
        low, high, step = (Decimal(part or 0) for part in parsed.group("low", "high", "step"))
        steps = (high - low) / step if step > 0 else Decimal(0)
        if parsed["step"] is not None and (not 0 < steps < MOST or steps % 1):
            raise InvalidInput(
                f"--sweep {key}: range {item.strip()}: a range LOW..HIGH:STEP must go up from LOW to HIGH in 1 to"
                f" {MOST - 1} equal steps, for instance 0..90:15"
            )
        numbers += [low + k * step for k in range(int(steps) + 1)]
    if not 2 <= len(numbers) <= MOST:
        raise InvalidInput(f"--sweep {key}: has {count_of(len(numbers), 'number')}; give 2 to {MOST} numbers")
    if twice := [number for number in numbers if numbers.count(number) > 1]:
        raise InvalidInput(f"--sweep {key}: {twice[0]} is given twice; give each number once")
    return [Swept(key, word, f"{number.normalize():f}") for number in sorted(numbers)]
