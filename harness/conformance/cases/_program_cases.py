"""Test cases about the agent program: start and end, refused missions, and the control socket."""

import asyncio
import base64
import json
import os
import signal
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from harness.conformance._agent_under_test import NO_KEYS
from harness.conformance._reference_model import PEERS
from harness.conformance._state_space import VARIANTS
from harness.conformance._udp_lab import SILENT
from harness.conformance.cases._bench import (
    INCEPTION,
    PATIENCE_S,
    SPEEDUP,
    BenchAgent,
    CannotJudgeError,
    CaseBench,
    WrongBehaviourError,
    case,
    require,
)
from harness.play.agent_control import AgentRefusedError, connect
from ucp.block import Block, next_chain_hash
from ucp.contract.vectors import DIRECTORY
from ucp.contract.vectors.refusal_vectors import UNKNOWN
from ucp.features import UNSUPPORTED
from ucp.messages import BlockAddRequest, ChainContainQuery, CommitBlock

WRONG_MISSION = 2
REFUSALS: dict[str, Any] = json.loads((DIRECTORY / "refusals.json").read_text(encoding="ascii"))
NO_EXPIRY = {**VARIANTS["default"].settings.to_json(), "vote_timeout_s": 10_000.0}
"""Settings with which no vote ends during a test case."""
INPUTS = 50
SIGNAL_GAP_S = 0.05
"""Seconds of wall time between two signals. The kernel discards a signal if an equal signal is still pending."""
SECONDS_WITHOUT_EVENT = 20.0
"""Duration in mission seconds of a test in which the agent must log no event. A wrong agent that logs random events,
one each second on average, almost certainly logs at least one event in this time.
"""


async def _refused(agent: BenchAgent, command: str, why: str, **arguments: Any) -> None:
    try:
        await agent.process.ask(command, **arguments)
    except AgentRefusedError:
        return
    raise WrongBehaviourError(f"`ok` false to {command} {why}", "the agent answered `ok` true")


@case(
    "before the mission starts, the agent answers no message, and refuses to log and to reconcile",
    "contract, The program",
)
async def _not_started(bench: CaseBench) -> None:
    async with bench.agent(started=False) as agent:
        require((await agent.status()).get("started") is False, "`started` false", "not")
        agent.send(PEERS[0], ChainContainQuery(INCEPTION))
        await agent.receive_nothing("before its mission starts")
        await _refused(agent, "log", "before the mission starts", event_id=1, data="")
        await _refused(agent, "reconcile", "before the mission starts")
        await agent.begin()
        await agent.require_single_answer(INCEPTION, "the start")
        await _refused(agent, "start", "once more", epoch_us=1)


@case("an agent that joins a running mission uses the mission's time", "contract, Time")
async def _joins(bench: CaseBench) -> None:
    async with bench.agent(started=False) as agent:
        await agent.begin(ahead_s=-100.0)
        status = await agent.status()
        require(status.get("started") is True, "`started` true", status.get("started"))
        shown = status.get("mission_s")
        if shown is not None:
            right = isinstance(shown, int | float) and 0 <= shown - 100.0 * SPEEDUP < PATIENCE_S * SPEEDUP
            require(right, f"mission second {100 * SPEEDUP:g} or a little later", shown)
        await agent.require_single_answer(INCEPTION, "a start long ago")


@case("mission time is 0 until the mission starts", "contract, Time")
async def _ahead(bench: CaseBench) -> None:
    async with bench.agent(started=False) as agent:
        await agent.begin(ahead_s=30.0)
        shown = (await agent.status()).get("mission_s")
        require(shown in (None, 0), "mission second 0", shown)


async def _exported(agent: BenchAgent, *signals: int) -> dict[str, Any]:
    """Send these signals to the agent, wait for its end, and return its chain export."""
    for number in signals:
        await agent.process.send_signal(number)
        await asyncio.sleep(SIGNAL_GAP_S)
    returned = await agent.end()
    await agent.receive_nothing("after its end")
    require(returned == 0, "exit status 0", f"status {returned}")
    path = agent.process.directory / f"{agent.agent_id}.chain.json"
    require(path.exists(), "a chain export", "none")
    export: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return export


