"""Test the chain tree as SVG: valid, with a description, and with the name and holders of each block."""

import re
from xml.etree import ElementTree

from harness.present.colours import inks
from harness.report.chain_tree_svg import ChainTreePicture
from tests.harness.report.runs import Chains, block, exports

SVG = "{http://www.w3.org/2000/svg}"


def picture(chains: Chains) -> ChainTreePicture:
    return ChainTreePicture(exports(chains), inks([*chains, 1, 2, 3, 4, 5, 65535]))


def titles(drawing: str) -> list[str]:
    return [element.text or "" for element in ElementTree.fromstring(drawing).iter(f"{SVG}title")]  # noqa: S314 - ours


def test_the_file_is_valid_xml_and_refers_to_nothing() -> None:
    drawing = picture({1: "1.1 2.1", 2: "1.1"}).standalone()
    assert ElementTree.fromstring(drawing).tag == f"{SVG}svg"  # noqa: S314 - ours
    assert set(re.findall(r"https?://[^\"']*", drawing)) == {"http://www.w3.org/2000/svg"}
    assert "href" not in drawing


def test_tooltip_of_a_block_has_name_time_hash_and_holders() -> None:
    drawing = picture({1: "1.1 2.1 3.1", 2: "1.1 3.1", 3: "1.1 3.1"}).draw("full")
    (both, *others) = [title for title in titles(drawing) if title.startswith("3.1")]
    assert block("3.1").block_hash.hex() in both
    assert "made by agent 3" in both
    assert "30.000 s" in both
    assert "in the chain of agents 1\u20133" in both
    assert len(others) == 1, "one box on each branch"
    assert "with this history: agent 1" in both


def test_tooltip_of_an_ellipsis_names_its_hidden_blocks() -> None:
    drawn = picture({1: [f"1.{n}" for n in range(1, 36)]})
    assert drawn.hidden == 29
    assert "1.4 to 1.32, of agent 1" in titles(drawn.draw("abridged"))


def test_description_is_a_text_alternative_for_the_picture() -> None:
    described = picture({1: "1.1 2.1", 2: "1.1", 3: "1.1 2.1"}).description()
    assert described.startswith("agents 1\u20133: all share 1 block, up to 1.1.")
    assert "agent 2 at 1.1" in described
    assert "agents 1, 3 at 2.1" in described


def test_both_forms_can_stand_on_one_page() -> None:
    drawn = picture({1: [f"1.{n}" for n in range(1, 36)]})
    both = str(drawn.draw("abridged") + drawn.draw("full"))
    ids = re.findall(r' id="([^"]*)"', both)
    assert len(ids) == len(set(ids)) == 4


def test_equal_exports_give_the_same_bytes() -> None:
    chains = {3: "1.1 3.1", 1: "1.1 2.1", 2: "1.1"}
    assert picture(chains).standalone() == picture(dict(reversed(chains.items()))).standalone()
