"""A sweep: one key of a scenario with several numbers, as in ``objective=social:0..90:15``."""

from __future__ import annotations

import re
from decimal import Decimal
from typing import Any, NamedTuple

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.overrides import Override

MOST = 100  # numbers of a sweep

_NUMBER = r"-?\d+(?:\.\d+)?"

_ITEM = re.compile(rf"(?P<low>{_NUMBER})(?:\.\.(?P<high>{_NUMBER}):(?P<step>{_NUMBER}))?", re.ASCII)

_WORD = re.compile(r"\s*([A-Za-z][\w-]*:)?", re.ASCII)


class Swept(NamedTuple):
    """The swept key at one of its values."""

    key: str  # as written: v2x.lost
    word: str  # what stands before the number in the value: ``social:``; usually empty
    text: str  # the number as written in the value

    @classmethod
    def parse(cls, text: str) -> list[Swept]:
        """Parse ``KEY=LOW..HIGH:STEP`` or ``KEY=A,B,...``, also with a word before the numbers: ``social:0..90:15``.

        Items of both kinds may be mixed. Returns the values in ascending order. Raises ``InvalidInput`` for anything
        that is no number, for a range whose steps miss its end, and for a repeated, a single or too many numbers.
        """
        key, equals, values = (part.strip() for part in text.partition("="))
        word = match.group(1) or "" if (match := _WORD.match(values)) else ""
        numbers: list[Decimal] = []
        for item in values.split(","):
            parsed = _ITEM.fullmatch(item.strip().removeprefix(word).strip())
            if not (key and equals and parsed):
                raise InvalidInput(
                    f"--sweep {text!r:.200}: must be KEY=LOW..HIGH:STEP or KEY=A,B,... with numbers, for instance"
                    " objective=social:0..90:15 or v2x.lost=0,0.1,0.3; compare other values as --levels"
                )
            low, high, step = (Decimal(part or parsed["low"]) for part in parsed.group("low", "high", "step"))
            if parsed["step"] is None:
                numbers.append(low)
                continue
            steps = (high - low) / step if step > 0 else Decimal(0)
            if not 0 < steps < MOST or steps % 1:
                raise InvalidInput(
                    f"--sweep {key}: range {item.strip()}: must go up from LOW to HIGH in at most {MOST - 1} whole"
                    " steps, for instance 0..90:15"
                )
            numbers += [low + k * step for k in range(int(steps) + 1)]
        if not 2 <= len(numbers) <= MOST:
            raise InvalidInput(f"--sweep {key}: {len(numbers)} given; must be 2 to {MOST} numbers")
        for number in numbers:
            if numbers.count(number) > 1:
                raise InvalidInput(f"--sweep {key}: {number} is given twice")
        return [cls(key, word, f"{number.normalize():f}") for number in sorted(numbers)]

    @property
    def number(self) -> float:
        """The number: its place on the axis of figures."""
        return float(self.text)

    @property
    def setting(self) -> str:
        """The value as a setting: ``objective=social:15``."""
        return f"{self.key}={self.word}{self.text}"

    @property
    def override(self) -> Override:
        """The setting, to put into a scenario."""
        return Override.parse([self.setting])[0]

    @property
    def same_lines(self) -> bool:
        """Whether the key leaves every world the same line with the same physics."""
        return self.key.partition(".")[0] in ("objective", "obstacle_gap_m", "roles", "v2x")

    @property
    def label(self) -> str:
        """What the value adds to the name of a level: ``social-15``, ``v2x.lost-0.1``."""
        return f"{self.word.rstrip(':') or self.key}-{self.text}"

    @property
    def columns(self) -> dict[str, Any]:
        """Columns of tables: key, value and number."""
        return {"swept_key": self.key, "swept_value": f"{self.word}{self.text}", "swept_number": self.number}
