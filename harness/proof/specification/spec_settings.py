"""Which settings of agents the specification has, and under which names."""

from dataclasses import fields

from ucp.settings import Settings

SPECIFIED = frozenset(
    (
        *("vote_timeout_s", "phase1_timeout_s", "phase2_timeout_s", "phase3_timeout_s", "finalize_gap_s"),
        *("max_block_bytes", "max_event_bytes"),
        *("vote_names_chain", "changed_before_tally", "phase1_tie", "phase2_tie"),
    )
)


def unspecified(settings: Settings) -> str | None:
    """A setting that is not as by default, and that the specification does not have."""
    default = Settings()
    names = (item.name for item in fields(Settings))
    changed = (name for name in names if getattr(settings, name) != getattr(default, name))
    return next((name for name in changed if name not in SPECIFIED), None)


def readings(settings: Settings) -> dict[str, bool]:
    """The constants that are readings of the thesis with a setting."""
    return {
        "VoteNamesChain": settings.vote_names_chain,
        "ChangedBeforeTally": settings.changed_before_tally,
        "Phase1TiePops": settings.phase1_tie == "pop",
        "Phase2TieTakesBlock": settings.phase2_tie == "block",
    }
