"""Fuzz target: a scenario in YAML. The reader refuses it in one sentence, or the writer reproduces it.

The target also plays short scenarios, so that scripted deliveries, delays, datagrams and events are not only read but
take effect.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

from harness.errors import HarnessError
from harness.run.simulate import simulate
from harness.scenario import Scenario
from harness.scenario.load import LIBRARY, load_scenario, parse
from harness.scenario.scenario_file import ORDER, to_yaml
from tests.fuzz.finding import require, sound

MOST_AGENTS = 4
MOST_S = 100.0
MOST_ENTRIES = 60
LARGEST_SEED = 1500
SHORT = """\
name: Short
agents: 3
duration_s: 60
network: {loss: 0.1, delay: {mean_s: 0.05, jitter_s: 0.01}}
settings: {max_block_bytes: 300, vote_timeout_s: 4}
quirks: {ignore_commit: {agents: [2], value: 0.5}}
clocks: {2: {offset_s: 1.5, drift: 0.001}}
timeline:
  - {at_s: 12, partition: [[1, 2], [3]]}
  - {at_s: 20, heal: true}
  - {at_s: 25, reboot: [2], down_s: 3, disk: kept}
  - {at_s: 40, reconcile: [3]}
events:
  source: scripted
  script:
    - {at_s: 1, agent: 1, bytes: 250}
    - {at_s: 2, agent: 1, bytes: 250}
    - {at_s: 2.5, agent: 2, event_id: 3, data: AAEC, timestamp_us: 7}
fates:
  - {message: Commit Block, block: "1.1", receiver: 2, drop: true}
  - {message: Block Add Response, sender: 3, name: third}
  - {message: Block Add Response, sender: 2, after: third}
  - {sender: 3, from_s: 30, until_s: 35, hold_until_s: 36}
  - {sender: 3, receiver: 1, arrivals: 0@12.3 1@12.75 4@31}
datagrams:
  - {source: 9, datagram: VUMBBQ==, reaches: {1: 8.5}}
lateness: {1: 0+0.5 2+0.25}
settle: {limit_s: 50}
final_reconcile: true
"""


def run(data: bytes) -> None:
    with TemporaryDirectory() as directory:
        path = Path(directory) / "fuzz.yaml"
        path.write_bytes(data)
        try:
            scenario = load_scenario(path)
        except HarnessError as error:
            sound(str(error))
            return
        document = scenario.model_dump(mode="json", by_alias=True, exclude_defaults=True)
        require(parse(json.loads(json.dumps(document))) == scenario, "a scenario on record is read otherwise")
        if document.keys() <= set(ORDER):
            path.write_text(to_yaml(document, ["written"]), encoding="utf-8")
            require(load_scenario(path) == scenario, "a scenario is written otherwise")
    if _short(scenario):
        try:
            played = simulate(scenario, 1, tracing=True)
        except HarnessError as error:
            sound(str(error))
            return
        require(played.played.outcome == "completed", f"it is not completed: {played.played.outcome_detail}")
        for judgement in played.result.judgements.values():
            sound(judgement.reason)


def _short(scenario: Scenario) -> bool:
    """Return whether the scenario takes little time and starts no program that the input names."""
    entries = len(scenario.events.script) + len(scenario.timeline) + len(scenario.datagrams) + len(scenario.fates)
    injects = any(entry.injection for entry in scenario.timeline)
    return (
        len(scenario.roster) <= MOST_AGENTS
        and scenario.duration_s <= MOST_S
        and scenario.settle.limit_s <= MOST_S
        and entries <= MOST_ENTRIES
        and not scenario.schedule
        and not injects
        and not scenario.flight
        and scenario.agent_command is None
    )


def seeds(flown: Path) -> Iterator[bytes]:
    """Yield the included scenarios, and a short scenario that uses every list."""
    for scenario in sorted(LIBRARY.glob("*.yaml")):
        if scenario.stat().st_size < LARGEST_SEED:
            yield scenario.read_bytes()
    yield SHORT.encode()
