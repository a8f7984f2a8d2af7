"""Test that the schemas and test vectors of the agent contract agree with the code, and that the contract explains all
names.
"""

import copy
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

import ucp
from docs.generate.settings import table
from harness.play.process.agent_mission import mission_file
from harness.scenario import Scenario
from tests.ucp.test_node import AgentUnderTest, mission
from ucp.agent import HANDLERS, ON_MESSAGE, ON_TIMER
from ucp.contract import schemas, vectors
from ucp.contract.schemas._control_schema import MAY_BE_MISSING, REQUESTS, STATUS
from ucp.contract.schemas._trace_schema import DROPS, OPERATIONS, SECURED_DROPS
from ucp.contract.vectors.replay import differences
from ucp.features import FEATURES, needed_features
from ucp.messages import RequestForBlock, encode
from ucp.sealed import seal_to
from ucp.settings import ALTERNATIVES, Settings

PAGE = (Path(ucp.__path__[0]) / "contract" / "CONTRACT.md").read_text(encoding="utf-8")
TRANSCRIPTS = sorted(vectors.MISSIONS.glob("*.jsonl"))

Document = dict[str, Any]


@cache
def validator(name: str) -> Draft202012Validator:
    schema = schemas.generate(name)
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


def fits(name: str, document: object) -> bool:
    return bool(validator(name).is_valid(document))


def test_vector_files_are_up_to_date() -> None:
    texts = vectors.texts()
    for path, text in texts.items():
        assert path.read_text(encoding="ascii") == text, "run `python -m ucp.contract.vectors`"
    assert {*texts} == {*vectors.DIRECTORY.glob("*.json"), *vectors.MISSIONS.iterdir()}


# The page


def test_page_lists_each_handler_with_its_number_and_branches() -> None:
    chapters = re.split(r"^(?=\d+ +[a-z_0-9]+\()", PAGE, flags=re.MULTILINE)
    chapter_texts = {chapter.split("(")[0]: chapter.split("```")[0] for chapter in chapters[1:]}
    assert set(chapter_texts) == {f"{handler.algorithm:<2} {handler.name}" for handler in HANDLERS.values()}
    for handler in HANDLERS.values():
        branches = re.findall(r'"([^"]+)"', chapter_texts[f"{handler.algorithm:<2} {handler.name}"])
        assert {*branches} == {*handler.branches}, handler.name


def test_page_has_the_table_of_settings() -> None:
    page = PAGE.partition("<!-- table: begin -->\n")[2].partition("<!-- table: end -->")[0]
    assert page == table(), "run `python -m docs.generate.settings`"


@pytest.mark.parametrize(
    "words",
    [
        [message.NAME for message in ON_MESSAGE],
        ON_TIMER,
        OPERATIONS,
        [*DROPS, *SECURED_DROPS],
        FEATURES,
        [setting.name for setting in fields(Settings)],
        [f'{{"command": "{command}"' for command in REQUESTS],
        STATUS | MAY_BE_MISSING,
        ["message", "timer", "event", "local", "operator", "boot"],
    ],
    ids=["messages", "timers", "operations", "drops", "features", "settings", "commands", "status", "triggers"],
)
def test_page_contains_every_name_of_the_formats(words: list[str]) -> None:
    assert not [word for word in words if word not in PAGE]


def test_mission_file_on_the_page_is_valid() -> None:
    (text,) = re.findall(r'^```json\n({\n  "schema": "ucp-mission/1".*?^})\n```$', PAGE, re.MULTILINE | re.DOTALL)
    assert fits("mission", json.loads(text))


# The schemas, against real files


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, list[Document]]]:
    """Play a mission with an agent. Yield its inputs, its outputs, and the content of its files."""
    directory = tmp_path_factory.mktemp("agent")
    document = mission()
    agent = AgentUnderTest(directory, document)
    exchanges = []

    def ask(command: str, **arguments: Any) -> None:
        request = {"command": command, **arguments}
        exchanges.append({"request": request, "answer": agent.ask(command, **arguments)})

    ask("status")
    agent.start()
    for _ in range(3):
        ask("log", event_id=7, data="AAAA" * 84)
    agent.send(b"what is no message")
    agent.send(encode(9, 0, RequestForBlock(bytes(32))))
    agent.wait_for(lambda: agent.ask("status")["chain"] == 1)
    ask("reconcile")
    agent.wait_for(lambda: agent.ask("status")["idle"])
    for command in ("status", "stop_events", "export"):
        ask(command)
    ask("quirk", name="ignore_commit", value=0.5)
    agent.process.terminate()
    assert agent.process.wait(10) == 0
    yield {
        "mission": [document],
        "control": exchanges,
        "chain-export": [json.loads((directory / "7.chain.json").read_text())],
        "trace": [json.loads(line) for line in (directory / "7.trace.jsonl").read_text().splitlines()],
    }


