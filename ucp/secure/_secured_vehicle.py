"""Create the secured agent of a mission from its bundle.

On a vehicle, the bundle is a file. The agent chooses a new boot at each start, and rewrites the file at each new epoch
so that it no longer contains older secrets. In virtual time, the simulation hands over the bundle and the boot.
"""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ucp.mission import Mission, MissionError
from ucp.sealed import sealed_to
from ucp.secure._no_dumps import forbid_core_dumps
from ucp.secure.bundle import BUNDLE_SCHEMA, KEY_BYTES, Bundle, load_bundle, write_bundle
from ucp.secure.envelope import BOOT_BYTES
from ucp.secure.keyfile import KeyFileError, key_in
from ucp.secure.sealing import make_seal
from ucp.secure.secured_agent import SecuredAgent, make_boot
from ucp.secure.session import Session


def agent_factory(
    mission: Mission, directory: Path, report_write_error: Callable[[OSError], None]
) -> Callable[..., SecuredAgent]:
    """Return a function that creates the agent of a mission. The function has the arguments of `Agent`. `directory` is
    the directory of the mission file. `report_write_error` is called if a bundle without old secrets cannot be written
    to disk. Raises MissionError.
    """
    assert mission.security is not None, "the mission is secured"
    forbid_core_dumps()
    path = directory / mission.security.bundle
    try:
        bundle = load_bundle(path)
    except KeyFileError as error:
        raise MissionError(f"`security.bundle`: {error}") from None

    def save(new_bundle: Bundle) -> None:
        try:
            write_bundle(path, new_bundle)
        except OSError as error:
            report_write_error(error)

    _check_bundle(bundle, mission, f"`security.bundle`: {path}")
    earlier_us = -1 if bundle.started_us is None else bundle.started_us
    started_us = max(time.time_ns() // 1000, earlier_us + 1)  # the clock may be lost
    session = Session(bundle, make_boot(started_us, os.urandom(8)), save)
    return _factory(mission, session, partial(os.urandom, KEY_BYTES))


def virtual_agent_factory(mission: Mission, bundle: Any, boot: Any) -> Callable[..., SecuredAgent]:
    """Return a function that creates the agent of a mission in virtual time. The functions read no file and no clock.

    `bundle` is the content of a bundle file. `boot` is the boot of this incarnation in hexadecimal. Raises
    MissionError.
    """
    if not isinstance(bundle, dict) or bundle.get("schema") != BUNDLE_SCHEMA:
        raise MissionError(f"`bundle` must be the JSON object of a file of the schema {BUNDLE_SCHEMA}")
    try:
        parsed_bundle = Bundle.from_json(bundle)
        parsed_boot = key_in({"boot": boot}, "boot", BOOT_BYTES)
    except KeyFileError as error:
        raise MissionError(f"in `bundle` or `boot`: {error}") from None
    _check_bundle(parsed_bundle, mission, "`bundle`")
    return _factory(mission, Session(parsed_bundle, parsed_boot))


def _check_bundle(bundle: Bundle, mission: Mission, place: str) -> None:
    """Raise MissionError if the key bundle does not belong to this agent in this mission."""
    missing = sorted({*mission.roster} - bundle.public.vehicles.keys())
    if bundle.agent_id != mission.agent_id or missing:
        problem = f"has no keys of agent {missing[0]}" if missing else f"is agent {bundle.agent_id}'s"
        raise MissionError(f"{place} {problem}: hand out the bundle of agent {mission.agent_id}")
    depot = sealed_to(mission.initial_data)
    if depot is not None and depot != bundle.public.depot:
        raise MissionError(f"{place} seals to another depot than the mission's `initial_data` names")


def _factory(
    mission: Mission, session: Session, draw_key: Callable[[], bytes] | None = None
) -> Callable[..., SecuredAgent]:
    seals = sealed_to(mission.initial_data) is not None
    return partial(SecuredAgent, session, seal=make_seal(session.epochs.bundle, draw_key) if seals else None)
