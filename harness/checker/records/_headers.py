"""Compare the headers of all traces with each other, and check that the Algorithm number of each trace line belongs to
the handler's name.

With the key `stagger`, a scenario gives each agent a different addition to its timers. The comparison therefore
subtracts this addition. The clocks of other computers differ at mission second 0. run.json contains the time that each
of these clocks showed at mission second 0.
"""

from collections.abc import Iterator
from typing import Any

from harness.checker.evidence import Evidence
from harness.checker.records.contradiction import Contradiction, of_agent
from harness.checker.reference.algorithms import HANDLERS

WORDS = {"epoch_us": "mission second 0", "initial_data": "the inception block's data"}
MAX_VALUE = 40


def compare_headers(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each trace header whose roster, settings, clock or inception block differs from the other headers."""
    first: dict[str, tuple[object, str]] = {}
    if evidence.record is not None:
        first["roster"] = sorted(evidence.record.roster), "run.json"
    for agent_id, export in evidence.exports.items():
        first.setdefault("initial_data", (export.inception.block_data, f"the export of agent {agent_id}"))
    for agent_id, trace in evidence.traces.items():
        header = trace.header
        expected: dict[str, object] = {"roster": sorted(header.roster)}
        expected |= {f"settings.{name}": value for name, value in _in_common(evidence, agent_id).items()}
        expected["speedup"] = header.clock.get("speedup")
        remote = evidence.remote(agent_id)
        if remote is None or remote.epoch_us is None:
            expected["epoch_us"] = header.clock.get("epoch_us")
        elif remote.epoch_us != header.clock.get("epoch_us"):
            detail = f"its trace has {_short(header.clock.get('epoch_us'))} as {WORDS['epoch_us']}, but run.json has "
            yield of_agent(agent_id, f"{detail}{remote.epoch_us} for the clock of its computer")
        if header.initial_data is not None:
            expected["initial_data"] = header.initial_data
        for name, value in expected.items():
            common, source = first.setdefault(name, (value, f"the trace of agent {agent_id}"))
            if value != common:
                what = WORDS.get(name, name)
                detail = f"its trace has {_short(value)} as {what}, but {source} has {_short(common)}"
                yield of_agent(agent_id, detail)


def _in_common(evidence: Evidence, agent_id: int) -> dict[str, object]:
    """Return the settings of the agent that must be equal for all agents. The agent's own addition to each timer
    duration is subtracted.
    """
    settings: dict[str, Any] = {**evidence.traces[agent_id].header.settings}
    record = evidence.record
    if record is None or not record.stagger or agent_id not in record.roster:
        return settings
    place = sorted(record.roster).index(agent_id)
    for name, step_s in record.stagger.items():
        if isinstance(settings.get(name), int | float):
            settings[name] = round(settings[name] - step_s * place, 6)
    return settings


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= MAX_VALUE else f"{text[:MAX_VALUE]}..."


ALGORITHM = {name: handler.algorithm for name, handler in HANDLERS.items()}


def compare_algorithms(evidence: Evidence) -> Iterator[Contradiction]:
    """Yield each trace line whose Algorithm number does not belong to its handler. No other check reads this number."""
    for agent_id, trace in evidence.traces.items():
        said = dict.fromkeys((run.handler, run.algorithm) for run in trace.runs)
        for handler, number in said:
            if handler in ALGORITHM and number != ALGORITHM[handler]:
                detail = f"its trace has {handler} as Algorithm {number}, but it is Algorithm {ALGORITHM[handler]}"
                yield of_agent(agent_id, detail)