async def _ends(bench: CaseBench, number: int) -> None:
    async with bench.agent({"settings": NO_EXPIRY}) as agent:
        await agent.log(b"event")
        await agent.receive_one(BlockAddRequest, "an event that fills a block")
        export = await _exported(agent, number)
        require(len(export["completed"]) == 1, "one completed block in the export", len(export["completed"]))


@case("the agent leaves no control socket and no other files at its end", "contract, The program")
async def _files(bench: CaseBench) -> None:
    bench.require_own_machine("the directory")
    async with bench.agent() as agent:
        await _exported(agent, signal.SIGTERM)
        socket = agent.process.directory / f"{agent.agent_id}.control"
        require(not socket.exists(), "no control socket any more", "it is there")
        own = {f"{agent.agent_id}.{each}" for each in ("mission.json", "chain.json", "trace.jsonl", "log", "out")}
        others = sorted({file.name for file in agent.process.directory.iterdir()} - own)
        require(not others, "only the files that the contract lists", ", ".join(others))


@case("SIGTERM exports the chain, exit status 0", "contract, The program")
async def _sigterm(bench: CaseBench) -> None:
    await _ends(bench, signal.SIGTERM)


@case("SIGINT exports the chain, exit status 0", "contract, The program")
async def _sigint(bench: CaseBench) -> None:
    bench.require_large_machine("SIGINT")
    await _ends(bench, signal.SIGINT)


