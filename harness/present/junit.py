"""Write JUnit XML for build servers such as Jenkins, GitLab and GitHub.

The output follows https://github.com/jenkinsci/xunit-plugin, junit-10.xsd, which is the strictest known schema.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

_NOT_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")


@dataclass(frozen=True, slots=True)
class JunitCase:
    """A test case in a JUnit XML file. The test case passed if `skipped` is None and `wrong` is empty."""

    name: str
    wrong: Sequence[str] = ()
    """The lines of the failure message. The first line is a complete message by itself."""
    skipped: str | None = None
    """The reason why the test case was skipped."""
    note: str = ""
    """The output of a passed test case."""


def to_xml(suite: str, classname: str, started_at: str, wall_s: float | None, cases: Iterable[JunitCase]) -> str:
    """Return a JUnit XML file with one test suite. Characters that XML does not allow become question marks."""
    all_cases = list(cases)
    failures, skipped = sum(bool(case.wrong) for case in all_cases), sum(case.skipped is not None for case in all_cases)
    counts = {"tests": str(len(all_cases)), "failures": str(failures), "errors": "0"}
    if wall_s is not None:
        counts["time"] = f"{max(wall_s, 0.0):.1f}"
    named = {"name": _text(suite), "timestamp": _text(started_at)}
    root = ElementTree.Element("testsuites", counts)
    element = ElementTree.SubElement(root, "testsuite", {**named, **counts, "skipped": str(skipped)})
    for case in all_cases:
        testcase = ElementTree.SubElement(element, "testcase", classname=classname, name=_text(case.name))
        if case.wrong:
            failure = ElementTree.SubElement(testcase, "failure", message=_text(case.wrong[0]))
            failure.text = _text("\n".join(case.wrong))
        elif case.skipped is not None:
            ElementTree.SubElement(testcase, "skipped", message=_text(case.skipped))
        elif case.note:
            ElementTree.SubElement(testcase, "system-out").text = _text(case.note)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _text(anything: str) -> str:
    return _NOT_XML.sub("?", anything)
