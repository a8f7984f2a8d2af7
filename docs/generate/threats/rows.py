"""List the rows of the table: the attacker, the attack, and the scenario that plays it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from harness.scenario import Scenario

CAPTURED = 3
LOST_S, REVOKED_S, ATTACK_S = 100, 200, 300


@dataclass(frozen=True)
class Row:
    """One attack, which is a row of the table."""

    who: str
    does: str
    attack: tuple[dict[str, Any], ...] = ()
    """Entries of the timeline without their times."""
    captured: bool = False
    """True if the attacker has the keys of vehicle 3."""
    revoked: bool = False
    """True if the keys of vehicle 3 are revoked before the attack."""
    quirks: tuple[str, ...] = ()
    """Deliberate errors of the handlers of vehicle 3."""
    own: Mapping[str, Any] = field(default_factory=dict)
    """Keys that replace those of the scenario."""

    @property
    def scenario(self) -> Scenario:
        """Return the scenario: five agents with keys, ten minutes, and a final reconcile."""
        timeline: list[dict[str, Any]] = []
        if self.captured:
            timeline.append({"at_s": LOST_S, "kill": [CAPTURED]})
        if self.revoked:
            timeline.append({"at_s": REVOKED_S, "revoke": [CAPTURED], "heard_by": [1, 2]})
        timeline += [{"at_s": ATTACK_S + 50 * number, **entry} for number, entry in enumerate(self.attack)]
        return Scenario.model_validate(
            {
                "name": "threat",
                "agents": 5,
                "duration_s": 600,
                "events": {"mean_s": 20},
                "security": {"captured": CAPTURED if self.captured else None},
                "quirks": {name: {"value": True, "agents": [CAPTURED]} for name in self.quirks},
                "timeline": timeline,
                "final_reconcile": True,
                **self.own,
            }
        )


def _commit(sender: int) -> dict[str, Any]:
    return {"forge": {"message": "Commit Block", "sender": sender}}


def _answers(sender: int, message: str, **says: bool) -> dict[str, Any]:
    return {"forge": {"message": message, "sender": sender, "for_s": 40, **says}}


_LIES = (
    _answers(CAPTURED, "Block Add Response", approve=False),
    _answers(CAPTURED, "Chain Contain Response", approve=False),
    _answers(CAPTURED, "Next in Sequence Response"),
)
_FLOOD = {"flood": {"for_s": 20, "per_s": 20}}
_AGAIN = (
    {"duplicate": {"for_s": 40}},
    {"delay": {"for_s": 20, "by_s": 20}},
    {"corrupt": {"for_s": 40}},
    {"replay": {"count": 500}},
)

_ALL_IN_STEP: dict[str, Any] = {
    "settings": {"max_block_bytes": 267},
    "events": {"source": "scripted", "script": [{"at_s": 2 + agent, "agent": agent} for agent in (1, 2, 4, 5)]},
    "timeline": [
        {"at_s": 1, "kill": [CAPTURED]},
        *(
            {
                "at_s": 1 + agent / 10,
                "lie": {
                    "message": "Commit Block",
                    "sender": CAPTURED,
                    "receivers": [agent],
                    "block": f"made {1 + agent / 10}",
                    "chain": [],
                },
            }
            for agent in (1, 2, 4, 5)
        ),
        {"at_s": 12.5, "lie": {"message": "Chain Hash Successor Query", "sender": CAPTURED, "chain": "nobody's"}},
        {"at_s": 100, "revoke": [CAPTURED], "heard_by": [1, 2]},
    ],
    "final_reconcile": False,
}
"""The livelock that `prove --captured` found. Blocks become full while all agents have a block to vote on."""

ROWS = (
    Row("outsider", "forges a commit and votes, and floods", (_commit(2), _answers(2, "Block Add Response"), _FLOOD)),
    Row("outsider", "replays datagrams: at once, later, or with flipped bits", _AGAIN),
    Row("captured vehicle 3", "commits a block in the name of vehicle 2", (_commit(2),), captured=True),
    Row("captured vehicle 3", "commits a block in the name of vehicle 3", (_commit(CAPTURED),), captured=True),
    Row("captured vehicle 3", "gives false answers to all requests", _LIES, captured=True),
    Row("captured vehicle 3", "floods the network with datagrams in the name of any vehicle", (_FLOOD,), captured=True),
    Row(
        "captured vehicle 3, revoked later",
        "commits a different block to each agent, and makes all agents reconcile during their votes; "
        "the mission has no final reconcile",
        captured=True,
        own=_ALL_IN_STEP,
    ),
    Row(
        "captured vehicle 3, revoked",
        "commits blocks in both names, gives false answers, and floods",
        (_commit(2), _commit(CAPTURED), *_LIES, _FLOOD),
        captured=True,
        revoked=True,
    ),
    Row("dishonest vehicle 3", "disapproves of every block", quirks=("disapprove_everything",)),
    Row("dishonest vehicle 3", "hides its commits", quirks=("hide_commits",)),
    Row("dishonest vehicle 3", "commits each block of other vehicles twice", quirks=("commit_others_twice",)),
    Row("dishonest vehicle 3", "claims that it has every chain", quirks=("contain_everything",)),
    Row("dishonest vehicle 3, revoked", "disapproves of every block", revoked=True, quirks=("disapprove_everything",)),
)
