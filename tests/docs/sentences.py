"""A random sample of sentences for a new reader to judge: ``python -m tests.docs.sentences --seed 62``.

It prints as many sentences of docstrings as of pages and of messages, each with its place and the sentence before it.
The description of an argument is printed with the argument's name.
"""

import argparse
import ast
import random
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ethbrake_marl"
END = re.compile(r"(?<=[.?!])\s+(?=[A-Z`*])")
SECTION = re.compile(r"(?m)^(?:Args|Returns|Raises|Yields|Attributes):\n")
ENTRY = re.compile(r"\n(?= {4}\*{0,2}\w+(?:, \w+)*: )")  # before an argument's name

Found = tuple[str, str, str]  # place, sentence, and the sentence before it in the same paragraph


def main() -> None:
    """Print the sample that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=62)
    parser.add_argument("--each", type=int, default=20, help="sentences of each kind")
    asked = parser.parse_args()
    draw = random.Random(asked.seed)
    for kind, source in (("Docstrings", docstrings()), ("Pages", pages()), ("Messages", messages())):
        print(f"\n## {kind}\n")
        for number, (place, sentence, before) in enumerate(draw.sample(sorted(set(source)), asked.each), 1):
            print(f"{number}. {sentence}\n   ({place}{f'; before it: {before}' if before else ''})")


def docstrings() -> Iterator[Found]:
    """Each sentence of the package's docstrings, with file and name."""
    for path, tree in _modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                name = getattr(node, "name", "module")
                for paragraph in re.split(r"\n\s*\n", text.partition(">>>")[0]):
                    about, *entries = SECTION.split(paragraph)
                    for part in [about, *(entry for section in entries for entry in ENTRY.split(f"\n{section}"))]:
                        yield from _sentences(part, f"{path}, {name}")


def pages() -> Iterator[Found]:
    """Each sentence of README and docs, without code, tables, headings, decisions and what is generated."""
    for path in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        place = path.relative_to(ROOT).as_posix()
        if re.match(r"docs/(reference|results|decisions|_build)/", place):
            continue
        text = re.sub(r"(?ms)^```.*?^```|\$\$.*?\$\$", "", path.read_text("utf-8"))
        for paragraph in re.split(r"\n\s*\n|\n(?=- |\d+\. )", text):
            if not re.match(r"\s*(\||#|!|---|\$)", paragraph):
                yield from _sentences(re.sub(r"^\s*(-|\d+\.) ", "", paragraph), place)


def messages() -> Iterator[Found]:
    """Each text of an exception, a warning or a ``help=`` in the package; ``{...}`` stands for a value.

    A ``ValueError`` without a subject comes from the check of a file or field; its name is printed before the text.
    """
    for path, tree in _modules():
        for node in ast.walk(tree):
            checks = False
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
                texts: list[ast.expr] = node.exc.args
                checks = getattr(node.exc.func, "id", "") == "ValueError"
            elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "warn":
                texts = node.args[:1]
            else:
                texts = [node.value] if isinstance(node, ast.keyword) and node.arg == "help" else []
            for text in texts:
                written = _written(text)
                if len(written.split()) > 3:
                    subject = "{name}: " if checks and re.match("(must|is|not|has|holds) ", written) else ""
                    yield f"{path}:{text.lineno}", subject + written, ""


def _written(node: ast.expr) -> str:
    """Return a text as it stands in the code, with ``{name}`` for a value that is filled in."""
    match node:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(map(_written, parts))
        case ast.FormattedValue(value=value):
            return f"{{{ast.unparse(value)}}}"
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _written(left) + _written(right)
    return ""


def _modules() -> Iterator[tuple[str, ast.Module]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        yield path.relative_to(ROOT).as_posix(), ast.parse(path.read_text("utf-8"))


def _sentences(paragraph: str, place: str) -> Iterator[Found]:
    before = ""
    for sentence in END.split(" ".join(paragraph.split())):
        if len(sentence.split()) > 3:
            yield place, sentence, before
        before = sentence


if __name__ == "__main__":
    main()
