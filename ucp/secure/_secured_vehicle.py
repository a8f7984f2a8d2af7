"""A secured agent on its vehicle: with the bundle that it was handed, a life of its own, and old secrets erased."""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ucp.mission import Mission, MissionError
from ucp.sealed import sealed_to
from ucp.secure.bundle import BUNDLE_SCHEMA, Bundle, load_bundle, write_bundle
from ucp.secure.envelope import BOOT_BYTES
from ucp.secure.keyfile import KeyFileError, key_in
from ucp.secure.sealing import seal_of
from ucp.secure.secured_agent import SecuredAgent, boot_of
from ucp.secure.session import Session


def secured_agent(
    mission: Mission, directory: Path, not_erased: Callable[[OSError], None]
) -> Callable[..., SecuredAgent]:
    """What makes the mission's agent; all arguments are Agent's. `directory` is the mission file's.

    `not_erased` hears of a disk that refuses a bundle without old secrets. Raises MissionError.
    """
    assert mission.security is not None, "the mission is secured"
    path = directory / mission.security.bundle
    try:
        bundle = load_bundle(path)
    except KeyFileError as error:
        raise MissionError(f"`security.bundle`: {error}") from None

    def keep(newer: Bundle) -> None:
        try:
            write_bundle(path, newer)
        except OSError as error:
            not_erased(error)

    _check(bundle, mission, f"`security.bundle`: {path}")
    return _with_keys(mission, Session(bundle, boot_of(time.time_ns() // 1000, os.urandom(8)), keep))


def secured_in_virtual_time(mission: Mission, bundle: Any, boot: Any) -> Callable[..., SecuredAgent]:
    """The same of an agent that reads no file and no clock: it is told its bundle, as JSON, and which life it is.

    Raises MissionError.
    """
    if not isinstance(bundle, dict) or bundle.get("schema") != BUNDLE_SCHEMA:
        raise MissionError(f"`bundle` must be what a file of the schema {BUNDLE_SCHEMA} holds")
    try:
        handed = Bundle.of_json(bundle)
        life = key_in({"boot": boot}, "boot", BOOT_BYTES)
    except KeyFileError as error:
        raise MissionError(f"in `bundle` or `boot`: {error}") from None
    _check(handed, mission, "`bundle`")
    return _with_keys(mission, Session(handed, life))


def _check(bundle: Bundle, mission: Mission, what: str) -> None:
    """Raises MissionError if it is not this agent's in this mission."""
    without = sorted({*mission.roster} - bundle.public.vehicles.keys())
    if bundle.agent_id != mission.agent_id or without:
        whose = f"has no keys of agent {without[0]}" if without else f"is agent {bundle.agent_id}'s"
        raise MissionError(f"{what} {whose}: hand out the bundle of agent {mission.agent_id}")
    depot = sealed_to(mission.initial_data)
    if depot is not None and depot != bundle.public.depot:
        raise MissionError(f"{what} seals to another depot than the mission's `initial_data` names")


def _with_keys(mission: Mission, session: Session) -> Callable[..., SecuredAgent]:
    seals = sealed_to(mission.initial_data) is not None
    return partial(SecuredAgent, session, seal=seal_of(session.epochs.bundle) if seals else None)
