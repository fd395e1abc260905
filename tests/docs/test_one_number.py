"""One name, one number: what several pages and notebooks say of an agent in a test is the same everywhere."""

import json
import re
from collections import defaultdict
from collections.abc import Iterator

from tests.docs.printed import BLOCK, PAGES, ROOT, TABLE

OTHER_LISTS = ("CHANGELOG.md", "/decisions/", "/reproduction/")  # readings, weights
TEXTS = [page for page in PAGES if not any(each in page.as_posix() for each in OTHER_LISTS)]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
AGENTS = {
    "pairwise": r"\[?E-V2X-BM\b.*published.*|`?e_v2x_bm:pairwise`?",
    "e_v2x_bm": r"\[?E-V2X-BM \(coupled\).*|`?e_v2x_bm`?",
    "full_brake": r"full braking|`?full_brake`?|all vehicles brake fully",
    "best_harm": r"the best known.*|`?best_harm`?",
    "plan": r"\[?`?plan`?(\]\(.*?\))?([:,] .*)?",
    "ppo": r"`?ppo`?([:,] .*trained .*)?",
}
CHOOSE = ("e_v2x_bm", "best_harm")  # what they do depends on what they minimise
COUNT = re.compile(r"(?i)(first)-impact|(total)|(honest)")
LEAST = re.compile(r"(?:minimises?|harm_count=)\W*(?:the )?\W*(first|total|honest)")
TEST = re.compile(
    r"(?i)(main|obstacle|brake-only) test|((?:paper|cooperation|realistic|stress|recorded|benchmark)-[\w-]+|rainy)"
)
NAMES = {"main": "paper-random", "obstacle": "paper-random-obstacle", "brake-only": "paper-random-brake-only"}
Fact = tuple[tuple[str | None, ...], str]  # (agent, test, count, what it minimises), and the number as it is shown


def named(pattern: re.Pattern[str], *texts: str) -> list[str]:
    words = [next(filter(None, each.groups())).lower() for text in texts for each in pattern.finditer(text)]
    return [NAMES.get(word, word) for word in words]


def agent_of(label: str) -> str | None:
    return next((name for name, words in AGENTS.items() if re.fullmatch(words, label)), None)


def numbers(text: str) -> list[str]:
    return re.findall(r"\d+\.\d+", re.sub(r"\[[^\]]*\]|\([^)]*\)|\d+\.\d+ ?%", "", text))  # no intervals and rates


def of_table(table: str, about: str) -> Iterator[Fact]:
    head, _, *rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    scenario, least = named(TEST, *re.findall(r"--scenario (\S+)", about), about), [*named(LEAST, about), "first"][0]
    test = [*scenario, "paper-random"][0]
    for row in rows if head[0] != "recipe" else ():
        label = next(filter(None, map(agent_of, row)), "")
        test = [*(() if agent_of(row[0]) else named(TEST, row[0])), test][0]
        least = [*named(COUNT, row[-1]), least][0] if row[0].startswith("**") else least
        where = test
        for cell, title in zip(row, head, strict=True):
            where, agent = [*named(TEST, title), where][0], label or agent_of(title)
            counts = named(COUNT, *((title,) if label else (about,) if named(TEST, row[0]) else ()))
            for count, number in zip(counts, numbers(cell) if agent else (), strict=False):
                yield (agent, where, count, least if agent in CHOOSE else None), number


def of_output(text: str, about: str, test: str) -> Iterator[Fact]:
    counts, least = list[str](), [*named(LEAST, about), "first"][0]
    for line in text.splitlines():
        test, agent = [*named(TEST, line), test][0], agent_of(re.split(r"  +", line.strip())[0])
        counts = [*dict.fromkeys(counts + named(COUNT, line))]
        for count, number in zip(counts, numbers(line) if agent else (), strict=False):
            yield (agent, test, count, least if agent in CHOOSE else None), number


def of_page(text: str) -> Iterator[Fact]:
    for section in text.split("\n## "):
        scenario = [*named(TEST, *re.findall(r"--scenario (\S+)", section)), "paper-random"][0]
        for table in TABLE.findall(BLOCK.sub("", section)):
            yield from of_table(table, section)
        for language, block in BLOCK.findall(section):
            yield from of_output(block, section, scenario) if language in ("", "console") else ()


