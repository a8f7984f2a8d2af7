"""The strip of what the network did along mission time, from the scenario of a run."""

import re

from harness.report.network import strip
from tests.harness.virtual import scenario


def test_what_is_for_a_while_passes_and_shows_what_stood_before() -> None:
    one = scenario(
        duration_s=600,
        network={"loss": 0.1},
        timeline=[
            {"at_s": 300, "network": {"loss": 0.5}, "for_s": 60},
            {"at_s": 60, "loss": 0.2},
            {"at_s": 120, "partition": [[1, 2]], "for_s": 240},
            {"at_s": 180, "partition": [[3]], "for_s": 60},
            {"at_s": 400, "network": {"links": [{"from": 1, "to": 2, "loss": 0.9}]}},
        ],
    )
    drawn = strip(one, [])
    assert re.findall(r"<title>((?:loss|partition): .*?)</title>", str(drawn).replace("\u00a0", " ")) == [
        "partition: 1, 2, 2 min to 3 min",
        "partition: 3, 3 min to 4 min",
        "partition: 1, 2, 4 min to 6 min",
        "loss: 10 %, 0 s to 60 s",
        "loss: 20 %, 60 s to 5 min",
        "loss: 50 %, 5 min to 6 min",
        "loss: 20 %, 6 min to 10 min",
    ]
