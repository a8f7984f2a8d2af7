"""Test the page of a merged record: its content agrees with the record, it loads no files, and all data are escaped."""

import base64
import json
from pathlib import Path
from typing import Any, Literal

import pytest

from harness.archive.exports import Export
from harness.field.depot.collected_exports import collect_exports
from harness.field.depot.consolidation import MergedRecord, consolidate
from harness.field.depot.depot_reconcile import reconcile
from harness.field.depot.page import draw
from tests.harness.commands.test_chain_command import fly_vehicles
from tests.harness.field.depot.exports import consolidated, document, make_block, write_exports
from tests.harness.mission import write_exports as write_flown
from tests.harness.report.browser import Browser
from tests.harness.report.test_page import HOSTILE, Reader

WIDE, NARROW = 1280, 390


@pytest.fixture(scope="module")
def consolidated_flight(tmp_path_factory: pytest.TempPathFactory) -> MergedRecord:
    """Merge the records of four vehicles. One vehicle has no export. Another one lost two blocks and holds one on its
    stack.
    """
    directory = tmp_path_factory.mktemp("home")
    for path in write_flown(fly_vehicles(4, 700), directory):
        export: dict[str, Any] = json.loads(path.read_text())
        if export["agent_id"] == 4:
            path.unlink()
            continue
        if export["agent_id"] == 2:
            gone = set(export["completed"][1:3])
        if export["agent_id"] == 3:
            top = export["chain"].pop()
            export["reconcile_stack"] = [{**top, "chain_hash": None}]
        path.write_text(json.dumps(export))
    for path in directory.glob("*.chain.json"):
        export = json.loads(path.read_text())
        for place in ("chain", "blocks_to_be_committed", "reconcile_stack"):
            export[place] = [block for block in export[place] if block["block_hash"] not in gone]
        path.write_text(json.dumps(export))
    return consolidate(collect_exports([directory]))


def test_page_agrees_with_the_record(consolidated_flight: MergedRecord) -> None:
    page = Reader(draw(consolidated_flight, reconcile(consolidated_flight)))
    headings = (
        "Collected exports",
        "Positions",
        "Events over time",
        "Holders of blocks",
        "Lost",
        "Chains",
        "Final reconcile",
        "Vehicles",
    )
    at = [page.text.rindex(heading) for heading in headings[:4]]
    assert at == sorted(at)
    assert all(heading in page.text for heading in headings)
    assert "1 vehicle and 2 blocks lost" in page.text
    assert "vehicles with an export 3 of 4" in page.text
    assert "vehicle 4 has no export" in page.text
    for lost in consolidated_flight.lost_blocks:
        assert f"block {lost.block}" in page.text
    classes = [attributes.get("class") for tag, attributes in page.elements if tag in ("rect", "g")]
    assert {"gone", "at-chain", "at-stack", "track gap", "copies3"} <= set(classes)
    for block in consolidated_flight.blocks:
        assert block.line.name in page.text


def test_page_loads_no_resources(consolidated_flight: MergedRecord) -> None:
    page = Reader(draw(consolidated_flight))
    tags = [tag for tag, _ in page.elements]
    assert "script" not in tags
    assert not {"src", "srcset"} & {name for _, attributes in page.elements for name in attributes}
    assert all(
        (attributes.get("href") or "").startswith(("#", "data:"))
        for _, attributes in page.elements
        if "href" in attributes
    )


def test_page_escapes_data_from_vehicles(tmp_path: Path) -> None:
    hostile = document(1, "1.1", data=HOSTILE.encode())
    path = tmp_path / "<img src=x>.chain.json"
    path.write_text(json.dumps(hostile))
    (tmp_path / "<b>2.chain.json").write_text("{")
    page = Reader(draw(consolidate(collect_exports([tmp_path]))))
    assert not {"img", "b"} & {tag for tag, _ in page.elements}
    assert "<img src=x>.chain.json" in page.text


@pytest.mark.parametrize("chain", ["", "1.1"])
def test_page_is_drawn_for_the_smallest_record(tmp_path: Path, chain: str) -> None:
    page = Reader(draw(consolidated(tmp_path, document(1, chain))))
    assert "No vehicle logged a position." in page.text


def test_time_span_ignores_wrong_clocks(tmp_path: Path) -> None:
    agent = document(1, " ".join(f"1.{number}" for number in range(1, 200)))
    export = Export.model_validate(agent)
    late = make_block(2, 1)
    other = document(2, "2.1")
    data = bytearray(late.event_data)
    data[0:8] = (2**64 - 1).to_bytes(8, "big")
    other["chain"] = []
    other["current_block"]["event_data"] = base64.b64encode(bytes(data)).decode()
    write_exports(tmp_path, {1: export, 2: Export.model_validate(other)})
    assert "1 events are outside" in Reader(draw(consolidate(collect_exports([tmp_path])))).text


def test_page_stays_small_with_many_columns(tmp_path: Path) -> None:
    chains = {agent: " ".join(f"{agent}.{number}" for number in range(1, 250)) for agent in range(1, 9)}
    page = draw(consolidated(tmp_path, *(document(agent, chain) for agent, chain in chains.items())))
    assert page.count('class="at-chain part"') < 8 * 900
    assert "some of" in page


# In a browser


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [NARROW, WIDE])
def test_page_renders_completely_without_console_messages(
    browser: Browser, consolidated_flight: MergedRecord, tmp_path: Path, width: int, scheme: Literal["light", "dark"]
) -> None:
    page = tmp_path / "mission.html"
    page.write_text(draw(consolidated_flight, reconcile(consolidated_flight)), encoding="utf-8")
    browser.show(page, width=width, scheme=scheme)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    pictures = "[...document.querySelectorAll('.map, .along, .holdings')].map(p => p.getBoundingClientRect().right)"
    assert len(browser.evaluate(pictures)) == 3
    assert max(browser.evaluate(pictures)) <= width
    ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
    assert ground == {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 26)"}[scheme]
    assert browser.complaints == []
