"""Engine "nftables": loss and partitions as rules of `table bridge air`, for kernels without sch_netem.

Rules stand in the forward hook of the bridge, which sees every packet whatever its protocol, once per
receiver: the switch has copied a broadcast already, so each receiver draws its own lot. A packet is first
marked with the group of the port it came from, then judged in its receiver's chain:

    chain forward { meta mark set iifname map @group;  oifname vmap { "v7" : jump to_v7, ... } }
    chain to_v7   { meta mark != 2 counter name "cut_v7" drop
                    numgen random mod 1000000000 < 150000000 counter name "lost_v7" drop
                    counter name "passed_v7" }

so the cost of a packet does not grow with the number of vehicles. A change is one nft transaction: no
packet meets half of it. The counters are objects of their own and outlive the rules.
See nft(8) and libnftables-json(5).
"""

from __future__ import annotations

import json
import shutil
import subprocess
from typing import Any

from netem import addresses
from netem.conditions import NetworkConditions
from netem.engine import Applied, Engine, ReceiverFigures
from netem.errors import EngineError
from netem.fabric import Fabric

_TABLE = {"family": "bridge", "table": "air"}
_MODULUS = 1_000_000_000
_COUNTERS = ("passed", "lost", "cut")
_PATH = "/usr/sbin:/sbin:/usr/bin:/bin:/usr/local/sbin"  # an ordinary user's PATH has no sbin
_STDIN = ["-f", "/proc/self/fd/0"]  # what "-" means to nft, /dev/stdin, is not there in every container
_DEADLINE_S = 20.0


class NftablesEngine(Engine):
    """Loss per receiver and partitions; neither delay nor anything else that needs a queue."""

    name = "nftables"

    def __init__(self, fabric: Fabric) -> None:
        super().__init__(fabric)
        tool = shutil.which("nft", path=_PATH)
        if tool is None:
            raise EngineError("the program nft is not installed")
        self._tool = tool
        self._ports = [addresses.port(vehicle) for vehicle in self._vehicles]
        hook = {"type": "filter", "hook": "forward", "prio": 0, "policy": "accept"}
        commands = [
            _add("table", family="bridge", name="air"),
            _add("map", **_TABLE, name="group", type="ifname", map="mark"),
            _add("chain", **_TABLE, name="forward", **hook),
        ]
        for port in self._ports:
            commands += [_add("counter", **_TABLE, name=f"{kind}_{port}") for kind in _COUNTERS]
            commands.append(_add("chain", **_TABLE, name=f"to_{port}"))
        self._run(_STDIN, commands + self._rules(NetworkConditions()))

    def change(self, conditions: NetworkConditions) -> None:
        emptied: list[dict[str, Any]] = [
            {"flush": {"table": {"family": "bridge", "name": "air"}}},
            {"flush": {"map": {**_TABLE, "name": "group"}}},
        ]
        self._run(_STDIN, emptied + self._rules(conditions))

    def _rules(self, conditions: NetworkConditions) -> list[dict[str, Any]]:
        groups = conditions.groups(self._vehicles)
        mark = {vehicle: number for number, group in enumerate(groups, 1) for vehicle in group}
        commands = []
        if len(groups) > 1:
            elements = [[addresses.port(vehicle), mark[vehicle]] for vehicle in self._vehicles]
            commands.append(_add("element", **_TABLE, name="group", elem=elements))
            lookup = {"map": {"key": {"meta": {"key": "iifname"}}, "data": "@group"}}
            commands.append(_rule("forward", {"mangle": {"key": {"meta": {"key": "mark"}}, "value": lookup}}))
        jumps = [[port, {"jump": {"target": f"to_{port}"}}] for port in self._ports]
        key = {"meta": {"key": "oifname"}}
        commands.append(_rule("forward", {"vmap": {"key": key, "data": {"set": jumps}}}))
        for vehicle, port in zip(self._vehicles, self._ports, strict=True):
            chain = f"to_{port}"
            if len(groups) > 1:
                other = _match("!=", {"meta": {"key": "mark"}}, mark[vehicle])
                commands.append(_rule(chain, other, {"counter": f"cut_{port}"}, {"drop": None}))
            # What is neither 0 nor 1 must not become it by rounding.
            loss = conditions.link(vehicle, vehicle).independent_loss
            threshold = round(loss * _MODULUS)
            if loss == 1.0:
                commands.append(_rule(chain, {"counter": f"lost_{port}"}, {"drop": None}))
            elif loss > 0.0:
                threshold = min(max(threshold, 1), _MODULUS - 1)
                lot = {"numgen": {"mode": "random", "mod": _MODULUS, "offset": 0}}
                drawn = _match("<", lot, threshold)
                commands.append(_rule(chain, drawn, {"counter": f"lost_{port}"}, {"drop": None}))
            commands.append(_rule(chain, {"counter": f"passed_{port}"}))
        return commands

    def read(self) -> Applied:
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
        judged = _judged(rules.get("forward", []))
        receivers = {}
        for vehicle, port in zip(self._vehicles, self._ports, strict=True):
            # A chain that nothing jumps to does nothing, whatever it says.
            loss, mark = _translate(rules.get(f"to_{port}", []) if port in judged else [])
            cut_from = [s for s in self._vehicles if mark is not None and marks[addresses.port(s)] != mark]
            receivers[vehicle] = ReceiverFigures(
                loss, tuple(cut_from), *(counts[f"{kind}_{port}"] for kind in _COUNTERS)
            )
        return Applied(self.name, receivers)

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


def _add(kind: str, **what: Any) -> dict[str, Any]:
    return {"add": {kind: what}}


def _rule(chain: str, *expressions: dict[str, Any]) -> dict[str, Any]:
    return _add("rule", **_TABLE, chain=chain, expr=list(expressions))


def _match(operator: str, left: dict[str, Any], right: int) -> dict[str, Any]:
    return {"match": {"op": operator, "left": left, "right": right}}


def _judged(forward: list[list[dict[str, Any]]]) -> set[str]:
    """The ports whose packets are sent to their receiver's chain."""
    return {
        element[0]
        for expressions in forward
        for expression in expressions
        if "vmap" in expression
        for element in expression["vmap"]["data"]["set"]
    }


def _translate(rules: list[list[dict[str, Any]]]) -> tuple[float, int | None]:
    """The loss that a receiver's rules make, and the mark of the only group they let in (None: all)."""
    loss = 0.0
    mark = None
    for expressions in rules:
        if not any("drop" in expression for expression in expressions):
            continue
        matches = [expression["match"] for expression in expressions if "match" in expression]
        if not matches:
            loss = 1.0
        elif "numgen" in matches[0]["left"]:
            loss = matches[0]["right"] / matches[0]["left"]["numgen"]["mod"]
        else:
            mark = matches[0]["right"]
    return loss, mark