@pytest.mark.parametrize("name", ["mission", "control", "chain-export", "trace"])
def test_inputs_and_outputs_of_an_agent_fit_their_schemas(left: dict[str, list[Document]], name: str) -> None:
    for document in left[name]:
        validator(name).validate(document)


def test_mission_files_fit_their_schema_and_name_needed_features() -> None:
    plain = Scenario.model_validate({"name": "plain"})
    rich = Scenario.model_validate(
        {
            "name": "rich",
            "quirks": {"ignore_commit": 0.5},
            "settings": {**dict(ALTERNATIVES.values()), "answer_spread_s": 0.5},
            "events": {"source": "mavlink"},
        }
    )
    addresses = {"address": "10.0.0.1", "broadcast": "10.0.0.255"}
    without = mission_file(1, plain, 0, b"", with_vehicle=False, **addresses)
    with_all = mission_file(
        1, rich, 0, seal_to(b"", bytes(32)), with_vehicle=True, store="1.store", bundle="1.bundle.json", **addresses
    )
    assert (without["contract"], without["features"]) == (2, [])
    assert with_all["features"] == [*FEATURES] == needed_features(with_all)
    for document in (without, with_all):
        validator("mission").validate(document)


@pytest.mark.parametrize("transcript", TRANSCRIPTS, ids=lambda path: path.stem)
def test_transcript_fits_its_schema(transcript: Path) -> None:
    for line in transcript.read_text().splitlines():
        validator("virtual").validate(json.loads(line))


Change = Callable[[Document], object]

REFUSED: dict[str, tuple[Change, ...]] = {
    "mission": (
        lambda document: document.update(schema="ucp-mission/2"),
        lambda document: document.pop("roster"),
        lambda document: document.update(roster=[]),
        lambda document: document.update(agent_id=0),
        lambda document: document.update(initial_data="!"),
        lambda document: document.update(speedup=0),
        lambda document: document["network"].update(port=65536),
        lambda document: document.update(settings={"vote_timeout_s": -1}),
        lambda document: document.update(settings={"phase1_tie": "both"}),
        lambda document: document["events"].update(source="dice"),
        lambda document: document.update(features="store"),
    ),
    "chain-export": (
        lambda export: export.pop("completed"),
        lambda export: export["chain"][0].update(chain_hash=None),
        lambda export: export["chain"][0].update(block_hash="AB" * 32),
        lambda export: export["chain"][0].update(timestamp_us=-1),
        lambda export: export.update(blocks_to_be_committed=export["chain"]),
        lambda export: export.update(idle="yes"),
        lambda export: export["current_block"].update(event_data="A"),
    ),
}

LINES_REFUSED: tuple[tuple[str, Change], ...] = (
    ("schema", lambda line: line.pop("initial_data")),
    ("schema", lambda line: line["settings"].pop("vote_timeout_s")),
    ("dropped", lambda line: line.update(dropped="not understood")),
    ("command", lambda line: line.pop("request")),
    ("handler", lambda line: line.update(handler="commit_it")),
    ("handler", lambda line: line.update(algorithm=line["algorithm"] % 20 + 1)),
    ("handler", lambda line: line.update(branch="no branch")),
    ("handler", lambda line: line.update(trigger={"timer": "vote"})),
    ("handler", lambda line: line.update(trigger={})),
    ("handler", lambda line: line["changes"].append(["chain*", "00" * 32])),
    ("handler", lambda line: line["changes"].append(["chain+"])),
    ("handler", lambda line: line["state"].pop("top")),
    ("handler", lambda line: line["sent"].append({"message": "Hello"})),
    ("handler", lambda line: line.update(started={"vote": 10.0})),
    ("handler", lambda line: line.update(tally={"yes": 1})),
    ("handler", lambda line: line.pop("t")),
    ("input", lambda line: line.pop("input")),
)


