"""One name, one number: what several pages and notebooks say of an agent in a test is the same everywhere."""

import json
import re
from collections import defaultdict
from collections.abc import Iterator

from tests.docs.printed import BLOCK, PAGES, ROOT, TABLE

OTHER_LISTS = ("CHANGELOG.md", "/decisions/", "/reproduction/", "fronts.md", "universal-paper")  # readings, weights
TEXTS = [page for page in PAGES if not any(each in page.as_posix() for each in OTHER_LISTS)]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
AGENTS = {
    "pairwise": r"\[?E-V2X-BM\b.*published.*|`?e_v2x_bm:pairwise`?",
    "e_v2x_bm": r"\[?E-V2X-BM \(coupled\).*|`?e_v2x_bm`?",
    "full_brake": r"full braking|`?full_brake`?|all vehicles brake fully",
    "best_harm": r"the best known.*|`?best_harm`?",
    "universal": r"`?universal`?(, trained .*)?",
    "ppo": r"`?ppo`?([:,] .*trained .*)?",
}
CHOOSE = ("e_v2x_bm", "best_harm")  # what they do depends on what they minimise
COUNT = re.compile(r"(?i)(first)-impact|(total)|(honest)|(collisions)")
LEAST = re.compile(r"(?:minimises?|harm_count=|rules=)\W*(?:the )?\W*(first|total|honest)")
TEST = re.compile(r"(?i)(main|obstacle|brake-only) test|((?:paper|cooperation|realistic|stress|recorded)-[\w-]+)|(rainy)")
NAMES = {"main": "paper-random", "obstacle": "paper-random-obstacle", "brake-only": "paper-random-brake-only"}
Fact = tuple[tuple[str | None, ...], str]  # (agent, test, count, what it minimises), and the number as it is shown


def named(pattern: re.Pattern[str], text: str) -> list[str]:
    """The counts or tests that a text names, each once."""
    words = [next(filter(None, each.groups())).lower() for each in pattern.finditer(text)]
    return list(dict.fromkeys(NAMES.get(word, word) for word in words))


def agent_of(label: str) -> str | None:
    return next((name for name, words in AGENTS.items() if re.fullmatch(words, label.strip())), None)


def numbers(text: str) -> list[str]:
    return re.findall(r"\d+\.\d+", re.sub(r"\[[^\]]*\]|\([^)]*\)", "", text))  # without intervals


def facts(agent: str, test: str, counts: list[str], least: str, shown: list[str]) -> Iterator[Fact]:
    for count, number in zip(counts, shown, strict=False):
        yield (agent, test, count, least if agent in CHOOSE else None), number


def of_table(table: str, about: str) -> Iterator[Fact]:
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    test, least = default_test(about, about), [*named(LEAST, about), "first"][0]
    for row in rows if head[0] != "recipe" else ():
        label = next((agent for agent in map(agent_of, row) if agent), "")
        test = [*named(TEST, row[0]), test][0]
        least = [*named(COUNT, row[-1]), least][0] if row[0].startswith("**") else least
        column = test
        for cell, title in zip(row, head, strict=True):
            column = [*named(TEST, title), column][0]
            if label:
                yield from facts(label, column, named(COUNT, title), least, numbers(cell))
            elif (agent := agent_of(title)) and (named(TEST, row[0]) or row[0] == "at once"):
                yield from facts(agent, column, named(COUNT, about), least, numbers(cell))


def of_output(text: str, test: str, least: str) -> Iterator[Fact]:
    counts: list[str] = []
    for line in text.splitlines():
        test = [*named(TEST, line), test][0]
        if agent := agent_of(re.split(r"  +", line.strip())[0]):
            yield from facts(agent, test, counts, least, numbers(re.sub(r"\d+\.\d+ ?%", "", line)))
        else:
            counts = [each for each in dict.fromkeys([*counts, *named(COUNT, line)]) if each != "collisions"]


def default_test(about: str, prose: str = "") -> str:
    return [*named(TEST, " ".join(re.findall(r"--scenario (\S+)", about))), *named(TEST, prose), "paper-random"][0]


