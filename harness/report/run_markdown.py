"""report.md: the run in short, for a pull request or a message to the team."""

from collections.abc import Iterable, Iterator, Sequence

from harness.present import text as words
from harness.present.markdown import escaped, row
from harness.report import facts, network_section, rogue_section, survival_section
from harness.report.report_source import ReportSource
from harness.report.verdict_section import Verdict, headline, verdicts

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
    lines += _listed([*left.chains_missing, *left.files_missing, *record.unmatched_fates])
    lines += [*_verdict_table(judged), *_evidence(judged)] if judged else []
    if figures := facts.figures(record):
        lines += [" \u00b7 ".join(f"{_short(label)} **{_short(figure)}**" for label, figure in figures), ""]
    if survived := survival_section.section(record.survival, left.ink):
        lines += _listed(survived.sentences)
    lines += _happened(network_section.happened(record))
    lines += _listed([station] if (station := network_section.ground_station(record)) else [])
    lines += _listed(rogue_section.sentences(record.rogue))
    versions = ", ".join(f"{name} {version}" for name, version in record.versions.items())
    return "\n".join([*lines, f"<sub>{_short(versions)}</sub>"]) + "\n"


def _verdict_table(judged: Sequence[Verdict]) -> Iterator[str]:
    yield row(["", "characteristic", "verdict", "reason"])
    yield row(["--:", "---", "---", "---"])
    for verdict in judged:
        yield row(map(_short, [verdict.number, verdict.name, f"{verdict.icon} {verdict.verdict}", verdict.reason]))
    yield ""


def _evidence(judged: Sequence[Verdict]) -> list[str]:
    return _listed(
        f"{verdict.topic}, agent {words.value(piece.get('agent'))}: {words.value(piece.get('detail'))}"
        for verdict in judged
        for piece in (verdict.evidence[:EVIDENCE_SHOWN] if verdict.is_bad else ())
    )


def _happened(happened: Sequence[tuple[str, str, str]]) -> Iterator[str]:
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
    """An item for each; nothing, if there is none."""
    all_sentences = list(sentences)
    items = [f"- {_short(sentence)}" for sentence in all_sentences[:SENTENCES_SHOWN]]
    if len(all_sentences) > SENTENCES_SHOWN:
        items.append(f"- and {len(all_sentences) - SENTENCES_SHOWN} more in report.html")
    return [*items, ""] if items else []


def _short(text: str) -> str:
    return escaped(text if len(text) <= TEXT_LENGTH else f"{text[: TEXT_LENGTH - 1]}\u2026")
