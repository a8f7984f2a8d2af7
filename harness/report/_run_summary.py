"""Write short forms of a report: report.md for readers, and junit.xml for build servers."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from harness.archive.run_record import RunRecord
from harness.present import text
from harness.present import text as words
from harness.present.junit import JunitCase, to_xml
from harness.present.text import escaped, row
from harness.report import _fault_sections, _network_section, facts
from harness.report._report_source import ReportSource
from harness.report.verdict_section import VerdictEntry, headline, verdicts
from harness.scenario.expect import AS_EXPECTED, Expect

EVIDENCE_SHOWN = 3
SENTENCES_SHOWN = 8
FAULTS_SHOWN = 12
TEXT_LENGTH = 240


def to_markdown(left: ReportSource) -> str:
    record = left.record
    judged, ended = verdicts(record), facts.outcome(record)
    verdict, _ = headline(judged, completed=ended is None)
    lines = [f"## {_short(facts.title(record))}", "", f"**{verdict}**", ""]
    lines += [_short(" \u00b7 ".join(facts.summary(record, left.exports))), ""]
    if ended:
        lines += [f"**{_short(ended[0])}** {_short(ended[1])}".rstrip(), ""]
    lines += _listed([*left.chains_missing, *left.files_missing, *record.unmatched_fates, *left.unmet_expectations])
    lines += [*_verdict_table(judged), *_evidence(judged)] if judged else []
    if figures := facts.figures(record):
        lines += [" \u00b7 ".join(f"{_short(label)} **{_short(figure)}**" for label, figure in figures), ""]
    if survived := _fault_sections.survival_section(record.survival, left.ink):
        lines += _listed(survived.sentences)
    lines += _fault_table(_network_section.event_rows(record))
    lines += _listed(_network_section.channel(record))
    lines += _listed(_fault_sections.remote_sentences(record))
    lines += _listed([station] if (station := _network_section.ground_station(record)) else [])
    lines += _listed(_fault_sections.rogue_sentences(record.rogue))
    if record.scenario is not None:
        lines += [f"Play this run again: `{facts.command_again(record, 'RUN_DIRECTORY')}`", ""]
    versions = ", ".join(f"{name} {version}" for name, version in record.versions.items())
    return "\n".join([*lines, f"<sub>{_short(versions)}</sub>"]) + "\n"


def _verdict_table(judged: Sequence[VerdictEntry]) -> Iterator[str]:
    yield row(["", "characteristic", "verdict", "reason"])
    yield row(["--:", "---", "---", "---"])
    for verdict in judged:
        yield row(map(_short, [verdict.number, verdict.name, f"{verdict.icon} {verdict.in_words}", verdict.reason]))
    yield ""


def _evidence(judged: Sequence[VerdictEntry]) -> list[str]:
    return _listed(
        f"{verdict.topic}, agent {words.value(piece.get('agent'))}: {words.value(piece.get('detail'))}"
        for verdict in judged
        for piece in (verdict.evidence[:EVIDENCE_SHOWN] if verdict.is_bad else ())
    )


def _fault_table(happened: Sequence[tuple[str, str, str]]) -> Iterator[str]:
    if not happened:
        return
    yield row(["mission time", "fault", ""])
    yield row(["--:", "---", "---"])
    yield from (row(map(_short, thing)) for thing in happened[:FAULTS_SHOWN])
    yield ""
    if len(happened) > FAULTS_SHOWN:
        yield f"{len(happened) - FAULTS_SHOWN} more are in report.html."
        yield ""


def _listed(sentences: Iterable[str]) -> list[str]:
    """Format sentences as a Markdown list of at most `SENTENCES_SHOWN` entries. Without sentences, return no lines."""
    all_sentences = list(sentences)
    items = [f"- {_short(sentence)}" for sentence in all_sentences[:SENTENCES_SHOWN]]
    if len(all_sentences) > SENTENCES_SHOWN:
        items.append(f"- and {len(all_sentences) - SENTENCES_SHOWN} more in report.html")
    return [*items, ""] if items else []


def _short(text: str) -> str:
    return escaped(text if len(text) <= TEXT_LENGTH else f"{text[: TEXT_LENGTH - 1]}\u2026")


def to_junit(record: RunRecord, chains: Mapping[int, Sequence[str]], top_chain_hashes: Mapping[int, str]) -> str:
    """Return the run as JUnit XML. `chains` contains the block hashes of each agent's chain.

    A characteristic fails if it is violated, or if its verdict differs from the verdict that the scenario expects. A
    characteristic that is not applicable is skipped with its reason.
    """
    cases = _cases(record, chains, top_chain_hashes)
    return to_xml(facts.title(record), "ucp-run", record.started_at or "", record.wall_s, cases)


def _cases(
    record: RunRecord, chains: Mapping[int, Sequence[str]], top_chain_hashes: Mapping[int, str]
) -> Iterator[JunitCase]:
    judged, expect = verdicts(record), record.expect
    if record.outcome == "not supported":
        yield JunitCase("run", skipped=record.outcome_detail or record.outcome)
        return
    if wrong := [*_wrong_with_run(record), *([] if judged else ["No verdict."])]:
        yield JunitCase("run", wrong)
    for verdict in judged:
        yield _characteristic(verdict, expect)
    yield from (JunitCase(name, wrong) for name, wrong in record.unmet_expectations(chains, top_chain_hashes))


def _wrong_with_run(record: RunRecord) -> Iterator[str]:
    if ended := facts.outcome(record):
        yield ": ".join(filter(None, ended))
    for fate in record.unmatched_fates:
        yield f"{fate}, so this run differs from its script"


def _characteristic(verdict: VerdictEntry, expect: Expect) -> JunitCase:
    name, expected = verdict.title, expect.verdict(verdict.key)
    message = f"{verdict.verdict}: {verdict.reason}" if verdict.reason else verdict.verdict
    if verdict.remark == AS_EXPECTED:
        return JunitCase(name, note=f"{AS_EXPECTED}: {message}")
    if verdict.verdict == expected or (expected is None and verdict.kind == "holds"):
        return JunitCase(name)
    if expected is None and not verdict.is_bad:
        return JunitCase(name, skipped=message)
    return JunitCase(
        name, [message, *map(_run_junit_evidence, verdict.evidence), *([f"expected: {expected}"] if expected else [])]
    )


def _run_junit_evidence(piece: dict[str, Any]) -> str:
    where = ", ".join(f"{label} {text.value(content)}" for label, content in piece.items() if label != "detail")
    return ": ".join(filter(None, (where, text.value(piece.get("detail") or ""))))
