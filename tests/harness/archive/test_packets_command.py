"""Test the command `ucp-harness packets`."""

import json
import re
import subprocess
from pathlib import Path

import pytest

from harness.archive.packets.packets_document import PacketsRecord
from tests.harness.captures import INBOUND, OUTBOUND, CaptureScript, PcapNg, frame, pcap, wall_ns
from tests.harness.command import COMMAND, DEADLINE_S, harness, sentences
from tests.ucp.secure.swarm import KEYS, session
from ucp.block import Block
from ucp.messages import BlockAddRequest, BlockAddResponse, CommitBlock, encode
from ucp.secure.bundle import KeySet, write_bundle
from ucp.secure.session import AnsweredRequest

BLOCK = Block(1, 5, b"events")
BEFORE, AFTER = bytes(32), bytes(range(32))


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """Write captures in which vehicle 1 proposes and commits a block, 3 misses the commit, and 1 misses the vote of
    3.
    """
    scene = CaptureScript(1, 2, 3)
    scene.send(10, 1, BlockAddRequest(BLOCK.block_hash, BEFORE))
    scene.send(10.02, 2, BlockAddResponse(BLOCK.block_hash, True))
    scene.send(10.03, 3, BlockAddResponse(BLOCK.block_hash, False), {2: 0.01})
    scene.send(20, 1, CommitBlock(BLOCK, AFTER), {2: [0.01, 0.02]})
    scene.files[2].packet(wall_ns(21), INBOUND, frame(3, b"UC is no message"))
    scene.files[3].packet(wall_ns(21), INBOUND, frame(3, b"anybody", port=53))
    scene.finish(30)
    return scene.write(tmp_path / "run")


def test_bundle_decrypts_sealed_datagrams(tmp_path: Path) -> None:
    asks, answers = session(1), session(2)
    scene = CaptureScript(1, 2, 3)
    request, vote = BlockAddRequest(BLOCK.block_hash, BEFORE), BlockAddResponse(BLOCK.block_hash, True)
    scene.broadcast(10, 1, asks.seal(0, request, None, None, 0))
    scene.broadcast(10.02, 2, answers.seal(0, vote, AnsweredRequest(1, asks.boot, 0), None, 0))
    scene.finish(30)
    run_dir = scene.write(tmp_path / "run")
    write_bundle(tmp_path / "3.bundle.json", KEYS.bundle(3))
    sealed, opened = harness("packets", run_dir), harness("packets", run_dir, "--bundle", tmp_path / "3.bundle.json")
    assert "Block Add Request" in sealed.stdout and "answers:" not in sealed.stdout
    assert "answers: approve: 2; no answer: 3" in normalized_lines(opened.stdout)

    write_bundle(tmp_path / "other.json", KeySet.derived(bytes(31) + b"1", (1, 2, 3)).bundle(3))
    other = harness("packets", run_dir, "--bundle", tmp_path / "other.json")
    assert "not authentic" in other.stdout
    (tmp_path / "3.bundle.json").chmod(0o644)
    refused = harness("packets", run_dir, "--bundle", tmp_path / "3.bundle.json")
    assert (refused.returncode, len(sentences(refused.stderr))) == (2, 1)


def normalized_lines(text: str) -> list[str]:
    """Return the lines with single spaces."""
    return [re.sub(" +", " ", line).strip() for line in text.splitlines()]


def test_output_lists_receivers_and_outcomes_of_each_datagram(run_dir: Path) -> None:
    done = harness("packets", run_dir)
    assert (done.returncode, done.stderr) == (0, "")
    assert normalized_lines(done.stdout) == [
        "captures of 1 2 3; mission second 0 is 2026-09-21 14:13:20.000 UTC, speedup 20",
        "10.000 1 Block Add Request block 1.1 on chain 00000000 -> 2 3",
        "answers: approve: 2; disapprove, but the response was lost: 3",
        "10.020 2 Block Add Response approve block 1.1 -> 1 3",
        "10.030 3 Block Add Response disapprove block 1.1 -> 2 lost by 1",
        "20.000 1 Commit Block block 1.1 makes chain 00010203 (1.1) -> 2 lost by 3 again at 2: 2 copies until 20.020 s",
        "4 datagrams, received 6 times, lost 2 times",
        "malformed: 1 frame, wrong version, at 2",
        "not UCP: 1 frame, UDP to other ports, at 3",
    ]


def test_lost_option_ends_with_the_loss_table(run_dir: Path) -> None:
    done = harness("packets", run_dir / "capture", "--lost")
    assert done.returncode == 0
    assert normalized_lines(done.stdout)[1:-3] == [
        "10.030 3 Block Add Response disapprove block 1.1 -> 2 lost by 1",
        "20.000 1 Commit Block block 1.1 makes chain 00010203 (1.1) -> 2 lost by 3 again at 2: 2 copies until 20.020 s",
        "lost/sent, from (down) to (across)",
        "1 2 3",
        "1 - 0/2 1/2",
        "2 0/1 - 0/1",
        "3 1/1 0/1 -",
    ]


