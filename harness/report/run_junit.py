"""junit.xml: a test case for each characteristic, for expected figures, and for a run that did not complete."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from harness.archive.run_record import RunRecord
from harness.present import text
from harness.present.junit import Case, to_xml
from harness.report import facts
from harness.report.verdict_section import Verdict, verdicts
from harness.scenario.expect import Expect


def to_junit(record: RunRecord, chains: Mapping[int, Sequence[str]]) -> str:
    """A characteristic fails if it is violated, or other than its scenario expects: as in pytest. One that was not
    applicable is skipped, with the reason. `chains` has the blocks of each agent's."""
    return to_xml(facts.title(record), "ucp-run", record.started_at or "", record.wall_s, _cases(record, chains))


def _cases(record: RunRecord, chains: Mapping[int, Sequence[str]]) -> Iterator[Case]:
    judged, expect = verdicts(record), (record.scenario and record.scenario.expect) or Expect()
    if record.outcome == "not supported":
        yield Case("run", skipped=record.outcome_detail or record.outcome)
        return
    if wrong := [*_wrong_with_run(record), *([] if judged else ["There is no verdict."])]:
        yield Case("run", wrong)
    for verdict in judged:
        yield _characteristic(verdict, expect)
    if expect.figures:
        figures: dict[str, float | None] = {name: record.figures.get(name) for name in expect.figures}
        yield Case("expected figures", list(expect.out_of_range(figures)))
    if expect.common:
        yield Case("expected chains", list(expect.other_common(chains)))
    if expect.deviations:
        found = [(finding.agent_id, finding.handler) for finding in (record.steps.evidence if record.steps else ())]
        yield Case("expected deviations", list(expect.other_deviations(found)))


def _wrong_with_run(record: RunRecord) -> Iterator[str]:
    if ended := facts.outcome(record):
        yield ": ".join(filter(None, ended))
    for fate in record.unmatched_fates:
        yield f"{fate}, so this run does not show what it was meant to"


def _characteristic(verdict: Verdict, expect: Expect) -> Case:
    name, expected = verdict.title, expect.verdict(verdict.key)
    if verdict.verdict == expected or (expected is None and verdict.kind == "holds"):
        return Case(name)
    message = f"{verdict.verdict}: {verdict.reason}" if verdict.reason else verdict.verdict
    if expected is None and not verdict.is_bad:
        return Case(name, skipped=message)
    return Case(name, [message, *map(_evidence, verdict.evidence), *([f"expected: {expected}"] if expected else [])])


def _evidence(piece: dict[str, Any]) -> str:
    where = ", ".join(f"{label} {text.value(content)}" for label, content in piece.items() if label != "detail")
    return ": ".join(filter(None, (where, text.value(piece.get("detail") or ""))))
