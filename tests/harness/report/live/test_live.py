"""Test `run --watch`: the page of an active run, and requests from it."""

import asyncio
import json
import signal
from pathlib import Path
from typing import Any

import aiohttp
import pytest
import yaml

from harness.archive.record_file import read_record
from tests.harness.command import DEADLINE_S, write_scenario
from tests.harness.report.browser import Browser
from tests.harness.report.live.pages import page_of, until

LONG = """
name: Long
agents: 4
duration_s: 100000
network: {loss: 0.1}
events: {mean_s: 10}
"""


def scenario(directory: Path) -> Path:
    path = directory / "long.yaml"
    path.write_text(LONG)
    return path


class Page:
    """Receives changes and sends requests like the live page, but without a browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._unread: list[list[Any]] = []
        self._number = 0
        self.interventions: dict[str, Any] | None = None
        """The latest state of the controls. None before the first state arrives."""

    async def next(self, kind: str) -> list[Any]:
        """Return the next change of this kind."""
        async with asyncio.timeout(DEADLINE_S):
            while True:
                while self._unread:
                    change = self._unread.pop(0)
                    if change[0] == "hand":
                        self.interventions = change[1]
                    if change[0] == kind:
                        return change
                self._unread = [json.loads(line) for line in (await self._socket.receive_str()).splitlines()]

    async def on_request(self, **request: Any) -> dict[str, Any]:
        self._number += 1
        await self._socket.send_str(json.dumps({"number": self._number, **request}))
        _, number, answer = await self.next("answer")
        assert number == self._number
        return answer


def test_requests_of_a_page_are_performed_and_recorded(tmp_path: Path) -> None:
    async def visit(address: str) -> None:
        async with aiohttp.ClientSession() as client, client.ws_connect(f"{address}live", max_msg_size=0) as socket:
            page = Page(socket)
            assert (await page.next("run"))[1]["live"] is True
            while page.interventions is None or page.interventions["closed"] is not None:
                await page.next("hand")
            held_s = (await page.on_request(do="pause"))["at_s"]
            assert (await page.on_request(do="step", seconds=10))["at_s"] >= held_s + 10
            parted_s = (await page.on_request(do="happen", entry={"partition": [[1, 2], [3, 4]]}))["at_s"]
            assert parted_s >= held_s + 10
            assert "error" in await page.on_request(do="happen", entry={"partition": [[1, 2, 99], [3, 4]]})
            assert "error" in await page.on_request(do="happen", entry={"kill": [1, 2, 3, 4]})
            assert await page.on_request(do="fly") == {"error": "that cannot be asked for"}
            assert await page.on_request(do="step", seconds="soon") == {"error": "that cannot be asked for"}
            assert "at_s" in await page.on_request(do="happen", entry={"kill": [4]})
            await socket.send_str("[[[")
            await socket.send_str("7")
            assert "at_s" in await page.on_request(do="next run")

    out = tmp_path / "run"
    with page_of("run", scenario(tmp_path), "--backend", "sim", "--watch", "--out", out) as (process, address):
        asyncio.run(visit(address))
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 130
    record = read_record(out / "run.json").record
    assert [(fault.what, fault.by_hand) for fault in record.faults] == [("partition", True), ("kill", True)]
    assert (out / "replay.yaml").is_file()
    assert (out / "report.html").is_file()


def button(label: str) -> str:
    return f"[...document.querySelectorAll('#hand button')].find(each => each.textContent === '{label}')"


def test_buttons_of_the_page_control_the_run(browser: Browser, tmp_path: Path) -> None:
    out = tmp_path / "run"
    with page_of("run", scenario(tmp_path), "--backend", "sim", "--watch", "--out", out) as (_, address):
        browser.show(address, width=1280, scheme="dark")
        until(browser, f"watch.hand && !{button('Heal')}.disabled && {button('Kill')}.disabled")
        assert browser.evaluate(f"{button('Kill')}.title").startswith("choose vehicles")
        assert browser.evaluate(f"{button('Befall')}.disabled && {button('Befall')}.title").startswith("needs vehicles")
        browser.evaluate("watch.hand.choose(2)")
        browser.evaluate(f"{button('Part')}.click()")
        until(browser, "document.getElementById('events').textContent.includes('partition 2 | 1 3 4')")
        assert "by hand" in browser.evaluate("document.getElementById('events').textContent")
        browser.evaluate(f"{button('Hold')}.click()")
        until(browser, f"{button('Go on')} !== undefined")
        until(browser, "document.getElementById('status').textContent === '● live: held'")
        assert browser.complaints == []


@pytest.mark.lab
@pytest.mark.any_user
def test_vehicle_faults_can_be_caused_by_hand(browser: Browser, tmp_path: Path) -> None:
    def befall(vehicle: int, what: str) -> None:
        browser.evaluate(f"watch.hand.choose({vehicle})")
        browser.evaluate(f"watch.hand.trouble.querySelector('select').value = '{what}'")
        browser.evaluate("watch.hand.trouble.querySelector('select').dispatchEvent(new Event('change'))")
        browser.evaluate(f"{button('Befall')}.click()")

    out = tmp_path / "run"
    request = write_scenario(tmp_path, agents=2, duration_s=100_000, speedup=10, vehicles={"kind": "embedded"})
    with page_of("run", request, "--watch", "--out", out) as (process, address):
        browser.show(address, width=1280, scheme="light")
        until(browser, f"watch.hand && !{button('Heal')}.disabled")
        befall(1, "battery")
        until(browser, "document.querySelector('#hand output').textContent.startsWith('battery at ')")
        befall(2, "lose_compass")
        until(browser, "document.querySelector('#hand .refused') !== null")
        refused = browser.evaluate("document.querySelector('#hand output').textContent")
        assert "vehicle 2 (embedded copter) cannot simulate the loss of its compasses" in refused
        assert browser.complaints == []
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 130
    record = read_record(out / "run.json").record
    assert [(fault.what, fault.detail, fault.by_hand) for fault in record.faults] == [
        ("battery", "vehicle 1, 10.4 V", True)
    ]
    assert record.unmatched_fates == []
    (entry,) = yaml.safe_load((out / "replay.yaml").read_text())["timeline"]
    assert (entry["battery"], entry["volts"]) == ([1], 10.4)
