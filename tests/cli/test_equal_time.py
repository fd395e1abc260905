from __future__ import annotations

import json


def test_equal_time__compares_a_search_with_a_policy(ethbrake):
    arguments = ("--episodes", 4, "--repeats", 1, "--agents", "ppo@shipped,best_harm:50", "--against", "ppo@shipped")
    answer = ethbrake("equal-time", *map(str, arguments), "--json")
    assert answer.status == 0, answer.err
    found = json.loads(answer.out)
    assert (found["scenario"], found["seed"], found["episodes"], found["harm_count"]) == ("paper-random", 8, 4, "first")
    assert {row["agent"]: row["knows"] for row in found["agents"]} == {
        "ppo@shipped": "messages",
        "best_harm:50": "true model",
    }
    assert {row["agent"]: row["difference"] for row in found["agents"]}["ppo@shipped"] == 0.0
    text = ethbrake("equal-time", *map(str, arguments))
    assert "best_harm:50 true model" in " ".join(text.out.split())
    assert "paper-random: 4 worlds, seed 8; first harm minimised. Machine: " in text.out


def test_equal_time__refuses_worlds_that_a_table_holds(ethbrake):
    answer = ethbrake("equal-time", "--seed", "7", "--episodes", "5", "--agents", "best_harm:50,full_brake")
    assert answer.status == 2
    assert "--seed 7: a shipped table holds 5 of these 5 worlds" in answer.err
