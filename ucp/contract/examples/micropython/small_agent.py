"""A UCP agent for a small machine, in MicroPython: `micropython small_agent.py MISSION_FILE`.

The agent follows the profile for small machines of the agent contract. Times are whole microseconds, because a float of
single precision cannot hold them. Each line has at most 4 KiB. The agent has no store, no trace, no features and no
fsync. Up to four clients use the control socket. `small_agent.sh` starts the agent, and passes SIGTERM on as a line.
"""

import binascii
import hashlib
import json
import os
import random
import select
import socket
import sys
import time

VERSION = "small agent in MicroPython"
MAX_LINE = 4096
MAX_CLIENTS = 4
MAX_DATAGRAM = 1472
TYPES = {64: (1,), 33: (2, 5), 65: (2,), 32: (4, 6, 8), 72: (7,), 40: (7,)}
TIMERS = ("voting", "phase one", "phase two", "phase three", "finalize gap")
DEFAULTS = {
    "vote_timeout_s": 10.0,
    "phase1_timeout_s": 5.0,
    "phase2_timeout_s": 5.0,
    "phase3_timeout_s": 5.0,
    "finalize_gap_s": 0.1,
    "max_block_bytes": 1024,
    "max_event_bytes": 267,
}
FEATURES_OF = {
    "vote_names_chain": False,
    "changed_before_tally": False,
    "asks_after_commit": False,
    "top_needs_majority": False,
    "phase1_tie": "phase2",
    "phase2_tie": "oldest",
    "answer_spread_s": 0,
}
CHOICES = {"phase1_tie": ("phase2", "pop"), "phase2_tie": ("oldest", "block")}


class WrongMissionError(Exception):
    pass


class UnsupportedError(Exception):
    pass


def sha(data):
    return hashlib.sha256(data).digest()


def number(data, at, size):
    return int.from_bytes(data[at : at + size], "big")


def microseconds(seconds):
    return int(seconds * 1000000 + 0.5)


def base64(data):
    return binascii.b2a_base64(data)[:-1].decode()


def from_base64(text):
    """Return the bytes of a base64 text. Raises ValueError."""
    if not isinstance(text, str) or len(text) % 4:
        raise ValueError("not base64")
    data = binascii.a2b_base64(text)
    if base64(data) != text:
        raise ValueError("not base64")
    return data


class Block:
    """A block with its bytes BD and its hash BH."""

    def __init__(self, data):
        self.data, self.hash = bytes(data), sha(data)

    @property
    def agent_id(self):
        return number(self.data, 0, 4)

    @property
    def timestamp(self):
        return number(self.data, 4, 8)

    def to_json(self, chain_hash=None):
        return {
            "agent_id": self.agent_id,
            "timestamp_us": self.timestamp,
            "event_data": base64(self.data[12:]),
            "block_hash": self.hash.hex(),
            "chain_hash": chain_hash and chain_hash.hex(),
        }


