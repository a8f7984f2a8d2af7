"""The scenario that a run has come to, with what somebody had happen to it: a file that plays it again."""

from collections.abc import Collection
from typing import Any

from harness.backend_names import BackendName
from harness.scenario import Scenario
from harness.scenario.scenario_file import to_yaml

REPLAY_FILE = "replay.yaml"


def replay_of(scenario: Scenario, by_hand_s: Collection[float], seed: int | None, backend: BackendName | None) -> str:
    """The file; `by_hand_s` are the seconds of the timeline's entries that were asked for by hand."""
    document = scenario.model_dump(mode="json", exclude_defaults=True)
    timeline = [{"at_s": entry["at_s"], **entry} for entry in document["timeline"]]
    document["timeline"] = sorted(timeline, key=lambda entry: entry["at_s"])

    def remark(entry: dict[str, Any]) -> str | None:
        return "by hand" if entry.get("at_s") in by_hand_s else None

    comment = [
        "What a run has come to, with what was asked for by hand while it went on. To play it again:",
        f"    ucp-harness run {REPLAY_FILE} --backend {backend} --seed {seed}",
    ]
    return to_yaml(document, comment, remark)
