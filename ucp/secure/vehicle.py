"""A secured agent on its vehicle: with the bundle that it was handed, a life of its own, and old secrets erased."""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from ucp.mission import Mission, MissionError
from ucp.sealed import sealed_to
from ucp.secure.agent import SecuredAgent, boot_of
from ucp.secure.bundle import Bundle, load_bundle, write_bundle
from ucp.secure.keyfile import KeyFileError
from ucp.secure.sealing import seal_of
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
    without = sorted({*mission.roster} - bundle.public.vehicles.keys())
    if bundle.agent_id != mission.agent_id or without:
        whose = f"has no keys of agent {without[0]}" if without else f"is agent {bundle.agent_id}'s"
        raise MissionError(f"`security.bundle`: {path} {whose}: hand out the bundle of agent {mission.agent_id}")

    depot = sealed_to(mission.initial_data)
    if depot is not None and depot != bundle.public.depot:
        raise MissionError(f"`security.bundle`: {path} seals to another depot than the mission's `initial_data` names")

    def keep(newer: Bundle) -> None:
        try:
            write_bundle(path, newer)
        except OSError as error:
            not_erased(error)

    boot = boot_of(time.time_ns() // 1000, os.urandom(8))
    return partial(SecuredAgent, Session(bundle, boot, keep), seal=None if depot is None else seal_of(bundle))