class Agent:
    """The protocol without input and output. The object has the handlers, the timers, and the datagrams to send."""

    def __init__(self, agent_id, roster, initial_data, settings):
        self.id, self.roster, self.settings, self.initial = agent_id, roster, settings, initial_data
        self.chain, self.hashes = [], [sha(sha(initial_data))]
        self.current, self.deque, self.stack, self.completed = b"", [], [], []
        self.newest, self.reconciling, self.reconciles = -1, False, 0
        self.deadlines = {}
        self.candidate = self.top_at_initiation = self.majority = None
        self.votes, self.voters, self.answers, self.responders, self.candidates = [0, 0], [], [0, 0], [], {}
        self.sequence, self.handled, self.dropped = 0, 0, {}
        self.now = 0
        self.out, self.triggered = [], []

    @property
    def top(self):
        return self.hashes[-1]

    @property
    def idle(self):
        return not self.deadlines and not self.reconciling and not self.triggered

    # Inputs

    def run(self, handler, *arguments):
        """Run a handler, and then the handlers that it triggers."""
        self.triggered.append((handler, arguments))
        while self.triggered:
            handler, arguments = self.triggered.pop(0)
            self.handled += 1
            handler(*arguments)

    def trigger(self, handler):
        self.triggered.append((handler, ()))

    def expire(self):
        """Run the handlers of the timers that are due."""
        while True:
            due = [(self.deadlines[name], TIMERS.index(name), name) for name in self.deadlines]
            due = [each for each in due if each[0] <= self.now]
            if not due:
                return
            name = min(due)[2]
            del self.deadlines[name]
            self.run(getattr(self, "expire_" + name.replace(" ", "_")))

    def receive(self, data):
        """Handle a datagram that arrived from another address."""
        reason = self.drop_reason(data)
        if reason:
            self.dropped[reason] = self.dropped.get(reason, 0) + 1
            return
        handlers = (
            self.add_request,
            self.vote,
            self.commit_block,
            self.contain_query,
            self.contain_response,
            self.successor_query,
            self.next_response,
            self.block_request,
            self.block_response,
        )
        self.run(handlers[data[3] - 1], number(data, 4, 4), data[14:])

    def drop_reason(self, data):
        if len(data) < 14:
            return "truncated"
        if len(data) > MAX_DATAGRAM:
            return "oversized"
        if data[:2] != b"UC":
            return "wrong magic"
        if data[2] != 1:
            return "wrong version"
        sender, kind, body = number(data, 4, 4), data[3], data[14:]
        if not 1 <= sender <= 65535:
            return "impossible sender"
        if number(data, 12, 2) != len(body):
            return "wrong length"
        if not 1 <= kind <= 9:
            return "unknown type"
        if kind in (2, 5) and (not body or body[0] > 1):
            return "bad vote"
        head = {3: 32, 9: 0}.get(kind)
        if head is None:
            if kind not in TYPES.get(len(body), ()):
                return "wrong length"
        else:
            if not head + 13 <= len(body) <= head + 12 + 1024:
                return "wrong length"
            if not 1 <= number(body, head, 4) <= 65535:
                return "impossible agent"
        if sender == self.id:
            return "own sender"
        if sender not in self.roster:
            return "sender not on the roster"
        if head is not None and number(body, head, 4) not in self.roster:
            return "block not of the roster"
        return None

    # Operations

    def send(self, kind, body):
        header = b"UC\x01" + bytes([kind]) + self.id.to_bytes(4, "big")
        header += (self.sequence & 0xFFFFFFFF).to_bytes(4, "big") + len(body).to_bytes(2, "big")
        self.sequence += 1
        self.out.append(header + body)

    def start(self, timer, setting):
        self.deadlines[timer] = self.now + self.settings[setting]

    def stop(self, timer):
        self.deadlines.pop(timer, None)

    def commit(self, block):
        self.chain.append(block)
        self.hashes.append(sha(self.top + block.hash))

    def holds(self, block_hash):
        return any(block.hash == block_hash for blocks in (self.chain, self.deque, self.stack) for block in blocks)

    # Algorithms 1 to 6

    def build_data_block(self, timestamp, event):
        self.current += event
        if len(self.current) + self.settings["max_event_bytes"] < self.settings["max_block_bytes"]:
            return
        self.newest = min(max(timestamp, self.newest + 1), 2**64 - 1)
        block = Block(self.id.to_bytes(4, "big") + self.newest.to_bytes(8, "big") + self.current)
        self.current = b""
        self.completed.append(block.hash)
        self.deque.append(block)
        self.trigger(self.process_next)

    def process_next(self):
        if self.reconciling or "voting" in self.deadlines or not self.deque:
            return
        self.votes, self.voters = [0, 1], []
        self.top_at_initiation, self.candidate = self.top, self.deque[0]
        self.start("voting", "vote_timeout_s")
        self.send(1, self.candidate.hash + self.top)

    def add_request(self, sender, body):
        if not self.reconciling:
            self.send(2, bytes([body[32:] == self.top]) + body[:32])

    def vote(self, sender, body):
        if "voting" in self.deadlines and body[1:33] == self.candidate.hash and sender not in self.voters:
            self.voters.append(sender)
            self.votes[body[0]] += 1

    def expire_voting(self):
        if self.reconciling:
            return
        if self.votes[1] <= self.votes[0]:
            self.trigger(self.reconcile_begin)
            return
        if self.top == self.top_at_initiation:
            block = self.deque.pop(0)
            self.commit(block)
            self.send(3, self.top + block.data)
        self.trigger(self.process_next)

    def commit_block(self, sender, body):
        block = Block(body[32:])
        if not self.reconciling and body[:32] == sha(self.top + block.hash) and not self.holds(block.hash):
            self.commit(block)

    # Algorithms 7 to 20

    def reconcile_begin(self):
        if not self.reconciling:
            self.reconciling = True
            self.reconciles += 1
            self.trigger(self.phase_1)

    def phase_1(self):
        self.answers, self.responders = [0, 0], []
        self.send(4, self.top)
        self.start("phase one", "phase1_timeout_s")

    def contain_query(self, sender, body):
        if not self.reconciling:
            self.send(5, bytes([body in self.hashes]) + body)

    def contain_response(self, sender, body):
        if "phase one" in self.deadlines and body[1:] == self.top and sender not in self.responders:
            self.responders.append(sender)
            self.answers[body[0]] += 1

    def expire_phase_one(self):
        no, yes = self.answers
        if not (no or yes) or (yes < no and not self.chain):
            self.trigger(self.finalize)
        elif yes < no:
            self.stack.append(self.chain.pop())
            self.hashes.pop()
            self.trigger(self.phase_1)
        else:
            self.trigger(self.phase_2)

    def phase_2(self):
        self.candidates, self.responders = {}, []
        self.start("phase two", "phase2_timeout_s")
        self.send(6, self.top)

    def successor_query(self, sender, body):
        if self.reconciling:
            return
        if body not in self.hashes:
            self.trigger(self.reconcile_begin)
        elif body == self.top:
            timestamp = self.chain[-1].timestamp if self.chain else 0
            self.send(7, timestamp.to_bytes(8, "big") + body)
        else:
            block = self.chain[self.hashes.index(body)]
            self.send(7, block.timestamp.to_bytes(8, "big") + body + block.hash)

    def next_response(self, sender, body):
        if "phase two" in self.deadlines and body[8:40] == self.top and sender not in self.responders:
            self.responders.append(sender)
            count, timestamp = self.candidates.get(body[40:], (0, number(body, 0, 8)))
            self.candidates[body[40:]] = (count + 1, timestamp)

    def expire_phase_two(self):
        ranked = [(-count, timestamp, key) for key, (count, timestamp) in self.candidates.items()]
        self.majority = min(ranked)[2] if ranked else b""
        self.trigger(self.phase_3 if self.majority else self.finalize)

    def phase_3(self):
        for block in self.stack:
            if block.hash == self.majority:
                self.stack.remove(block)
                self.commit(block)
                self.trigger(self.phase_2)
                return
        if self.holds(self.majority):
            self.trigger(self.finalize)
            return
        self.start("phase three", "phase3_timeout_s")
        self.send(8, self.majority)

    def block_request(self, sender, body):
        if not self.reconciling:
            for block in self.chain:
                if block.hash == body:
                    self.send(9, block.data)

    def block_response(self, sender, body):
        block = Block(body)
        if "phase three" in self.deadlines and block.hash == self.majority:
            self.stop("phase three")
            self.commit(block)
            self.trigger(self.phase_2)

    def expire_phase_three(self):
        self.trigger(self.finalize)

    def finalize(self):
        while self.stack:
            block = self.stack.pop()
            self.commit(block)
            self.send(3, self.top + block.data)
            if self.stack and self.settings["finalize_gap_s"]:
                self.start("finalize gap", "finalize_gap_s")
                return
        self.reconciling = False
        self.trigger(self.process_next)

    expire_finalize_gap = finalize