def of_notebook(text: str) -> Iterator[Fact]:
    for cell in json.loads(text)["cells"]:
        source = "".join(cell["source"])
        for output in cell.get("outputs", ()):
            shown = "".join(output.get("text", output.get("data", {}).get("text/html", ())))
            lines = (
                re.sub("<[^>]*>", "  ", shown.replace("\n", "").replace("</tr>", "\n")) if "<td>" in shown else shown
            )
            yield from of_output(lines, source, [*named(TEST, source), "paper-random"][0])


def all_facts() -> dict[tuple[str | None, ...], dict[str, str]]:
    """Key -> number as shown -> a file that shows it."""
    found: dict[tuple[str | None, ...], dict[str, str]] = defaultdict(dict)
    for file in (*TEXTS, *NOTEBOOKS):
        for key, number in (of_notebook if file in NOTEBOOKS else of_page)(file.read_text("utf-8")):
            found[key][number] = file.relative_to(ROOT).as_posix()
    return found


def differ(one: str, other: str) -> bool:
    """Whether two numbers differ when they are rounded to the decimals that both show."""
    digits = min(len(each.partition(".")[2]) for each in (one, other))
    return abs(float(one) - float(other)) > 0.5000001 * 10**-digits


def prose() -> Iterator[tuple[str, str]]:
    """Name and text, in one line, of each page without tables and code, and of each notebook."""
    for page in TEXTS:
        yield page.name, " ".join(TABLE.sub("", BLOCK.sub("", page.read_text("utf-8"))).split())
    for notebook in NOTEBOOKS:
        yield notebook.name, notebook.read_text("utf-8")


def test_number__of_an_agent_in_a_test_is_the_same_on_all_pages() -> None:
    found = all_facts()
    assert len(found) > 70
    assert {key: shown for key, shown in found.items() if any(differ(a, b) for a in shown for b in shown)} == {}


def test_readme__has_numbers_of_agents() -> None:
    facts = of_page((ROOT / "README.md").read_text("utf-8"))
    assert {agent for (agent, *_), _ in facts} == {"full_brake", "e_v2x_bm", "plan", "best_harm"}


def test_number__beside_full_braking_in_a_sentence_is_one_of_the_tables() -> None:
    tables = [number for (agent, *_), shown in all_facts().items() if agent == "full_brake" for number in shown]
    beside = re.compile(r"(\d+\.\d\d) \(full braking\)|[Ff]ull braking (?:costs |does )?(\d+\.\d\d)(?! ?%| more)")
    said = [(name, *filter(None, each.groups())) for name, text in prose() for each in beside.finditer(text)]
    assert len(said) > 5
    assert [each for each in said if all(differ(each[1], number) for number in tables)] == []


SHARES = {"65.1": "contact", "62.3": "impact"}  # proven of the main test


def test_unavoidable__contact_and_impact_have_one_share_each() -> None:
    """A share of worlds in which something is unavoidable says what: contact, or an impact, which is a collision."""
    sentence = re.compile(r"[^.|:]*(?:\.\d[^.|:]*)*")
    said: dict[str, set[str]] = defaultdict(set)
    for name, text in prose():
        for each in sentence.findall(text):
            if re.search(r"unavoidable|cannot avoid|no command", each):
                for share in re.findall(r"(\d+\.\d) ?%", each):
                    said[share].add(name)
                    assert share in SHARES and SHARES[share] in each, (name, each)
    assert said.keys() == SHARES.keys() and min(map(len, said.values())) >= 2


def test_evaluations__drive_the_whole_list() -> None:
    wrong = []
    for page in TEXTS:
        for command in re.findall(r"(?m)^(?:\$ )?(ethbrake evaluate (?:.*\\\n)*.*)", page.read_text("utf-8")):
            [scenario] = re.findall(r"--scenario (\S+)", command) or ["paper-random"]
            usual = "2000" if scenario == "benchmark" else "10000"  # of a group whose tasks are no tests
            number = [*re.findall(r"--episodes (\d+)", command), usual][0]
            whole = "10000" if scenario == "TEST" or scenario in NAMES.values() else "2000"
            trial = re.search(r"robust|runs/ippo", command)
            if number != whole and ("--episodes" in command or "results" in page.parts) and not trial:
                wrong.append((page.name, command))
    assert wrong == []
