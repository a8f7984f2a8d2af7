"""Test the conformance cases about missions with keys on a machine without the extra `secure`."""

import asyncio
import sys

import pytest

from harness.conformance._udp_lab import UdpLab
from harness.conformance.cases import ALL_CASES, _play
from harness.conformance.cases._bench import HandwrittenCase

CASES = [case for case in ALL_CASES if case.name.startswith("with keys")]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_case_without_the_extra_secure_is_not_applicable(
    case: HandwrittenCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in [name for name in sys.modules if name.startswith("ucp.secure.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cryptography", None)
    result = asyncio.run(_play(UdpLab.__new__(UdpLab), case))
    assert result.verdict == "not applicable"
    assert result.reason == "cryptography is not installed here: run `pip install 'ucp-harness[secure]'`"


def test_cases_with_keys_exist() -> None:
    assert len(CASES) == 4
