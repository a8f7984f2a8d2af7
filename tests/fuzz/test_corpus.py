"""Run each fuzz target with its stored inputs and a few random ones. `make fuzz` runs the targets with millions of
inputs.
"""

from itertools import islice

import pytest

from tests.fuzz.corpus import FOLDER, MOST_BYTES, MOST_FILES, files_of
from tests.fuzz.execute import executed, mutated
from tests.fuzz.finding import FailedError
from tests.fuzz.targets import NAMES, named
from ucp.messages import RequestForBlock, encode

MUTATED = 25


@pytest.mark.parametrize("name", NAMES)
def test_reader_survives_every_input_of_the_corpus(name: str) -> None:
    target, kept = named(name), {path: path.read_bytes() for path in files_of(name)}
    assert kept
    for path, data in kept.items():
        try:
            executed(target, data)
        except Exception as error:
            raise AssertionError(f"{path}: {error}") from error
    for data in islice(mutated([*kept.values()], seed=17), MUTATED):
        executed(target, data)


def test_corpus_is_small_and_has_one_folder_for_each_target() -> None:
    kept = [path for path in FOLDER.rglob("*") if path.is_file()]
    assert len(kept) <= MOST_FILES
    assert sum(path.stat().st_size for path in kept) <= MOST_BYTES
    assert {path.relative_to(FOLDER).parts[0] for path in kept} == {*NAMES}


def _some_mutation_fails(name: str, tries: int = 300) -> None:
    target, kept = named(name), [path.read_bytes() for path in files_of(name)]
    for data in (*kept, *islice(mutated(kept, seed=17), tries)):
        executed(target, data)


def test_fuzz_finds_a_decoder_that_accepts_trailing_bytes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    decode = named("datagram").decode  # type: ignore[attr-defined]
    monkeypatch.setattr("tests.fuzz.targets.datagram.decode", lambda data: decode(data.rstrip(b"\0")))
    with pytest.raises(AssertionError):
        executed(named("datagram"), encode(2, 0, RequestForBlock(bytes(31) + b"\1")) + b"\0")


def test_fuzz_finds_an_agent_with_a_wrong_handler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ucp.core.Core.pop_to_stack", lambda core: core.chain.pop())
    with pytest.raises(FailedError):
        _some_mutation_fails("agent")


def test_fuzz_finds_a_reader_that_drops_lines_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.field.ingest._trace_incarnations.TraceReader._left_out", lambda reader: iter(()))
    with pytest.raises(FailedError, match="nobody says"):
        _some_mutation_fails("trace")


def test_fuzz_finds_a_reader_that_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("harness.field.ingest._trace_incarnations._entry", lambda line: 1 // (b"NaN" not in line))
    with pytest.raises((ZeroDivisionError, FailedError)):
        _some_mutation_fails("trace")


def test_fuzz_finds_a_command_without_an_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ucp.control.ControlServer.answer", lambda server, line: {}[line])
    with pytest.raises(FailedError, match="KeyError"):
        _some_mutation_fails("control", 0)


def test_fuzz_finds_an_input_that_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.finding.MOST_S", 0.05)

    class Endless:
        def run(self, data: bytes) -> None:
            while True:
                pass

    with pytest.raises(FailedError, match="took more than"):
        executed(Endless(), b"")  # type: ignore[arg-type]
