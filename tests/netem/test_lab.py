"""Test the virtual network as its users see it: programs, connections, and all ways in which it can end."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from netem import lab as lab_module
from netem._lab_channel import LabConnection
from netem.conditions import NetworkConditions
from netem.errors import ConditionsError, LabError, SpawnError
from netem.lab import Lab, LabProcess, UdpCounters, in_words
from tests.netem.conftest import DEADLINE_S, PORT, Air, play, until

pytestmark = pytest.mark.lab


def in_lab(folder: Path, story: Callable[[Lab], Awaitable[None]], vehicles: tuple[int, ...] = (1, 2)) -> None:
    async def run() -> None:
        async with await Lab.open(vehicles, log=folder / "lab.log") as lab:
            await story(lab)

    play(run())


async def start(lab: Lab, folder: Path, vehicle: int | None, *argv: str) -> LabProcess:
    return await lab.spawn(
        vehicle, argv, cwd=folder, env={"PATH": os.environ["PATH"]}, stdout=folder / "out", stderr=folder / "err"
    )


async def output(lab: Lab, folder: Path, vehicle: int | None, *argv: str) -> str:
    process = await start(lab, folder, vehicle, *argv)
    assert await asyncio.wait_for(process.wait(), DEADLINE_S) == 0, (folder / "err").read_text()
    return (folder / "out").read_text()


def test_file_of_a_program_ends_at_its_limit(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        argv = ("/bin/sh", "-c", "head -c 5000 /dev/zero > big; echo $? after")
        output, errors, env = tmp_path / "out", tmp_path / "err", {"PATH": os.environ["PATH"]}
        process = await lab.spawn(1, argv, cwd=tmp_path, env=env, stdout=output, stderr=errors, max_file_bytes=1000)
        assert await asyncio.wait_for(process.wait(), DEADLINE_S) == 0

    in_lab(tmp_path, story, (1,))
    assert (tmp_path / "big").stat().st_size == 1000
    assert (tmp_path / "out").read_text() == "1 after\n"
    assert "File too large" in (tmp_path / "err").read_text()


def test_programs_do_not_ignore_the_signals_that_the_harness_ignores(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        ignored = await output(lab, tmp_path, 1, "/bin/sh", "-c", "grep SigIgn /proc/self/status")
        assert not int(ignored.split()[1], 16) & sum(1 << number - 1 for number in ending)

    ending = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM)
    before = {number: signal.signal(number, signal.SIG_IGN) for number in ending}
    try:
        in_lab(tmp_path, story, (1,))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_vehicle_has_its_address_a_broadcast_address_and_a_default_route(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        said = await output(lab, tmp_path, 258, "/bin/sh", "-c", "ip -4 -o addr; ip route; ip link show lo")
        assert lab.addresses[258] == "10.77.1.2"
        assert f"10.77.1.2/14 brd {lab.broadcast}" in said
        assert "default dev eth0" in said
        assert "LOOPBACK,UP" in said

    in_lab(tmp_path, story, (258,))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may enter a network that somebody else made")
def test_cable_can_end_in_an_existing_network(tmp_path: Path) -> None:
    """The conditions also apply to programs in that network. Afterwards, the network is unchanged."""
    neighbour = subprocess.Popen(["unshare", "--net", "sleep", "60"])
    network = Path(f"/proc/{neighbour.pid}/ns/net")

    def inside(*argv: str) -> str:
        return subprocess.run(["nsenter", f"--net={network}", *argv], capture_output=True, text=True, check=True).stdout

    def links() -> int:
        return len(inside("ip", "-o", "link").splitlines())

    def broadcast(to: str) -> None:
        said = "s.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1); s.sendto(b'', (sys.argv[1], 9))"
        inside(sys.executable, "-c", f"import socket, sys; s = socket.socket(type=socket.SOCK_DGRAM); {said}", to)

    async def run() -> None:
        await until(lambda: network.readlink() != Path("/proc/self/ns/net").readlink(), "it has a network of its own")
        before = links()
        descriptor = os.open(network, os.O_RDONLY)
        async with await Lab.open((1, 7), networks={7: descriptor}, log=tmp_path / "lab.log") as lab:
            os.close(descriptor)
            assert (await output(lab, tmp_path, 7, "readlink", "/proc/self/ns/net")).strip() == str(network.readlink())
            broadcast(lab.broadcast)
            await lab.apply(NetworkConditions(partition=(frozenset({1}), frozenset({7}))))
            broadcast(lab.broadcast)
            figures = (await lab.read()).receivers[1]
            assert (figures.passed, figures.cut) == (1, 1)
        await until(lambda: links() == before, "the cable is gone")

    try:
        play(run())
    finally:
        neighbour.kill()
        neighbour.wait()


def test_idle_lab_is_silent(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        said = await output(lab, tmp_path, 1, "/bin/sh", "-c", "ip -6 addr show dev eth0")
        assert said == ""
        figures = (await lab.read()).receivers
        assert {v: f.passed + f.lost + f.cut for v, f in figures.items()} == {1: 0, 2: 0}

    in_lab(tmp_path, story)


def test_kernel_counts_datagrams_that_programs_read(tmp_path: Path) -> None:
    """Vehicle 2 reads three datagrams that were sent to it, and leaves a broadcast unread in the socket. Vehicle 1 has
    no socket.
    """
    program = (
        "import socket, sys; s = socket.socket(type=socket.SOCK_DGRAM); s.bind(('', 9)); "
        "s.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1); "
        "[s.sendto(b'x', ('127.0.0.1', 9)) for _ in range(3)]; s.sendto(b'x', (sys.argv[1], 9)); "
        "[s.recv(1) for _ in range(3)]"
    )

    async def story(lab: Lab) -> None:
        await output(lab, tmp_path, 2, sys.executable, "-c", program, lab.broadcast)
        counted = await lab.datagrams()
        assert counted == {1: UdpCounters(1, 0, 0, 1, 0), 2: UdpCounters(1, 3, 0, 0, 3)}

    in_lab(tmp_path, story)


def test_first_process_imports_no_large_modules() -> None:
    """Imports take most of the start time of a virtual network."""
    words = subprocess.check_output(
        [sys.executable, "-P", "-c", "import sys, netem.init; print(*sys.modules)"], text=True
    )
    assert not set(words.split()) & {"asyncio", "ssl", "logging", "pydantic", "scapy", "harness", "ucp"}


def test_program_gets_exactly_the_given_environment_folder_and_files(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        script = "pwd; env | sort; ls /proc/self/fd | tr '\\n' ' '; cat; echo wrong >&2"
        said = await output(lab, tmp_path, 1, "/bin/sh", "-c", script)
        lines = said.splitlines()
        assert lines[0] == str(tmp_path)
        assert f"PATH={os.environ['PATH']}" in lines
        assert not [line for line in lines if line.startswith("PYTHON")]
        # Standard input, output, error, and the folder that ls reads: no socket and no namespace of ours.
        assert lines[-1].split() == ["0", "1", "2", "3"]
        assert (tmp_path / "err").read_text() == "wrong\n"

    in_lab(tmp_path, story)


@pytest.mark.parametrize(
    ("how", "status", "error"),
    [("end", 0, ""), ("fail", 1, "one sentence\n"), ("crash", 1, "ValueError: unexpected\n")],
)
def test_forked_module_runs_as_in_a_new_interpreter(tmp_path: Path, how: str, status: int, error: str) -> None:
    async def story(lab: Lab) -> None:
        argv = [sys.executable, "-P", "-m", "tests.netem.forked_module", how]
        files = {"stdout": tmp_path / "out", "stderr": tmp_path / "err"}
        one = await lab.spawn(2, argv, cwd=tmp_path, env={"ONLY": "this"}, max_file_bytes=9999, fork=True, **files)
        assert await asyncio.wait_for(one.wait(), DEADLINE_S) == status
        assert (tmp_path / "err").read_text().endswith(error)
        lines = (tmp_path / "out").read_text().splitlines()
        # The fourth file is the folder that the module reads.
        own = [how, str(tmp_path), "{'ONLY': 'this'}", "['0', '1', '2', '3']", "True", "9999"]
        assert lines == [*own, f"net:[{lab.networks[2]}]"]

    in_lab(tmp_path, story)


def test_output_is_appended_to_what_was_there(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        (tmp_path / "out").write_text("first\n")
        assert await output(lab, tmp_path, 1, "/bin/echo", "second") == "first\nsecond\n"

    in_lab(tmp_path, story)


def test_end_of_a_program_is_reported_correctly(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        failing = await start(lab, tmp_path, 1, "/bin/sh", "-c", "exit 7")
        endless = await start(lab, tmp_path, 2, "/bin/sleep", "1000")
        assert await failing.wait() == 7
        assert failing.returncode == 7
        assert endless.returncode is None
        await endless.send_signal(signal.SIGUSR1)
        assert await endless.wait() == -signal.SIGUSR1
        await endless.send_signal(signal.SIGKILL)  # too late, which does no harm

    in_lab(tmp_path, story)


def test_simultaneous_ends_of_programs_are_all_reported(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        processes = [await start(lab, tmp_path, 1, "/bin/true") for _ in range(50)]
        assert await asyncio.gather(*(process.wait() for process in processes)) == [0] * 50

    in_lab(tmp_path, story)


def test_terminate_kills_a_program_that_ignores_sigterm_or_is_stopped(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        stubborn = await start(lab, tmp_path, 1, "/bin/sh", "-c", "trap '' TERM; echo on; while :; do sleep 1; done")
        await until(lambda: "on" in (tmp_path / "out").read_text(), "the trap is set")
        assert await stubborn.terminate(0.2) == -signal.SIGKILL
        stopped = await start(lab, tmp_path, 1, "/bin/sleep", "1000")
        await stopped.send_signal(signal.SIGSTOP)
        assert await stopped.terminate(DEADLINE_S) == -signal.SIGTERM

    in_lab(tmp_path, story)


def test_signal_reaches_the_process_group_of_a_program(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        family = await start(lab, tmp_path, 1, "/bin/sh", "-c", "sleep 1000 & echo $!; wait")
        await until(lambda: (tmp_path / "out").exists() and (tmp_path / "out").read_text(), "the child runs")
        child = (tmp_path / "out").read_text().strip()
        await family.terminate(DEADLINE_S)
        look = await start(lab, tmp_path, None, "/bin/sh", "-c", f"while test -d /proc/{child}; do sleep 0.01; done")
        assert await asyncio.wait_for(look.wait(), DEADLINE_S) == 0

    in_lab(tmp_path, story)


@pytest.mark.parametrize(
    ("argv", "word"),
    [(["/no/such/program"], "No such file or directory: '/no/such/program'"), (["/etc/passwd"], "Permission denied")],
)
def test_program_that_cannot_be_executed_causes_one_sentence(tmp_path: Path, argv: list[str], word: str) -> None:
    async def story(lab: Lab) -> None:
        with pytest.raises(SpawnError, match=word):
            await start(lab, tmp_path, 1, *argv)
        assert "alive" in await output(lab, tmp_path, 1, "/bin/echo", "alive")

    in_lab(tmp_path, story)


def test_missing_folder_causes_one_sentence(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        with pytest.raises(SpawnError, match="No such file or directory"):
            await start(lab, tmp_path / "none", 1, "/bin/true")

    in_lab(tmp_path, story)


def test_connection_is_made_in_the_network_of_the_vehicle(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        await Air(lab, tmp_path).start_ready(1, "serve", PORT)
        connection = await lab.connect(1, PORT, timeout_s=DEADLINE_S)
        with connection:
            loop = asyncio.get_running_loop()
            assert await loop.run_in_executor(None, connection.recv, 100) == b"hello"
        with pytest.raises(ConnectionRefusedError):
            await lab.connect(2, PORT, timeout_s=DEADLINE_S)

    in_lab(tmp_path, story)


def test_connection_without_listener_times_out_and_delays_no_other(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        # All packets are lost, even the answer to ARP. Therefore a connection attempt does not end.
        await lab.apply(NetworkConditions().with_partition([[1]]))
        hanging = asyncio.create_task(lab.connect(1, PORT, host=lab.addresses[2], timeout_s=0.5))
        assert "alive" in await output(lab, tmp_path, 1, "/bin/echo", "alive")
        assert not hanging.done() or isinstance(hanging.exception(), OSError)
        with pytest.raises(TimeoutError):
            await hanging

    in_lab(tmp_path, story)


def test_unknown_vehicle_is_refused_by_name(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        with pytest.raises(LabError, match="vehicle: the lab has no vehicle 9; use one of 1, 2"):
            await start(lab, tmp_path, 9, "/bin/true")
        with pytest.raises(LabError, match="numeric"):
            await lab.connect(1, PORT, host="localhost", timeout_s=1)

    in_lab(tmp_path, story)


@pytest.mark.parametrize("vehicles", [[], [1, 1], [0], [65536], ["1"]])
def test_lab_of_impossible_vehicles_is_refused(tmp_path: Path, vehicles: list[int]) -> None:
    with pytest.raises(ConditionsError, match="vehicles: "):
        asyncio.run(Lab.open(vehicles, log=tmp_path / "lab.log"))


def test_death_of_the_first_process_ends_every_call_and_wait(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        agent = await start(lab, tmp_path, 1, "/bin/sleep", "1000")
        waiting = asyncio.create_task(agent.wait())
        pending = asyncio.create_task(lab.connect(1, PORT, host="10.77.9.9", timeout_s=1000))
        await asyncio.sleep(0)
        lab._process.kill()
        assert await asyncio.wait_for(waiting, DEADLINE_S) == -signal.SIGKILL
        for call in (pending, lab.read(), lab.apply(NetworkConditions()), start(lab, tmp_path, 1, "/bin/true")):
            with pytest.raises(LabError, match="first process ended unexpectedly"):
                await asyncio.wait_for(call, DEADLINE_S)
        await lab.close()

    in_lab(tmp_path, story)


def test_closing_ends_every_program_and_may_be_repeated(tmp_path: Path) -> None:
    async def story(lab: Lab) -> None:
        agent = await start(lab, tmp_path, 1, "/bin/sh", "-c", "trap '' TERM HUP INT; while :; do sleep 1; done")
        await lab.close()
        assert await agent.wait() == -signal.SIGKILL
        await lab.close()
        with pytest.raises(LabError, match="closed"):
            await lab.read()

    in_lab(tmp_path, story)


def test_simultaneous_labs_do_not_receive_each_other(tmp_path: Path) -> None:
    async def run() -> None:
        folders = [tmp_path / name for name in "ab"]
        for folder in folders:
            folder.mkdir()
        one, other = await asyncio.gather(*(Lab.open([1, 2], log=f / "lab.log") for f in folders))
        async with one, other:
            listeners = [
                await Air(lab, folder).start_ready(2, "receive", PORT)
                for lab, folder in zip((one, other), folders, strict=True)
            ]
            await Air(one, folders[0]).broadcast(1, 10)
            assert [len((await listener.finish())["numbers"]) for listener in listeners] == [10, 0]

    play(run())


@pytest.mark.parametrize(
    "garbage",
    [b"\xff" * 64, b"\0\0\0\2[]", b"\0\0\0\5{bad}", b"\0\0\0\0"],
    ids=["length", "no object", "no json", "empty"],
)
def test_garbage_on_the_control_socket_ends_the_lab_cleanly(tmp_path: Path, garbage: bytes) -> None:
    async def story(lab: Lab) -> None:
        await asyncio.get_running_loop().sock_sendall(lab._channel._control, garbage)
        with pytest.raises(LabError, match="ended unexpectedly"):
            await asyncio.wait_for(_until_dead(lab), DEADLINE_S)
        assert "The control socket broke: a message" in (tmp_path / "lab.log").read_text()
        assert "Traceback" not in (tmp_path / "lab.log").read_text()

    in_lab(tmp_path, story)


async def _until_dead(lab: Lab) -> None:
    while True:
        await lab.read()


@pytest.mark.parametrize(
    ("request_", "arguments"),
    [
        ("dance", {}),
        ("spawn", {}),
        ("spawn", {"vehicle": 1, "argv": [], "cwd": "/", "env": {}, "stdout": "/dev/null", "stderr": "/dev/null"}),
        ("spawn", {"vehicle": 77, "argv": ["x"], "cwd": "/", "env": {}, "stdout": "/dev/null", "stderr": "/"}),
        ("signal", {"pid": 1, "signal": "x"}),
        ("signal", {"pid": [], "signal": 9}),
        ("connect", {"vehicle": 1, "host": 1, "port": "x", "timeout_s": None}),
        ("apply", {"conditions": {"default": {"loss": 7}}}),
        ("apply", {"conditions": 5}),
        ("open", {"vehicles": [1], "engine": None}),
    ],
)
def test_invalid_request_gets_an_error_and_the_lab_survives(
    tmp_path: Path, request_: str, arguments: dict[str, object]
) -> None:
    async def story(lab: Lab) -> None:
        channel: LabConnection = lab._channel
        if request_ == "signal" and arguments["pid"] == 1:
            assert await channel.ask(request_, **arguments) == ({"sent": False}, None)
        else:
            with pytest.raises((LabError, ConditionsError)):
                await channel.ask(request_, **arguments)
        assert "alive" in await output(lab, tmp_path, 1, sys.executable, "-S", "-c", "print('alive')")

    in_lab(tmp_path, story)


def test_in_words_names_signal_or_status() -> None:
    assert [in_words(returncode) for returncode in (0, 3, -9, -40)] == ["status 0", "status 3", "SIGKILL", "signal 40"]


def test_close_succeeds_if_the_lab_ends_at_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    class Process:
        ended = False

        async def wait(self) -> int:
            if not self.ended:
                await asyncio.sleep(DEADLINE_S)
            return 0

        def kill(self) -> None:
            self.ended = True
            raise ProcessLookupError

    class ClosedChannel:
        def close(self) -> None:
            pass

    monkeypatch.setattr(lab_module, "_CLOSE_DEADLINE_S", 0.001)
    asyncio.run(Lab((1,), Process(), ClosedChannel()).close())  # type: ignore[arg-type]
