"""junit.xml: a test case for each cell, as build servers read them."""

import re
from xml.etree import ElementTree

from harness.matrix.record import MatrixRecord
from harness.matrix.table import name_of, troubles

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def to_junit(record: MatrixRecord) -> str:
    """A cell fails if a run of it violated a characteristic or failed, or if it is worse than the baseline; a cell
    without all its runs is skipped."""
    cells = {cell.point: cell for cell in record.cells}
    suite = ElementTree.Element("testsuite", name=_text(record.matrix.name), timestamp=record.started_at)
    failures = skipped = 0
    for point in record.matrix.points:
        case = ElementTree.SubElement(suite, "testcase", classname="matrix", name=name_of(record.matrix, point))
        cell = cells.get(point)
        wrong = list(troubles(record, cell)) if cell else []
        if wrong:
            failures += 1
            failure = ElementTree.SubElement(case, "failure", message=_text(wrong[0]))
            failure.text = _text("\n".join(wrong))
        elif cell is None or cell.runs < len(record.matrix.seed_list):
            skipped += 1
            ended = cell.runs if cell else 0
            message = f"interrupted: {ended} of {len(record.matrix.seed_list)} runs had ended"
            ElementTree.SubElement(case, "skipped", message=message)
    suite.attrib |= {"tests": str(len(suite)), "failures": str(failures), "errors": "0", "skipped": str(skipped)}
    suites = ElementTree.Element("testsuites")
    suites.append(suite)
    ElementTree.indent(suites)
    return ElementTree.tostring(suites, encoding="unicode", xml_declaration=True) + "\n"


def _text(anything: str) -> str:
    return _NOT_XML.sub("?", anything)
