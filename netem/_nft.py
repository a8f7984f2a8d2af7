"""The engine "nftables". It applies loss and partitions on kernels without netem, with rules in `table bridge air`.

The rules are in the forward hook of the bridge. The switch copies a broadcast before this hook, so the hook handles
each packet of any protocol once per receiver. Losses are therefore drawn separately for each receiver. A rule first
marks the packet with the group of its incoming port. The rules in the chain of its receiver then pass or drop it:

    chain forward { meta mark set iifname map @group
                    oifname vmap { "v7" : jump cut_v7, ... }
                    oifname vmap { "v7" : jump to_v7, ... } }
    chain cut_v7  { meta mark != 2 counter name "cut_v7" drop }
    chain to_v7   { iifname vmap { "v3" : goto to_v7_1, ... }
                    goto to_v7_0 }
    chain to_v7_0 { numgen random mod 1000000000 < 150000000 counter name "lost_v7" drop
                    counter name "passed_v7" }

The cost of a packet therefore does not grow with the number of vehicles. Chain 0 of a receiver has the loss rate of
most of its senders. Each other loss rate has a chain of its own. A change is one nft transaction, so the rules never
handle a packet when a change is only partly done. A change of thousands of links is an exception, because it is larger
than an ordinary user may send at once. The engine makes such a change receiver by receiver. The counters are separate
objects and survive changes of rules. See nft(8) and libnftables-json(5).
"""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from itertools import chain
from typing import Any

from netem import addresses
from netem._fabric import VirtualSwitch
from netem.conditions import NetworkConditions
from netem.engine import AppliedConditions, Engine, ReceiverFigures
from netem.errors import EngineError
from netem.link import LinkConditions

_TABLE = {"family": "bridge", "table": "air"}
_MODULUS = 1_000_000_000
_FROM = {"meta": {"key": "iifname"}}
_TO = {"meta": {"key": "oifname"}}
_STAGES = ("cut", "to")
_COUNTERS = ("passed", "lost", "cut")
_PATH = "/usr/sbin:/sbin:/usr/bin:/bin:/usr/local/sbin"  # an ordinary user's PATH has no sbin
_STDIN = ["-f", "/proc/self/fd/0"]  # nft translates "-" to /dev/stdin, which some containers lack
_DEADLINE_S = 20.0
_TOO_LONG = "Message too long"
_COMMANDS_AT_ONCE = 500
"""Maximum number of commands in one transaction. This number of commands takes about 200 KB. An ordinary user cannot
send more at once, because of the kernel parameter net.core.wmem_max.
"""


