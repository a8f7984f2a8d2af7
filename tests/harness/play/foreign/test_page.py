"""Test that the agent in docs/how-to/simulate-in-virtual-time.md works."""

import re
import sys
from pathlib import Path

from harness.run.simulate import simulate
from tests.harness.play.foreign.agents import played_by

PAGE = Path(__file__).parents[4] / "docs/how-to/simulate-in-virtual-time.md"

CORE = """
import base64, json
from ucp.virtual import VirtualAgent

class MyAgent:
    def __init__(self, mission, now, stored):
        self.inner = VirtualAgent({"mission": mission, "t": now, "store": stored})
        self.said = {"sent": [], "timer": None, "trace": []}

    def give(self, now, **given):
        self.inner.give({"t": now, **given})
        self.said = json.loads(self.inner.answer())
        return self.said.get("answer")

    def receive(self, datagram, now): self.give(now, datagram=base64.b64encode(datagram).decode())
    def log(self, event_id, data, timestamp_us, now):
        self.give(now, event_id=event_id, data=base64.b64encode(data).decode(), timestamp_us=timestamp_us)
    def end_timers(self, now): self.give(now, timer=True)
    def export(self, now): return self.give(now, command="export")
    def status(self, now): return self.give(now, command="status")
    def store(self, now): return self.give(now, command="store")
    def reconcile(self, now): return self.give(now, command="reconcile")
    def to_send(self): return map(base64.b64decode, self.said["sent"])
    def next_timer(self): return self.said["timer"]
    def trace(self): return self.said["trace"]
"""


def test_program_on_the_page_drives_an_agent(tmp_path: Path) -> None:
    shown = re.search(r'```python title="virtual_agent.py"\n(.*?)```', PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert shown is not None and shown[1].count("\n") <= 36
    (tmp_path / "virtual_agent.py").write_text(shown[1])
    (tmp_path / "my_agent.py").write_text(CORE)
    command = [sys.executable, str(tmp_path / "virtual_agent.py")]
    keys = {"agents": 3, "duration_s": 200, "network": {"loss": 0.2}, "final_reconcile": True}
    simulated = simulate(played_by({2: command}, **keys), 1, tracing=True, again=True)
    assert simulated.result.figures["blocks"] and not simulated.result.bad
    assert (
        simulated.result.to_json()
        == simulate(played_by({}, **keys), 1, tracing=True, deliver_all=True).result.to_json()
    )
