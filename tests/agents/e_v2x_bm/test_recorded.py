"""The coupled search finds what it found when each of its steps ran over all worlds at once, to the bit."""

from __future__ import annotations

from tests.agents.e_v2x_bm.recorded import hashes

# By the code of 20 November 2026 (6d87c15); `stress-wide` on worlds that are the same on every processor.
RECORDED = {
    "paper-random first": "eb977f84e862da51",
    "paper-random total": "5a7e4d67e109dd5b",
    "stress-wide first": "6fbae1551393a66b",
    "stress-wide total": "9dda59f1c805c213",
    "cooperation-2-five first": "2825cd3b113bef4d",
    "cooperation-2-five total": "8c25fd12ae0b3644",
    "paper-random-obstacle first": "d0eca3c7efc06914",
    "paper-random-obstacle total": "ead90c9d9c7a9bfc",
    "2 alert 0": "6cb904efc8483c24",
    "2 alert 1": "13f625a162e41fff",
    "2 others 0": "0728ecb5c28b8fd1",
    "2 others 1": "3ba20ebd20680914",
    "2 later 0": "21a20eced1ea519b",
    "2 later 1": "f8a3f81be6bdbd97",
    "2 obstacle 0": "fd91ed2f4876dd27",
    "2 obstacle 1": "1039644effe99f93",
    "4 alert 0": "6666c5f4afb7ac1e",
    "4 alert 2": "9ad7a5ef7b382388",
    "4 alert 3": "7d82f8c206b4f6e0",
    "4 others 0": "cc46d0f6561dfa4b",
    "4 others 2": "3b4c9091c7632ce0",
    "4 others 3": "ce7efeb53082c736",
    "4 later 0": "89f9c72cbc375394",
    "4 later 2": "1029ddbce3d95203",
    "4 later 3": "7ae249d828c2d220",
    "4 obstacle 0": "b1b4be2ddd7dd898",
    "4 obstacle 2": "00a371ab2741ada8",
    "4 obstacle 3": "4cf3087c3be9299f",
    "7 alert 0": "20958775e9ebdc8d",
    "7 alert 3": "37fb39945dee3433",
    "7 alert 6": "61d64faad7e32e10",
    "7 others 0": "cef8fc4481cee921",
    "7 others 3": "fb79ad8e2ff74c9d",
    "7 others 6": "ef3472e372ecca86",
    "7 later 0": "da2e43afe4f29d71",
    "7 later 3": "2f1d846b09424b09",
    "7 later 6": "6b04d206515ab8b3",
    "7 obstacle 0": "71e95c4a167763ef",
    "7 obstacle 3": "be7b766457234825",
    "7 obstacle 6": "c8dc7cdaeea2859b",
}


def test_coupled__finds_what_it_found():
    assert dict(hashes()) == RECORDED