def of_page(text: str) -> Iterator[Fact]:
    for section in text.split("\n## "):
        least = [*named(LEAST, section), "first"][0]
        for table in TABLE.findall(BLOCK.sub("", section)):
            yield from of_table(table, section)
        for language, block in BLOCK.findall(section):
            if language in ("", "console"):
                yield from of_output(block, default_test(section), least)


def of_notebook(text: str) -> Iterator[Fact]:
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        test, least = [*named(TEST, source), "paper-random"][0], [*named(LEAST, source), "first"][0]
        for output in cell.get("outputs", ()):
            shown = "".join(output.get("text", output.get("data", {}).get("text/html", ())))
            if "<td>" in shown:
                shown = re.sub("<[^>]*>", "  ", shown.replace("\n", "").replace("</tr>", "\n"))
            yield from of_output(shown, test, least)


def all_facts() -> dict[tuple[str | None, ...], dict[str, str]]:
    """Key -> number as shown -> a file that shows it."""
    found: dict[tuple[str | None, ...], dict[str, str]] = defaultdict(dict)
    for files, read in ((TEXTS, of_page), (NOTEBOOKS, of_notebook)):
        for file in files:
            for key, number in read(file.read_text("utf-8")):
                found[key][number] = file.relative_to(ROOT).as_posix()
    return found


def differ(one: str, other: str) -> bool:
    """Whether two numbers differ when they are rounded to the decimals that both show."""
    digits = min(len(each.partition(".")[2]) for each in (one, other))
    return abs(float(one) - float(other)) > 0.5000001 * 10**-digits


def test_number__of_an_agent_in_a_test_is_the_same_on_all_pages() -> None:
    found = all_facts()
    assert len(found) > 100
    assert {key: shown for key, shown in found.items() if any(differ(a, b) for a in shown for b in shown)} == {}


def prose() -> Iterator[tuple[str, str]]:
    """Name and text, in one line, of each page and notebook without tables, code and links."""
    for page in TEXTS:
        yield page.name, " ".join(TABLE.sub("", BLOCK.sub("", page.read_text("utf-8"))).split())
    for notebook in NOTEBOOKS:
        cells = json.loads(notebook.read_text("utf-8"))["cells"]
        yield notebook.name, " ".join("".join(map(str, (*cell["source"], cell.get("outputs")))) for cell in cells)


def test_number__beside_full_braking_in_a_sentence_is_one_of_the_tables() -> None:
    tables = [number for (agent, *_), shown in all_facts().items() if agent == "full_brake" for number in shown]
    beside = re.compile(r"(\d+\.\d\d) \(full braking\)|[Ff]ull braking (?:costs |does )?(\d+\.\d\d)(?! ?%)")
    wrong = {(name, each[0]) for name, text in prose() for each in beside.finditer(text)
             if all(differ(each[1] or each[2], number) for number in tables)}  # fmt: skip
    assert wrong == set()


def test_unavoidable__has_one_value_and_one_definition() -> None:
    share = r"(\d+\.\d) ?%"
    said = re.compile(rf"{share}[^.|%]{{0,80}}(?:unavoidable|no command)|unavoidable\W[^.|%]{{0,60}}?{share}")
    values = {(each[1] or each[2], name) for name, text in prose() for each in said.finditer(text)}
    assert {value for value, _ in values} == {"62.3"}, values
    assert len({name for _, name in values}) > 4
    certain = {page.name for page in TEXTS if re.search(r"[Cc]ontact( is)? certain", page.read_text("utf-8"))}
    assert certain == {"best-harm.md", "proofs.md"}


def test_evaluations__drive_the_whole_list() -> None:
    wrong = []
    for page in TEXTS:
        for command in re.findall(r"(?m)^(?:\$ )?(ethbrake evaluate (?:.*\\\n)*.*)", page.read_text("utf-8")):
            one = not re.search(r"--scenario (?!(TEST|paper-random(-brake-only|-obstacle)?)( |$))", command)
            number = re.search(r"--episodes (\d+)", command)
            allowed = (None, "10000") if one else ("2000", None) if "results" not in page.parts else ("2000",)
            if (number and number[1]) not in allowed and "--seed 7 " not in command and "robust" not in command:
                wrong.append((page.name, command))
    assert wrong == []
