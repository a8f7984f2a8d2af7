"""Test that the declarations of settings agree with the dataclass fields, the TLA+ specification and the error
messages.
"""

from pathlib import Path
from typing import Any

import pytest

import ucp
from ucp.settings import ALTERNATIVES, CHOICES, DECLARED, NUMBERS, Settings

SPECIFICATION = (Path(ucp.__path__[0]) / "contract" / "spec" / "UCP.tla").read_text(encoding="utf-8")


def test_each_default_is_allowed_and_is_the_first_choice() -> None:
    usual = Settings()
    assert list(DECLARED) == list(Settings.__match_args__)
    assert {name: getattr(usual, name) for name in CHOICES} == {
        name: choice.values[0] for name, choice in CHOICES.items()
    }
    assert all(NUMBERS[name].low <= getattr(usual, name) <= NUMBERS[name].high for name in NUMBERS)


@pytest.mark.parametrize(("name", "value"), ALTERNATIVES.values(), ids=ALTERNATIVES)
def test_settings_take_each_alternative_and_write_it(name: str, value: Any) -> None:
    assert Settings(**{name: value}).to_json()[name] == value


def test_specification_has_each_constant() -> None:
    constants = [choice.constant for choice in CHOICES.values() if choice.constant is not None]
    assert constants
    assert not [constant for constant in constants if f"{constant}," not in SPECIFICATION]


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"vote_timeout_s": 0}, "vote_timeout_s must be more than 0 seconds, at most 1e+09, not 0"),
        ({"phase3_timeout_s": True}, "phase3_timeout_s must be more than 0 seconds, at most 1e+09, not True"),
        ({"finalize_gap_s": -1}, "finalize_gap_s must be 0..1e+09 seconds, not -1"),
        ({"max_block_bytes": 1025}, "max_block_bytes must be 1..1024, not 1025"),
        ({"max_block_bytes": 9.0}, "max_block_bytes must be 1..1024, not 9.0"),
        (
            {"max_block_bytes": 30, "max_event_bytes": 31},
            "max_event_bytes must be 1..max_block_bytes, not 31",
        ),
        ({"top_needs_majority": 1}, "top_needs_majority must be true or false, not 1"),
        ({"phase1_tie": "both"}, "phase1_tie must be one of phase2, pop, not 'both'"),
        ({"phase2_tie": []}, "phase2_tie must be one of oldest, block, not []"),
    ],
    ids=str,
)
def test_settings_refuse_an_impossible_value(wrong: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError) as refused:
        Settings(**wrong)
    assert str(refused.value) == sentence
