"""Test conformance of an agent on another computer, which is a network namespace at the other end of a cable."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from docs.generate.wrong_agents import quirky
from harness.conformance import cases
from harness.conformance._state_space import VARIANTS, explore
from harness.conformance.cases import ALL_CASES
from harness.conformance.conformance_run import ConformanceRequest, conform, remote_agents
from harness.conformance.results import ConformanceResults
from harness.conformance.vectors import VectorSet
from harness.play.remote.secret_file import create_secret, read_secret
from tests.harness.command import COMMAND, sentences
from tests.harness.two_computers import FAR, LISTEN, TwoComputers, needs_two_computers, wait_until

pytestmark = [pytest.mark.lab, *needs_two_computers]

OURS = [sys.executable, "-P", "-m", "ucp.node"]
PLAYED = {
    "before the mission starts, the agent answers no message, and refuses to log and to reconcile",
    "SIGINT exports the chain, exit status 0",
    "a wrong mission file gives an error and exit status 2",
    "an unknown feature gives an error and exit status 127",
    "the agent leaves no process running at its end",
    "a killed agent restarts with its chain, and proposes the waiting block",
    "the first line of the trace describes the mission",
    "status, chain export and trace agree",
    "with keys, blocks are signed in messages and in the export",
}
NOT_VISIBLE = {
    "two simultaneous clients of the control socket are both answered",
    "a full disk ends the trace, and the agent continues",
}


def free_address() -> str:
    """Return an address of this machine with a free port. A fixed port may be in use, because other tests listen at the
    same time.
    """
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return f"127.0.0.1:{listener.getsockname()[1]}"


@contextmanager
def joined(address: str, secret: Path, *command: str) -> Iterator[None]:
    words = ["join", address, "--as", "1", "--secret-file", str(secret), "--service", "--", *command]
    far = subprocess.Popen([*COMMAND, *words], stdout=subprocess.DEVNULL)
    try:
        yield
    finally:
        far.terminate()
        assert far.wait() == 0


def vectors(longest: int) -> list[VectorSet]:
    """Return the generated tests of an idle agent that have at most `longest` inputs."""
    steps = list(explore(VARIANTS["default"]))
    wanted = {step.key: step for step in steps if step.before.activity == "idle" and len(step.path) <= longest}
    return [VectorSet(VARIANTS["default"], steps, wanted)]


def results_of(place: Path, *command: str, handwritten: bool, longest: int = 0) -> ConformanceResults:
    create_secret(place / "lab.key")
    address = free_address()
    pool = remote_agents(address, read_secret(place / "lab.key"))
    request = ConformanceRequest((), None, None, handwritten=handwritten, max_suspicions=2, remote=pool)
    with joined(address, place / "lab.key", *command):
        return conform(request, place, lambda count, total: None, vectors(longest))


def test_right_agent_on_another_computer_passes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "ALL_CASES", [case for case in ALL_CASES if case.name in PLAYED | NOT_VISIBLE])
    results = results_of(tmp_path, *OURS, handwritten=True)
    assert not results.failures, [case.wrong for case in results.failures]
    assert {case.name for case in results.cases if case.verdict == "passed"} == PLAYED
    assert {case.name for case in results.cases if case.verdict == "not applicable"} == NOT_VISIBLE
    assert sum(row.passed for row in results.rows()) == len(vectors(0)[0].wanted) + len(PLAYED)
    assert list(results.command) == OURS
    assert results.notes[0].startswith("the agent ran on the computer 127.0.0.1, to which a message took")


def test_wrong_agent_on_another_computer_fails(tmp_path: Path) -> None:
    quirk = [sys.executable, "-P", "-m", quirky.__name__, "complete_and_wait"]
    results = results_of(tmp_path, *quirk, handwritten=False)
    assert {case.algorithm for case in results.failures} == {1}
    assert results.exit_status == 1


def test_wrong_far_ends_and_a_lost_connection_are_named_at_both_ends(tmp_path: Path) -> None:
    create_secret(tmp_path / "lab.key")
    create_secret(tmp_path / "other.key")
    with TwoComputers(tmp_path) as computers:
        test = computers.start("lab", "conformance", "--listen", LISTEN, "--secret-file", "lab.key")
        wait_until(lambda: "14700" in computers.on("lab", "ss", "-ltn"), "it listens")

        refused, _ = computers.join(agent=2).communicate()
        assert "this conformance test tests agent 1, not agent 2: use --as 1" in refused
        refused, _ = computers.join(agent=1, key="other.key").communicate()
        assert "has another secret" in refused
        far = computers.join(agent=1)
        assert far.stdout is not None
        assert "agent 1 has joined" in far.stdout.readline()
        refused, _ = computers.join(agent=1).communicate()
        assert f"agent 1 has joined from {FAR} already: end that one" in refused

        computers.cut()
        output, _ = test.communicate()
        computers.mend()
        assert test.returncode == 3
        assert sentences(output)[-1] == (
            f"the connection to the computer {FAR} was lost, so the test has no result: start both commands again"
        )
        assert output.count("ucp-harness: ") == 5, output
        said, _ = far.communicate()
        assert far.returncode == 0, said
        assert said.splitlines() == [
            "the connection is lost; the agent goes on, and this program connects again",
            "the run is over",
        ]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--listen", "nowhere", "--secret-file", "lab.key"], "'nowhere' is not ADDRESS:PORT"),
        (["--listen", LISTEN], "--listen and --secret-file need each other"),
        (["--listen", LISTEN, "--secret-file", "lab.key", "--virtual"], "--listen excludes --virtual and a command"),
        (["--listen", LISTEN, "--secret-file", "lab.key", "--", "true"], "--listen excludes --virtual and a command"),
        (["--listen", LISTEN, "--secret-file", "none.key"], "the secret file none.key cannot be read"),
    ],
)
def test_wrong_remote_test_is_refused_in_one_sentence(options: list[str], says: str, tmp_path: Path) -> None:
    create_secret(tmp_path / "lab.key")
    done = subprocess.run(
        [*COMMAND, "conformance", *options], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    (sentence,) = sentences(done.stderr)
    assert says in sentence