class Mission:
    """The settings from a mission file that was checked."""

    def __init__(self, text):
        try:
            document = json.loads(text)
        except (ValueError, MemoryError, RuntimeError, UnicodeError):
            raise WrongMissionError("the mission file is not JSON")
        if not isinstance(document, dict) or document.get("schema") != "ucp-mission/1":
            raise WrongMissionError("the mission file has another schema than ucp-mission/1")
        features = document.get("features", [])
        if not isinstance(features, list):
            raise WrongMissionError("`features` is wrong")
        if features:
            raise UnsupportedError(str(features[0]))
        try:
            self.read(document)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise WrongMissionError("the mission file is wrong: " + str(error))

    def read(self, document):
        self.agent_id, self.roster = document["agent_id"], document["roster"]
        require(isinstance(self.roster, list) and self.roster, "roster")
        require(all(type(each) is int and 1 <= each <= 65535 for each in self.roster), "roster")
        require(type(self.agent_id) is int and self.agent_id in self.roster, "agent_id")
        self.initial_data = from_base64(document["initial_data"])
        if self.initial_data[-45:-32] == b"UCP depot key":
            raise UnsupportedError("sealed") if document.get("security") else ValueError("initial_data")
        network = document["network"]
        self.address, self.broadcast, self.port = network["address"], network["broadcast"], network["port"]
        require(type(self.port) is int and 1 <= self.port <= 65535, "port")
        for name, feature in (("store", "store"), ("security", "secured")):
            if document.get(name) is not None:
                raise UnsupportedError(feature)
        for value in document.get("quirks", {}).values():
            if value is not False and value != 0:
                raise UnsupportedError("quirks")
        events = document["events"]
        if events["source"] == "mavlink":
            raise UnsupportedError("telemetry")
        require(events["source"] in ("random", "none"), "events.source")
        mean_s = events.get("mean_s", 30.0)
        require(is_number(mean_s) and 0 < mean_s <= 2678400, "events.mean_s")
        self.mean_s = max(1.0, mean_s) if events["source"] == "random" else None
        self.settings = self.read_settings(document.get("settings", {}))
        self.seed, speedup = document["seed"], document["speedup"]
        require(type(self.seed) is int and 0 <= self.seed < 2**64, "seed")
        require(is_number(speedup) and 0 < speedup <= 1000, "speedup")
        self.speedup_thousandth = max(1, int(speedup * 1000 + 0.5))
        self.epoch_us = document.get("epoch_us")
        require(self.epoch_us is None or (type(self.epoch_us) is int and 0 <= self.epoch_us < 2**63), "epoch_us")

    def read_settings(self, given):
        require(isinstance(given, dict), "settings")
        settings = {}
        for name, value in given.items():
            if name in FEATURES_OF:
                known = CHOICES.get(name)
                if known:
                    require(value in known, name)
                elif name == "answer_spread_s":
                    require(is_number(value) and value >= 0, name)
                else:
                    require(type(value) is bool, name)
                if value != FEATURES_OF[name]:
                    raise UnsupportedError(name + ("=" + value if known else ""))
            else:
                require(name in DEFAULTS, name)
        for name, default in DEFAULTS.items():
            value = given.get(name, default)
            if name.endswith("_s"):
                least = 0 if name == "finalize_gap_s" else 0.000001
                require(is_number(value) and least <= value <= 1e9, name)
                settings[name] = microseconds(value)
            else:
                require(type(value) is int and 1 <= value <= 1024, name)
                settings[name] = value
        require(settings["max_event_bytes"] <= settings["max_block_bytes"], "max_event_bytes")
        return settings


