"""``docs/reference`` is what the package says of itself: ``python -m tests.docs.reference`` writes it."""

import re

import pytest

import ethbrake_marl as eb
from ethbrake_marl.policies.shipped import shipped_policies
from tests.docs import api, reference
from tests.docs.markdown import first_sentence, wrap


@pytest.mark.parametrize("name", reference.PAGES)
def test_page__is_the_one_that_the_code_makes(name: str) -> None:
    committed = (reference.REFERENCE / f"{name}.md").read_text("utf-8")
    assert committed.count(reference.MADE) == 1
    assert committed == reference.whole_page(name), "run: python -m tests.docs.reference"


def test_pages__are_all_made() -> None:
    there = {
        path.relative_to(reference.REFERENCE).with_suffix("").as_posix() for path in reference.REFERENCE.rglob("*")
    }
    assert there - {"api", "README"} == {*reference.PAGES} - {"api"}


def test_public_names__stand_once_each_on_the_pages_by_task(monkeypatch: pytest.MonkeyPatch) -> None:
    listed = [name for parts in api.groups().values() for names in parts.values() for name in names]
    assert {*eb.__all__} - {*listed} == {"__version__"}
    assert "extensions.certified.parse_uncertainty" in listed
    monkeypatch.setattr(api.ethbrake_marl, "__all__", [*eb.__all__, "planted"])
    with pytest.raises(ValueError, match=r"each public name belongs on one page .*: planted"):
        api.groups()


def test_public_name__without_a_docstring_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eb, "Policy", type("Planted", (), {}))
    with pytest.raises(ValueError, match="the public name Policy has no docstring"):
        api.describe("Policy")


def test_public_name__is_described_with_arguments_example_and_members() -> None:
    worlds, made = api.describe("Worlds"), api.describe("make_worlds")
    assert "| `gaps_m` | [n, P] bumper to bumper, >= 0" in worlds and "| `n` | Number of worlds. |" in worlds
    assert "- `latency_s`: time before which commands have no effect, s, broadcast to [n, N]." in made
    assert made.startswith("### `make_worlds`\n\n```python\nmake_worlds(\n    gaps_m: ArrayLike,\n")
    assert "```pycon\n>>> import ethbrake_marl as eb\n" in worlds
    assert "| `NO_CERTIFICATE` = 3 | no certificate |" in api.describe("ShieldReason")
    assert "Another name of [`parallel_env`](#parallel_env)." in api.page("environments")


def test_tables__have_every_command_key_and_policy() -> None:
    commands, names = reference.command_line(), shipped_policies()
    assert "\n## train\n" in commands and "| `--other-versions` |" in commands and "\n### study ablate\n" in commands
    assert "| `mass_t` | mass of each vehicle | (0, 1000] t | required |" in reference.scenario_keys()
    assert re.findall(r"^## (\S+)$", reference.cards(), re.MULTILINE) == sorted(names)
    rows = reference.policies().splitlines()[2:]
    assert [row.split("`")[1] for row in rows] == list(names)
    assert [row.split("`")[1] for row in rows if row.endswith("|  |")] == ["universal"]  # the others say why they ship
    for name in reference.PAGES:
        made = reference.whole_page(name)
        assert "m/s2" not in re.sub(r"```.*?```|`[^`]*`", "", made, flags=re.DOTALL), name


@pytest.mark.parametrize(
    ("text", "sentence"),
    [("Return it. And more.", "Return it."), ("From ``a`` ... to b. More", "From `a` ... to b."), ("no end", "no end")],
)
def test_first_sentence__ends_at_a_full_stop(text: str, sentence: str) -> None:
    assert first_sentence(text) == sentence


def test_wrap__begins_no_line_like_a_list() -> None:
    lines = wrap("x" * 96 + " - y m2/s2").splitlines()
    assert all(not line.startswith("- ") for line in lines) and lines[-1].endswith("m²/s²")
