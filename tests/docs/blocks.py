"""What the pages show as the outcome of a command: blocks with what was printed, tables with figures, pictures."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.docs.site import DOCS

ROOT = DOCS.parent
BLOCK = re.compile(r"^```(\S*)[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)
TABLE = re.compile(r"(?:^\|.*\n)+", re.MULTILINE)
FIGURE = re.compile(r"\d+\.\d+")
ANYTHING = re.compile(r"\s*(?:\.\.\.|…)\s*")


@dataclass(frozen=True)
class Shown:
    """One of them: its page, what it begins with (a command, a table's header, a picture's name), and its text."""

    page: str
    begin: str
    text: str


def pages() -> list[Path]:
    """README and every page but records of decisions, which tell how things were when they were decided."""
    return [ROOT / "README.md", *sorted(DOCS.glob("*.md")), *sorted(DOCS.glob("[pt]*s/*.md"))]


def printed_blocks() -> Iterator[Shown]:
    """Blocks with output: of commands (``$ ...``), and those without a language."""
    for page, text in _texts():
        for language, body in BLOCK.findall(text):
            lines = [line for line in body.splitlines() if line.strip()]
            if language == "console" and any(not _is_command(line) for line in _joined(lines)):
                yield Shown(page, commands_of(body)[0][0], body)
            elif not language and lines:
                yield Shown(page, lines[0].strip(), body)


def tables_of_figures() -> Iterator[Shown]:
    """Tables with a decimal fraction in two lines at least."""
    for page, text in _texts():
        for table in TABLE.findall(BLOCK.sub("", text)):
            if sum(bool(FIGURE.search(line)) for line in table.splitlines()[2:]) >= 2:
                yield Shown(page, table.partition("\n")[0], table)


def pictures() -> Iterator[Shown]:
    """Pictures of docs/figures, by name."""
    for page, text in _texts():
        for name in re.findall(r"!\[[^\]]*\]\([^)]*figures/([^)]+)\)", text):
            yield Shown(page, name, name)


def commands_of(block: str) -> list[tuple[str, list[str]]]:
    """(command, lines that it printed) of a block, in order."""
    found: list[tuple[str, list[str]]] = []
    for line in _joined(block.splitlines()):
        if _is_command(line):
            found.append((line[2:], []))
        elif found:
            found[-1][1].append(line.rstrip())
    return found


def agrees(shown: list[str], told: list[str]) -> bool:
    """Whether lines are as shown, where ``...`` stands for any number of lines, or for the rest of one."""
    pattern = ""
    for line in (each.rstrip() for each in shown):
        if ANYTHING.fullmatch(line):
            pattern += r"(.*\n)*?"
        else:  # one that ends in ``...`` goes on somehow
            pattern += re.escape(line.removesuffix("...")) + ".*\n" if line.endswith(" ...") else re.escape(line) + "\n"
    text = "".join(f"{line.rstrip()}\n" for line in told)
    return re.fullmatch(rf"{pattern}\n*", text) is not None or re.fullmatch(pattern, f"{text}\n") is not None


def missing_figures(table: str, told: str) -> list[str]:
    """Figures of a table, with their decimals, that no number of what was told is when it is rounded to as many."""
    numbers = {float(word) for word in re.findall(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?", told)}
    table = re.sub(r"( %) \[(\S+), (\S+)\]", r"\1 [\2\1, \3\1]", table)  # an interval has the unit of what it is of
    figures = {(word, share) for word, share in re.findall(r"(?<![\w.])(\d+\.\d+)( %)?", table)}
    return sorted(
        word
        for word, share in figures
        if not any(abs(abs(each) * factor - float(word)) <= 0.5000001 * 10 ** -len(word.partition(".")[2])
                   for each in numbers for factor in ((1, 100) if share else (1,)))
    )  # fmt: skip


def _texts() -> Iterator[tuple[str, str]]:
    for page in pages():
        yield page.relative_to(ROOT).as_posix(), page.read_text("utf-8")


def _is_command(line: str) -> bool:
    return line.startswith("$ ")


def _joined(lines: list[str]) -> list[str]:
    """Commands that go over several lines, in one."""
    return re.sub(r"\\\n\s*", "", "\n".join(lines)).splitlines()