def test_follow_option_lists_a_block_until_its_last_receiver(run_dir: Path) -> None:
    done = harness("packets", run_dir, "--follow", "1.1")
    assert done.returncode == 0
    assert normalized_lines(done.stdout)[1:] == [
        "10.000 1 Block Add Request block 1.1 on chain 00000000 -> 2 3",
        "10.020 2 Block Add Response approve block 1.1 -> 1 3",
        "10.030 3 Block Add Response disapprove block 1.1 -> 2 lost by 1",
        "answers: disapprove, but the response was lost: 3",
        "20.000 1 Commit Block block 1.1 makes chain 00010203 (1.1) -> 2 lost by 3 again at 2: 2 copies until 20.020 s",
        "the block reached 2 at 20.010 s",
    ]


def test_filters_select_the_requested_datagrams(run_dir: Path) -> None:
    done = harness("packets", run_dir, "--to", 3, "--from", 1, "--message", "block add request", "--between", 0, 15)
    assert normalized_lines(done.stdout)[1:3] == [
        "10.000 1 Block Add Request block 1.1 on chain 00000000 -> 3",
        "answers: disapprove, but the response was lost: 3",
    ]
    assert normalized_lines(done.stdout)[3] == "1 datagram, received 1 time, lost 0 times"


def test_json_output_follows_its_schema(run_dir: Path) -> None:
    document = json.loads(harness("packets", run_dir, "--json").stdout)
    record = PacketsRecord.model_validate(document, extra="forbid")
    assert (record.epoch_us, record.speedup, record.of_run) == (1_790_000_000_000_000, 20.0, True)
    assert [one.message for one in record.datagrams] == [
        "Block Add Request",
        "Block Add Response",
        "Block Add Response",
        "Commit Block",
    ]
    request = record.datagrams[0]
    assert request.answers is not None
    assert [(one.by, one.outcome, one.answer, one.response) for one in request.answers] == [
        (2, "answered", "approve", 1),
        (3, "response lost", "disapprove", 2),
    ]
    assert document["datagrams"][3] == {
        "number": 3,
        "at_s": 20.0,
        "sender": 1,
        "sequence": 1,
        "message": "Commit Block",
        "block": "1.1",
        "block_hash": BLOCK.block_hash.hex(),
        "chain_hash": AFTER.hex(),
        "answer": None,
        "origin": "captured",
        "seen_leaving": 1,
        "received": [{"by": 2, "at_s": pytest.approx(20.01), "copies": 2, "last_s": pytest.approx(20.02)}],
        "lost_by": [3],
        "not_listening": [],
        "answers": None,
    }
    assert {"sender": 1, "receiver": 3, "sent": 2, "lost": 1} in document["losses"]
    assert document["captures"][1]["malformed"] == {"wrong version": 1}
    lost = json.loads(harness("packets", run_dir, "--json", "--lost", "--follow", "1.1").stdout)
    assert [one["number"] for one in lost["datagrams"]] == [2, 3]
    assert lost["losses"] == document["losses"]


def test_truncated_capture_is_read_up_to_its_end(run_dir: Path) -> None:
    file = run_dir / "capture" / "2.pcapng"
    file.write_bytes(file.read_bytes()[:-40])
    done = harness("packets", run_dir)
    assert done.returncode == 0
    assert "4 datagrams" in done.stdout
    (sentence,) = sentences(done.stderr)
    assert re.fullmatch(rf"{file}: ends within the block that starts at byte \d+; the part before is read", sentence)


def test_invalid_capture_is_reported_and_others_are_read(run_dir: Path) -> None:
    bad = run_dir / "capture" / "4.pcapng"
    for content, why in (
        (b"text", "not a pcapng or pcap file; "),
        (b"\x1f\x8b compressed", "empty: "),
    ):
        bad.write_bytes(content)
        done = harness("packets", run_dir)
        assert done.returncode == 2
        assert "4 datagrams" in done.stdout
        assert sentences(done.stderr)[0].startswith(f"{bad}: {why}")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere"], "nowhere: does not exist; give a run directory or captures (*.pcapng, *.pcap)"),
        (["."], ".: holds no captures (*.pcapng): `ucp-harness run --capture` makes them"),
        (["run", "--to", "9"], "--to 9: no capture of that vehicle; captures are of 1, 2, 3"),
        (
            ["run", "--follow", "7.1"],
            "--follow 7.1: no known message is about that block; give a name or a hash that is printed here",
        ),
    ],
)
def test_wrong_argument_gives_one_sentence(run_dir: Path, arguments: list[str], sentence: str) -> None:
    done = harness("packets", *arguments, cwd=run_dir.parent)
    assert (done.returncode, done.stdout) == (2, "")
    assert sentences(done.stderr) == [sentence]


def test_command_reads_a_field_capture_without_a_run(tmp_path: Path) -> None:
    file = tmp_path / "7.pcap"
    file.write_bytes(pcap([(1_790_000_000_000_000, frame(7, encode(7, 0, CommitBlock(BLOCK, AFTER))))]))
    done = harness("packets", file)
    digits = BLOCK.block_hash.hex()[:8]
    assert normalized_lines(done.stdout)[:2] == [
        "captures of 7; second 0 is 2026-09-21 14:13:20.000 UTC",
        f"0.000 7 Commit Block block {digits} makes chain 00010203 ({digits}) -> no vehicle",
    ]


def test_closed_output_pipe_causes_no_error(tmp_path: Path) -> None:
    file = PcapNg(1)
    for number in range(5000):
        file.packet(wall_ns(number), OUTBOUND, frame(1, encode(1, number, CommitBlock(BLOCK, AFTER))))
    (tmp_path / "1.pcapng").write_bytes(file.data)
    command = [*COMMAND, "packets", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stderr
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(DEADLINE_S) == 0