@pytest.mark.parametrize(
    ("name", "number"), [(name, number) for name, changes in REFUSED.items() for number in range(len(changes))]
)
def test_wrong_documents_do_not_fit_their_schemas(left: dict[str, list[Document]], name: str, number: int) -> None:
    (document,) = copy.deepcopy(left[name])
    assert fits(name, document)
    REFUSED[name][number](document)
    assert not fits(name, document)


@pytest.mark.parametrize(("kind", "change"), LINES_REFUSED)
def test_wrong_trace_line_does_not_fit_its_schema(left: dict[str, list[Document]], kind: str, change: Change) -> None:
    lines = [copy.deepcopy(line) for line in left["trace"] if kind in line]
    assert lines
    for line in lines:
        change(line)
        assert not fits("trace", line), line


def test_wrong_exchange_does_not_fit_its_schema(left: dict[str, list[Document]]) -> None:
    for exchange in left["control"]:
        answer = exchange["answer"]
        assert fits("control", {**exchange, "answer": {"ok": False, "unsupported": True, "error": "no such command"}})
        assert not fits("control", {**exchange, "answer": {"ok": False}})
        assert not fits("control", {**exchange, "answer": {**answer, "ok": "true"}})
        assert not fits("control", {**exchange, "request": {"command": "fly"}})
    status = next(exchange for exchange in left["control"] if exchange["request"]["command"] == "status")
    for key in STATUS:
        lacking = {name: value for name, value in status["answer"].items() if name != key}
        assert not fits("control", {**status, "answer": lacking}), key


# The missions


def test_transcripts_take_every_branch_of_every_handler() -> None:
    exchanges = [json.loads(line) for path in TRANSCRIPTS for line in path.read_text().splitlines()]
    lines = [line for exchange in exchanges for line in exchange["output"]["trace"]]
    taken = {(line["handler"], line["branch"]) for line in lines if "handler" in line}
    assert taken == {(handler.name, branch) for handler in HANDLERS.values() for branch in handler.branches}
    assert {"boot", "operator", "event"} <= {key for line in lines for key in line.get("trigger", ())}


def replayed(command: list[str]) -> tuple[int, str]:
    played = subprocess.run(
        [sys.executable, "-m", "ucp.contract.vectors.replay", *command], capture_output=True, text=True, check=False
    )
    return played.returncode, played.stdout + played.stderr


def test_our_agent_plays_all_transcripts() -> None:
    status, said = replayed([sys.executable, "-m", "ucp.node"])
    assert (status, said.count("as it should be")) == (0, len(TRANSCRIPTS)), said


def test_replay_prints_the_first_difference_of_a_wrong_agent() -> None:
    wrong = "import ucp.messages, ucp.virtual; ucp.messages.VERSION = 2; ucp.virtual.main()"
    status, said = replayed([sys.executable, "-c", wrong])
    assert status == 1
    assert "alone" in said
    assert "line 4: output.sent[0] is" in said
    assert "An agent without neighbours builds two blocks" in said


@pytest.mark.parametrize(
    ("code", "sentence"),
    [("", "the agent"), ("import time; print('hello', flush=True); input()", "the agent wrote 'hello")],
)
def test_replay_of_a_program_that_is_no_agent_ends_in_one_sentence(code: str, sentence: str) -> None:
    status, said = replayed([sys.executable, "-c", code])
    assert (status, said.count("\n"), sentence in said) == (1, 1, True), said
    assert replayed([shlex.quote("no such program")])[0] == 1


def test_additional_keys_and_a_missing_tally_are_no_difference() -> None:
    wanted = {"sent": [], "timer": 1.5, "trace": [{"handler": "x", "tally": {"yes": 1}, "state": {"idle": True}}]}
    got = {"sent": [], "timer": 1.5, "trace": [{"handler": "x", "state": {"idle": True}, "by": "me"}], "cpu_s": 1}
    assert [*differences(got, wanted)] == []
    for part in (
        {"timer": None},
        {"sent": ["AA=="]},
        {"trace": []},
        {"trace": [{"handler": "x", "state": {"idle": 1}}]},
    ):
        assert [*differences(got | part, wanted)], part