def require(true, name):
    if not true:
        raise ValueError("`" + name + "`")


def is_number(value):
    return type(value) in (int, float) and value == value


def address_of(host, port):
    return socket.getaddrinfo(host, port)[0][-1]


class Program:
    """The agent with its sockets, its clock and its files."""

    def __init__(self, mission):
        self.mission = mission
        self.agent = Agent(mission.agent_id, set(mission.roster), mission.initial_data, mission.settings)
        self.started = self.logs = False
        self.bytes_sent = self.send_failures = 0
        self.clients = []
        self.control = str(mission.agent_id) + ".control"
        self.export = str(mission.agent_id) + ".chain.json"
        self.own = address_of(mission.address, 0)[4:8]
        self.target = address_of(mission.broadcast, mission.port)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self.udp.setblocking(False)
        self.udp.bind(address_of("0.0.0.0", mission.port))
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        temporary = "." + self.control
        for name in (temporary, self.control):
            try:
                os.unlink(name)
            except OSError:
                pass
        self.listener.bind(b"\x01\x00" + temporary.encode() + b"\0")
        self.listener.listen(4)
        os.rename(temporary, self.control)
        random.seed(mission.seed & 0xFFFFFFFF)
        self.poll = select.poll()
        for each in (self.udp, self.listener, sys.stdin):
            self.poll.register(each, select.POLLIN)
        if mission.epoch_us is not None:
            self.begin(mission.epoch_us)

    # Time

    def begin(self, epoch_us):
        self.epoch_us, self.ahead_us = epoch_us, time.time_ns() // 1000 - epoch_us
        self.ticks, self.elapsed_us = time.ticks_us(), 0
        self.started, self.logs = True, True
        self.next_trial = self.read_clock() + random.getrandbits(20) if self.mission.mean_s else None

    def read_clock(self):
        """Return the mission time in microseconds."""
        ticks = time.ticks_us()
        self.elapsed_us += time.ticks_diff(ticks, self.ticks)
        self.ticks = ticks
        wall_us = max(0, self.ahead_us + self.elapsed_us)
        self.agent.now = max(self.agent.now, wall_us * self.mission.speedup_thousandth // 1000)
        return self.agent.now

    def wait_ms(self):
        """Return the milliseconds of wall time until the next timer expires or the next random event is tried, at most
        1000.
        """
        if not self.started:
            return 1000
        times = list(self.agent.deadlines.values())
        if self.logs and self.next_trial is not None:
            times.append(self.next_trial)
        if not times:
            return 1000
        left_us = (min(times) - self.read_clock()) * 1000 // self.mission.speedup_thousandth
        return max(0, min(1000, left_us // 1000 + 1))

    # The loop

    def run(self):
        """Run until a line arrives on standard input. Return the exit status."""
        while True:
            for ready, _ in self.poll.poll(self.wait_ms()):
                if ready is sys.stdin:
                    return self.end()
                if ready is self.udp:
                    self.read_datagrams()
                elif ready is self.listener:
                    self.accept()
                else:
                    self.read_requests(ready)
            if self.started:
                self.read_clock()
                self.agent.expire()
                self.log_random()
                self.flush()

    def read_datagrams(self):
        for _ in range(16):
            try:
                data, sender = self.udp.recvfrom(65535)
            except OSError:
                return
            if self.started and sender[4:8] != self.own:
                self.read_clock()
                self.agent.receive(data)
                self.flush()

    def flush(self):
        """Send the messages of the agent."""
        for datagram in self.agent.out:
            try:
                self.udp.sendto(datagram, self.target)
                self.bytes_sent += len(datagram)
            except OSError:
                self.send_failures += 1
        self.agent.out = []

    def log_random(self):
        """Try random events as Algorithm 21 does, once for each second that has passed."""
        while self.logs and self.next_trial is not None and self.next_trial <= self.agent.now:
            self.next_trial += 1000000
            if random.random() < 1 / self.mission.mean_s:
                size = 32 << random.getrandbits(2)
                self.log(1 + random.getrandbits(8) % 254, bytes(random.getrandbits(8) for _ in range(size)))

    def log(self, event_id, data):
        timestamp = self.epoch_us + self.agent.now
        event = timestamp.to_bytes(8, "big") + bytes([event_id]) + len(data).to_bytes(2, "big") + data
        if len(event) <= self.mission.settings["max_event_bytes"]:
            self.agent.run(self.agent.build_data_block, timestamp, event)

    # Requests

    def accept(self):
        """Accept a client. If there are already as many clients as allowed, a further client waits until one of them
        closes its connection.
        """
        client, _ = self.listener.accept()
        client.setblocking(False)
        self.clients.append([client, b""])
        self.poll.register(client, select.POLLIN)
        if len(self.clients) == MAX_CLIENTS:
            self.poll.unregister(self.listener)

    def read_requests(self, client):
        (entry,) = [each for each in self.clients if each[0] is client]
        try:
            data = client.recv(MAX_LINE)
        except OSError:
            data = b""
        entry[1] += data
        while data and b"\n" in entry[1]:
            line, entry[1] = entry[1].split(b"\n", 1)
            try:
                answer = self.answer(line)
            except (ValueError, OSError) as error:
                answer = {"ok": False, "error": str(error) or "the request is wrong"}
            self.flush()
            self.reply(client, json.dumps(answer) + "\n")
        if not data or len(entry[1]) > MAX_LINE:
            self.poll.unregister(client)
            client.close()
            if len(self.clients) == MAX_CLIENTS:
                self.poll.register(self.listener, select.POLLIN)
            self.clients.remove(entry)

    def reply(self, client, text):
        client.setblocking(True)
        try:
            client.write(text.encode())
        except OSError:
            pass
        client.setblocking(False)

    def answer(self, line):
        try:
            line.decode()
            request = json.loads(line)
        except (ValueError, UnicodeError, MemoryError, RuntimeError):
            request = None
        if not isinstance(request, dict):
            raise ValueError("the line is not a JSON object")
        command = request.get("command")
        if not isinstance(command, str) or command not in COMMANDS:
            return {"ok": False, "unsupported": True, "error": "unknown command"}
        if self.started:
            self.read_clock()
        return COMMANDS[command](self, request)

    def answer_status(self, request):
        agent = self.agent
        return {
            "ok": True,
            "started": self.started,
            "idle": agent.idle,
            "reconcile_in_progress": agent.reconciling,
            "chain": len(agent.chain),
            "deque": len(agent.deque),
            "stack": len(agent.stack),
            "completed": len(agent.completed),
            "reconciles": agent.reconciles,
            "top_chain_hash": agent.top.hex(),
            "handled": agent.handled,
            "bytes_sent": self.bytes_sent,
            "dropped": agent.dropped,
            "send_failures": self.send_failures,
            "version": VERSION,
        }

    def answer_start(self, request):
        epoch_us = request.get("epoch_us")
        if self.started or type(epoch_us) is not int or not 0 <= epoch_us < 2**63:
            raise ValueError("the mission has begun, or `epoch_us` is wrong")
        self.begin(epoch_us)
        return {"ok": True}

    def answer_log(self, request):
        event_id, data = request.get("event_id"), from_base64(request.get("data"))
        if not self.started:
            raise ValueError("the mission has not begun")
        if type(event_id) is not int or not 1 <= event_id <= 254:
            raise ValueError("`event_id` is not 1..254")
        if len(data) + 11 > self.mission.settings["max_event_bytes"]:
            raise ValueError("the event is too large")
        if self.logs:
            self.log(event_id, data)
        return {"ok": True}

    def answer_stop_events(self, request):
        self.logs = False
        return {"ok": True}

    def answer_reconcile(self, request):
        if not self.started:
            raise ValueError("the mission has not begun")
        self.agent.run(self.agent.reconcile_begin)
        return {"ok": True}

    def answer_export(self, request):
        self.write_export()
        return {"ok": True, "path": self.export}

    # Files

    def write_export(self):
        """Write the chain export. Raises OSError."""
        agent, temporary = self.agent, "." + self.export
        inception = {"block_data": base64(agent.initial), "block_hash": sha(agent.initial).hex()}
        document = {
            "schema": "ucp-chain-export/1",
            "agent_id": agent.id,
            "exported_at_us": self.epoch_us + agent.now if self.started else 0,
            "inception": dict(inception, chain_hash=agent.hashes[0].hex()),
            "chain": [block.to_json(top) for block, top in zip(agent.chain, agent.hashes[1:])],
            "blocks_to_be_committed": [block.to_json() for block in agent.deque],
            "reconcile_stack": [block.to_json() for block in agent.stack],
            "current_block": {"event_data": base64(agent.current)},
            "reconcile_in_progress": agent.reconciling,
            "idle": agent.idle,
            "completed": [each.hex() for each in agent.completed],
        }
        with open(temporary, "w") as file:
            json.dump(document, file)
        os.rename(temporary, self.export)

    def end(self):
        self.udp.close()
        try:
            self.write_export()
            status = 0
        except OSError:
            status = 1
        os.unlink(self.control)
        return status


COMMANDS = {
    "status": Program.answer_status,
    "start": Program.answer_start,
    "log": Program.answer_log,
    "stop_events": Program.answer_stop_events,
    "reconcile": Program.answer_reconcile,
    "export": Program.answer_export,
}


def main(path):
    try:
        with open(path, "rb") as file:
            text = file.read(MAX_LINE + 1)
        if len(text) > MAX_LINE:
            raise WrongMissionError("the mission file has more than " + str(MAX_LINE) + " bytes")
        program = Program(Mission(text))
    except UnsupportedError as error:
        sys.stderr.write("this agent lacks the feature " + str(error) + "\n")
        return 127
    except (WrongMissionError, OSError) as error:
        sys.stderr.write(str(error) + "\n")
        return 2
    return program.run()


if len(sys.argv) != 2:
    sys.stderr.write("the name of a mission file is missing\n")
    sys.exit(2)
sys.exit(main(sys.argv[1]))