@case("SIGTERM twice during a reconcile exports the chain once, exit status 0", "contract, The program")
async def _sigterm_twice(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        await agent.process.ask("reconcile")
        await agent.receive_one(ChainContainQuery, "the command reconcile")
        export = await _exported(agent, signal.SIGTERM, signal.SIGTERM)
        require(export["chain"] == [], "an export of a chain without blocks", f"{len(export['chain'])} blocks")


@case("SIGTERM before the mission starts exports the chain, exit status 0", "contract, The program")
async def _sigterm_early(bench: CaseBench) -> None:
    async with bench.agent(started=False) as agent:
        export = await _exported(agent, signal.SIGTERM)
        require(export["exported_at_us"] == 0, "`exported_at_us` 0 in the export", export["exported_at_us"])


async def _processes(agent: BenchAgent) -> list[int]:
    """Return the process IDs of the agent. Raises CannotJudgeError if they are not visible."""
    pids = await asyncio.to_thread(agent.process.program.children.pids)
    if not pids:
        raise CannotJudgeError("the processes of the agent are not visible here")
    return pids


@case("a chain export replaces the earlier one in one step", "contract, The program")
async def _whole_export(bench: CaseBench) -> None:
    bench.require_own_machine("the files")
    async with bench.agent() as agent:
        await agent.process.export()
        with (agent.process.directory / f"{agent.agent_id}.chain.json").open() as earlier:
            await agent.process.export()
            require(
                os.fstat(earlier.fileno()).st_nlink == 0, "a new file with the name of the earlier export", "the same"
            )


@case("the agent leaves no process running at its end", "contract, The program")
async def _children(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        if bench.lab.remote is None:  # a far end sees all processes
            await _processes(agent)
        await agent.process.send_signal(signal.SIGTERM)
        await agent.end()
        left = await agent.process.left_behind()
        require(not left, "no process that runs after the end of the agent", ", ".join(left))


@case("inputs and clients leave no descriptors open", "contract, The program")
async def _descriptors(bench: CaseBench) -> None:
    bench.require_own_machine("the descriptors")
    async with bench.agent() as agent:
        before = _open_descriptors(await _processes(agent))
        for _ in range(INPUTS):
            agent.send(PEERS[0], ChainContainQuery(INCEPTION))
            await agent.receive(1, "an answer to each Chain Contain Query")
            await _lines(agent, b'{"command": "status"}')
        opened = _open_descriptors(await _processes(agent)) - before
        require(opened < INPUTS // 2, f"as many open descriptors after {INPUTS} messages and clients", f"{opened} more")


def _open_descriptors(pids: Iterable[int]) -> int:
    try:
        return sum(len(list(Path(f"/proc/{pid}/fd").iterdir())) for pid in pids)
    except OSError:
        raise CannotJudgeError("the descriptors of the agent are not visible here") from None


async def _ends_with(
    bench: CaseBench, status: int, what: str, keys: Mapping[str, Any] = NO_KEYS, text: bytes | None = None
) -> None:
    async with bench.program(keys, text=text) as agent:
        returned = await agent.end()
        require(returned == status, f"exit status {status} for {what}", f"status {returned}")
        require(agent.process.last_line != SILENT, f"a sentence on standard error for {what}", "none")


_BROKEN: dict[str, bytes] = {
    "a mission that is not JSON": b"{",
    "an empty mission": b"",
    "a list as mission": b"[]",
    "a mission nested a hundred thousand deep": b"[" * 100_000,
    "a mission that is not UTF-8": b"\xff\xfe{}",
}
_WRONG: dict[str, dict[str, Any]] = {
    "another schema": {"schema": "ucp-mission/99"},
    "an agent that is not on the roster": {"roster": [2, 3]},
    "agent 0": {"agent_id": 0, "roster": [0, 2]},
    "an empty roster": {"roster": []},
    "initial data that is not base64": {"initial_data": "***"},
    "a port that is none": {"network": {"address": "10.77.0.1", "broadcast": "10.79.255.255", "port": 70000}},
    "a timer of no time": {"settings": {"vote_timeout_s": 0}},
    "a speedup of 0": {"speedup": 0},
    "an epoch that is a word": {"epoch_us": "now"},
}


@case("a wrong mission file gives an error and exit status 2", "contract, The mission file")
async def _broken(bench: CaseBench) -> None:
    for what, text in _BROKEN.items():
        await _ends_with(bench, WRONG_MISSION, what, text=text)
    for what, keys in _WRONG.items():
        await _ends_with(bench, WRONG_MISSION, what, keys)


@case("an unknown feature gives an error and exit status 127", "contract, The mission file")
async def _feature(bench: CaseBench) -> None:
    await _ends_with(bench, UNSUPPORTED, "an unknown feature", {"features": ["an unknown feature"]})


@case("an agent makes a requested mistake, or refuses the mission with status 127", "contract, Quirks")
async def _quirk(bench: CaseBench) -> None:
    keys = {"features": ["quirks"], "quirks": {"ignore_commit": 1.0}}
    async with bench.agent(keys) as agent:
        block = Block(PEERS[0], 1, b"block")
        agent.send(PEERS[0], CommitBlock(block, next_chain_hash(INCEPTION, block.block_hash)))
        await agent.require_single_answer(INCEPTION, "a Commit Block, which the mission requests it to ignore")
        require((await agent.status())["chain"] == 0, "an empty chain, as `ignore_commit` 1 requests", "a block")


@case("missions in doubt are played or refused as in the vectors", "contract, Features")
async def _in_doubt(bench: CaseBench) -> None:
    for vector in REFUSALS["missions"]:
        needs, plays = vector["needs"], vector["plays"]
        if "in virtual time" in vector["what"] or (needs and needs != [UNKNOWN]):
            continue
        keys = {key: vector["mission"][key] for key in ("features", "quirks", "settings", "initial_data")}
        if plays and not needs:
            async with bench.agent(keys) as agent:
                await agent.status()
        else:
            await _ends_with(bench, UNSUPPORTED if needs else WRONG_MISSION, vector["what"], keys)


@case("unknown keys of the mission file are ignored", "contract, The mission file")
async def _unknown_keys(bench: CaseBench) -> None:
    async with bench.agent({"something": {"else": [1, 2, 3]}}) as agent:
        await agent.require_single_answer(INCEPTION, "a mission with an unknown key")


@case("a port in use gives an error and exit status 2", "contract, The program")
async def _port(bench: CaseBench) -> None:
    bench.require_own_machine("the ports")
    port = bench.lab.take_port()
    try:
        async with bench.agent(port=port):
            document = bench.lab.mission(VARIANTS["default"], port, SPEEDUP)
            text = json.dumps(document).encode()
            async with bench.program(text=text) as second:
                returned = await second.end()
                require(returned == WRONG_MISSION, "exit status 2 where the port is in use", f"status {returned}")
    finally:
        bench.lab.return_port(port)


async def _lines(agent: BenchAgent, *requests: bytes) -> list[Any]:
    """Send several lines at once to the control socket on one connection, and return the answers."""
    reader, writer = await connect(agent.process.directory / f"{agent.agent_id}.control")
    try:
        answers = []
        writer.write(b"".join(request + b"\n" for request in requests))
        await writer.drain()
        for _ in requests:
            text = await asyncio.wait_for(reader.readline(), PATIENCE_S)
            answers.append(json.loads(text) if text else None)
        return answers
    except (TimeoutError, OSError, ValueError) as error:
        raise WrongBehaviourError("an answer to each line on the control socket", f"came {error or 'none'}") from None
    finally:
        writer.close()


@case("the control socket answers each line, including invalid ones", "contract, Control socket")
async def _control(bench: CaseBench) -> None:
    async with bench.agent() as agent:
        wrong = (b"no JSON", b"[]", b"{}", b'{"command": "nothing of the kind"}', b'{"command": 7}', b'"status"')
        answers = await _lines(agent, *wrong, b'{"command": "status"}')
        for request, answer in zip(wrong, answers, strict=False):
            refused = isinstance(answer, dict) and answer.get("ok") is False and bool(answer.get("error"))
            require(refused, f"`ok` false and an `error` to {request.decode()}", answer)
        require(isinstance(answers[-1], dict) and answers[-1].get("ok") is True, "a status after that", answers[-1])
        # A small machine may accept lines that are almost JSON.
        for vector in () if bench.lab.small else REFUSALS["requests"]:
            (answer,) = await _lines(agent, base64.b64decode(vector["line"]))
            right = {"unsupported": None, **vector["answer"]}
            received = {key: answer.get(key) for key in right} if isinstance(answer, dict) else answer
            require(received == right, f"{vector['answer']} for a request that is {vector['what']}", received)
        await agent.require_single_answer(INCEPTION, "lines that are no commands")


@case("two simultaneous clients of the control socket are both answered", "contract, Control socket")
async def _two_clients(bench: CaseBench) -> None:
    bench.require_own_machine("the control socket")
    async with bench.agent() as agent:
        status = b'{"command": "status"}'
        both = await asyncio.gather(_lines(agent, status, status), _lines(agent, status, status))
        require(all(answer.get("ok") for answers in both for answer in answers), "four statuses", both)


@case("after stop_events, no further events are logged", "contract, Control socket", 1)
async def _stop_events(bench: CaseBench) -> None:
    often = {"source": "random", "mean_s": 1.0}
    async with bench.agent({"events": often, "settings": {**NO_EXPIRY, "max_event_bytes": 267}}) as agent:
        await agent.receive_one(BlockAddRequest, "random events")
        await agent.process.ask("stop_events")
        before = await agent.process.export()
        await asyncio.sleep(SECONDS_WITHOUT_EVENT / SPEEDUP)
        after = await agent.process.export()
        same = all(before[key] == after[key] for key in ("completed", "current_block"))
        require(same, "no random event after stop_events", "another current block")
    async with bench.agent() as agent:
        await agent.process.ask("stop_events")
        with suppress(AgentRefusedError):
            await agent.log(b"event")
        await agent.receive_nothing("after stop_events")
        require((await agent.status())["completed"] == 0, "no completed block", "one")