class NftablesEngine(Engine):
    """The engine that applies partitions, and independent loss for each pair of sender and receiver.

    The engine does not support conditions that need a queue or a memory of earlier packets.
    """

    name = "nftables"
    has_queues = False

    def __init__(self, fabric: VirtualSwitch) -> None:
        super().__init__(fabric)
        tool = shutil.which("nft", path=_PATH)
        if tool is None:
            raise EngineError("the program nft is not installed")
        self._tool = tool
        self._ports = [addresses.port(vehicle) for vehicle in self._vehicles]
        hook = {"type": "filter", "hook": "forward", "prio": 0, "policy": "accept"}
        lookup = {"map": {"key": _FROM, "data": "@group"}}
        commands = [
            _add("table", family="bridge", name="air"),
            _add("map", **_TABLE, name="group", type="ifname", map="mark"),
            _add("chain", **_TABLE, name="forward", **hook),
            _rule("forward", {"mangle": {"key": {"meta": {"key": "mark"}}, "value": lookup}}),
        ]
        for port in self._ports:
            commands += [_add("counter", **_TABLE, name=f"{kind}_{port}") for kind in _COUNTERS]
            commands += [_add("chain", **_TABLE, name=f"{stage}_{port}") for stage in _STAGES]
        for stage in _STAGES:
            jumps = [[port, {"jump": {"target": f"{stage}_{port}"}}] for port in self._ports]
            commands.append(_rule("forward", {"vmap": {"key": _TO, "data": {"set": jumps}}}))
        self._run(_STDIN, commands)
        self._lossy: NetworkConditions | None = None  # the conditions of the present loss rules
        self.change(NetworkConditions())

    def change(self, conditions: NetworkConditions) -> None:
        lossy = conditions.healed()
        parts = [self._partition(conditions)]
        if lossy != self._lossy:  # a change of the partition alone is fast
            parts += self._loss(conditions)
        try:
            self._run(_STDIN, [*chain.from_iterable(parts)])
        except EngineError as error:
            if _TOO_LONG not in str(error):
                raise
            self._lossy = None  # unknown until all parts have succeeded
            for part in _grouped(parts):
                self._run(_STDIN, part)
        self._lossy = lossy

    def _partition(self, conditions: NetworkConditions) -> list[dict[str, Any]]:
        groups = conditions.groups(self._vehicles)
        mark = {vehicle: number for number, group in enumerate(groups, 1) for vehicle in group}
        elements = [[addresses.port(vehicle), mark[vehicle]] for vehicle in self._vehicles]
        commands = [_flush("map", "group"), _add("element", **_TABLE, name="group", elem=elements)]
        for vehicle, port in zip(self._vehicles, self._ports, strict=True):
            commands.append(_flush("chain", f"cut_{port}"))
            if len(groups) > 1:
                foreign = _match("!=", {"meta": {"key": "mark"}}, mark[vehicle])
                commands.append(_rule(f"cut_{port}", foreign, {"counter": f"cut_{port}"}, {"drop": None}))
        return commands

    def _loss(self, conditions: NetworkConditions) -> list[list[dict[str, Any]]]:
        """Return the nftables commands that set the loss rates of all receivers."""
        differing: dict[int, dict[float, list[int]]] = {}
        for sender, receiver, link in conditions.differing_links():
            differing.setdefault(receiver, {}).setdefault(link.independent_loss, []).append(sender)
        receivers = []
        for vehicle, port in zip(self._vehicles, self._ports, strict=True):
            own = f"to_{port}"
            commands = [_flush("chain", own)]
            default_loss = conditions.link(vehicle, vehicle).independent_loss
            losses = {default_loss: [], **differing.get(vehicle, {})}
            elements = []
            for number, (loss, senders) in enumerate(losses.items()):
                draws = f"{own}_{number}"
                commands += [
                    _add("chain", **_TABLE, name=draws),
                    _flush("chain", draws),
                    *_loss_rules(draws, port, loss),
                ]
                elements += [[addresses.port(sender), {"goto": {"target": draws}}] for sender in senders]
            if elements:
                commands.append(_rule(own, {"vmap": {"key": _FROM, "data": {"set": elements}}}))
            receivers.append([*commands, _rule(own, {"goto": {"target": f"{own}_0"}})])
        return receivers

    def read(self) -> AppliedConditions:
        listing = json.loads(self._run(["list", "table", "bridge", "air"]))["nftables"]
        counts: dict[str, int] = {}
        marks: dict[str, int] = {}
        rules: dict[str, list[list[dict[str, Any]]]] = {}
        for item in listing:
            if counter := item.get("counter"):
                counts[counter["name"]] = counter["packets"]
            elif mapping := item.get("map"):
                marks = dict(mapping.get("elem", []))
            elif rule := item.get("rule"):
                rules.setdefault(rule["chain"], []).append(rule["expr"])
        # A chain without a jump to it has no effect.
        jumps = set(_verdicts(rules.get("forward", [])))
        marking = any("mangle" in expression for expressions in rules.get("forward", []) for expression in expressions)
        senders = {addresses.port(sender): sender for sender in self._vehicles}
        receivers = {}
        for vehicle, port in zip(self._vehicles, self._ports, strict=True):
            cut, own = (
                rules.get(name, []) if (port, name) in jumps else []
                for name in (f"{stage}_{port}" for stage in _STAGES)
            )
            mark = _only_mark(cut) if marking else None
            cut_from = [s for s in self._vehicles if mark is not None and marks[addresses.port(s)] != mark]
            differing = dict(_verdicts(own))
            default_loss = next((e["goto"]["target"] for expressions in own for e in expressions if "goto" in e), "")
            held = {
                sender: LinkConditions(_loss(rules.get(differing.get(name, default_loss), [])))
                for name, sender in senders.items()
                if name != port or len(senders) == 1
            }
            counted = (counts[f"{kind}_{port}"] for kind in _COUNTERS)
            receivers[vehicle] = ReceiverFigures.of(held, tuple(cut_from), *counted)
        return AppliedConditions(self.name, receivers)

    def _run(self, arguments: list[str], commands: list[dict[str, Any]] | None = None) -> str:
        text = None if commands is None else json.dumps({"nftables": commands})
        try:
            done = subprocess.run(
                [self._tool, "-j", *arguments],
                input=text,
                capture_output=True,
                text=True,
                timeout=_DEADLINE_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise EngineError(f"nft could not be run: {error}") from error
        if done.returncode != 0:
            words = [line for line in done.stderr.splitlines() if "Error" in line or "rror:" in line]
            raise EngineError(f"nft refused: {words[0] if words else f'status {done.returncode}'}")
        return done.stdout


def _grouped(parts: list[list[dict[str, Any]]]) -> Iterator[list[dict[str, Any]]]:
    """Combine successive lists of commands into longer lists of at most `_COMMANDS_AT_ONCE` commands. All commands of
    one input list stay in one output list.
    """
    together: list[dict[str, Any]] = []
    for part in parts:
        if together and len(together) + len(part) > _COMMANDS_AT_ONCE:
            yield together
            together = []
        together = [*together, *part]
    yield together


def _add(kind: str, **what: Any) -> dict[str, object]:
    return {"add": {kind: what}}


def _flush(kind: str, name: str) -> dict[str, object]:
    return {"flush": {kind: {**_TABLE, "name": name}}}


def _rule(chain: str, *expressions: dict[str, Any]) -> dict[str, object]:
    return _add("rule", **_TABLE, chain=chain, expr=list(expressions))


def _match(operator: str, left: dict[str, Any], right: int) -> dict[str, object]:
    return {"match": {"op": operator, "left": left, "right": right}}


def _loss_rules(chain: str, port: str, loss: float) -> list[dict[str, Any]]:
    """Return nftables rules that drop packets to a port with this probability, and pass the other packets."""
    drop: list[dict[str, Any]] = [{"counter": f"lost_{port}"}, {"drop": None}]
    if loss == 1.0:
        return [_rule(chain, *drop)]
    rules = []
    if loss > 0.0:
        # A probability other than 0 and 1 must not become 0 or 1 by rounding.
        threshold = min(max(round(loss * _MODULUS), 1), _MODULUS - 1)
        draw = {"numgen": {"mode": "random", "mod": _MODULUS, "offset": 0}}
        rules.append(_rule(chain, _match("<", draw, threshold), *drop))
    return [*rules, _rule(chain, {"counter": f"passed_{port}"})]


def _verdicts(rules: list[list[dict[str, Any]]]) -> Iterator[tuple[str, str]]:
    """Yield (port, chain) for each port in a verdict map of nftables. The chain contains the rules for packets of this
    port.
    """
    for expressions in rules:
        for expression in expressions:
            if "vmap" in expression:
                for port, verdict in expression["vmap"]["data"]["set"]:
                    yield port, next(iter(verdict.values()))["target"]


def _only_mark(rules: list[list[dict[str, Any]]]) -> int | None:
    """Return the packet mark of the only group from which these rules accept packets. Return None if the rules accept
    packets of all groups.
    """
    marks = [e["match"]["right"] for expressions in rules for e in expressions if "match" in e]
    return marks[0] if marks else None


def _loss(rules: list[list[dict[str, Any]]]) -> float:
    """Return the probability that these nftables rules drop a packet."""
    for expressions in rules:
        if any("drop" in expression for expression in expressions):
            matches = [expression["match"] for expression in expressions if "match" in expression]
            return matches[0]["right"] / matches[0]["left"]["numgen"]["mod"] if matches else 1.0
    return 0.0
