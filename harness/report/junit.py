"""junit.xml: a test case for each characteristic, for expected figures, and for a run that did not complete."""

from collections.abc import Iterator
from typing import Any

from pydantic import ValidationError

from harness.archive.result import listing, mapping, number
from harness.present import words
from harness.present.junit import Case, to_xml
from harness.report import facts
from harness.report.verdicts import Verdict, verdicts
from harness.scenario.expect import Expect


def to_junit(result: dict[str, Any]) -> str:
    """A characteristic fails if it is violated, or other than its scenario expects: as in pytest. One that was not
    applicable is skipped, with the reason."""
    started_at = words.value(result.get("started_at") or "")
    return to_xml(facts.title(result), "ucp-run", started_at, number(result, "wall_s"), _cases(result))


def _cases(result: dict[str, Any]) -> Iterator[Case]:
    judged, expect = verdicts(result), _expect(result)
    if wrong := [*_wrong_with_run(result), *([] if judged else ["There is no verdict."])]:
        yield Case("run", wrong)
    for verdict in judged:
        yield _characteristic(verdict, expect)
    if expect.figures:
        figures: dict[str, float | None] = {name: number(result, "figures", name) for name in expect.figures}
        yield Case("expected figures", list(expect.out_of_range(figures)))


def _wrong_with_run(result: dict[str, Any]) -> Iterator[str]:
    if ended := facts.outcome(result):
        yield ": ".join(filter(None, ended))
    for fate in listing(result, "unmatched_fates"):
        yield f"{words.value(fate)}, so this run does not show what it was meant to"


def _expect(result: dict[str, Any]) -> Expect:
    """What cannot be read is not expected."""
    try:
        return Expect.model_validate(mapping(result, "scenario", "expect"))
    except ValidationError:
        return Expect()


def _characteristic(verdict: Verdict, expect: Expect) -> Case:
    name, expected = verdict.title, expect.verdict(verdict.key)
    if verdict.verdict == expected or (expected is None and verdict.kind == "holds"):
        return Case(name)
    message = f"{verdict.verdict}: {verdict.reason}" if verdict.reason else verdict.verdict
    if expected is None and not verdict.is_bad:
        return Case(name, skipped=message)
    return Case(name, [message, *map(_evidence, verdict.evidence), *([f"expected: {expected}"] if expected else [])])


def _evidence(piece: dict[str, Any]) -> str:
    where = ", ".join(f"{label} {words.value(content)}" for label, content in piece.items() if label != "detail")
    return ": ".join(filter(None, (where, words.value(piece.get("detail") or ""))))
