"""Does every vehicle carry the same mission? What is on the vehicles is compared, file by file and key by key.

Mission files must agree in all that a swarm has to share, and differ in what each vehicle has for itself. A manifest
says what they should agree on; without one it is what most of them say. Chain exports and traces that lie beside them
must be of the same inception block and roster. A file that cannot be read is a difference, too.
"""

import base64
import contextlib
import dataclasses
import json
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from harness.archive.exports import MAX_EXPORT_BYTES, agents_directory, read_export
from harness.archive.exports import SUFFIX as EXPORT_SUFFIX
from harness.archive.traces import HEADER, MAX_LINE_BYTES
from harness.archive.traces import SUFFIX as TRACE_SUFFIX
from harness.errors import ExportError, HarnessError, RunDirectoryError
from harness.field.depot.mission_files import FILE, Manifest, fingerprint
from harness.field.depot.mission_files import SUFFIX as MISSION_SUFFIX
from harness.report.chain_tree import ranges
from ucp.block import InceptionBlock
from ucp.mission import Mission, MissionError, load_mission
from ucp.quirks import in_force

Kind = Literal["mission file", "manifest", "chain export", "trace"]
INCEPTION, ROSTER, FINGERPRINT = "inception block", "roster", "settings fingerprint"
HASH_DIGITS = 12
MAX_VALUE = 60
_EXPECTED = (MISSION_SUFFIX, EXPORT_SUFFIX, TRACE_SUFFIX)


class UnreadableFileError(HarnessError):
    """A file that is none of those that can be compared, or is damaged."""


@dataclass(frozen=True)
class Shared:
    """What a file says of what all must share: `key` is what the value is called in this file."""

    key: str
    value: Hashable
    shown: str


@dataclass
class Carried:
    """A file that a vehicle carries, or that belongs to a mission."""

    path: Path
    kind: Kind
    agent_id: int | None
    shared: dict[str, Shared]
    mission: Mission | None = None


@dataclass(frozen=True)
class Difference:
    """`file` is None where no file is to blame, but one that is not there; `key` where it is the whole file."""

    file: Path | None
    key: str | None
    sentence: str

    def __str__(self) -> str:
        return self.sentence


@dataclass
class Comparison:
    """What was compared, and what differs."""

    carried: list[Carried]
    differences: list[Difference]

    @property
    def verdict(self) -> Literal["same", "differ", "nothing usable"]:
        if not self.carried:
            return "nothing usable"
        return "differ" if self.differences else "same"

    def in_words(self) -> str:
        """What is the same in all files, if it is."""
        kinds = Counter(carried.kind for carried in self.carried)
        counted = ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in kinds.items())
        known = {name: said.shown for carried in self.carried for name, said in carried.shared.items()}
        what = ", ".join(f"{name} {known[name]}" for name in (INCEPTION, ROSTER, FINGERPRINT) if name in known)
        alike = "are of one mission" if len(self.carried) > 1 else "is of a mission"
        sentence = f"{counted} {alike}: {what}"
        if not kinds["mission file"]:
            sentence += "; without a mission file, settings, network and seeds were not compared"
        return sentence

    def to_json(self) -> dict[str, Any]:
        return {
            "verdict": self.verdict,
            "files": [
                {"file": str(carried.path), "kind": carried.kind, "agent_id": carried.agent_id}
                for carried in self.carried
            ],
            "shared": {name: said.shown for carried in reversed(self.carried) for name, said in carried.shared.items()}
            if self.verdict == "same"
            else {},
            "differences": [
                {"file": None if gap.file is None else str(gap.file), "key": gap.key, "sentence": gap.sentence}
                for gap in self.differences
            ],
        }


def compare(paths: Iterable[Path]) -> Comparison:
    """Compare files, and those in directories. Raises RunDirectoryError if a path does not exist, or holds none."""
    comparison = Comparison([], [])
    for path, named in _files(paths):
        try:
            comparison.carried.append(read(path))
        except UnreadableFileError as error:
            begun = path.name.endswith(TRACE_SUFFIX) and not path.stat().st_size  # and not a line of it is there yet
            if named or (path.name.endswith(_EXPECTED) and not begun) or path.name == FILE:
                comparison.differences.append(Difference(path, None, f"{path}: {error}"))
    comparison.differences += differences(comparison.carried)
    return comparison


def differences(carried: Sequence[Carried]) -> list[Difference]:
    """Whatever keeps these files from being of one mission."""
    found = [*_unlike(carried), *_not_distinct(carried), *_off_the_roster(carried)]
    for file in carried:
        if file.mission is not None:
            found += [
                Difference(file.path, f"quirks.{name}", f"{file.path}: `quirks.{name}` asks for a mistake: set it to 0")
                for name in in_force(file.mission.quirks)
            ]
    return found


# What is in the files


def read(path: Path) -> Carried:
    """What a file says of its mission. Raises UnreadableFileError: why, without the file's name."""
    document = _beginning(path)
    schema = document.get("schema")
    try:
        match str(schema).partition("/")[0]:
            case "ucp-mission":
                return _of_mission(path, load_mission(path))
            case "ucp-chain-export":
                return _of_export(path)
            case "ucp-trace":
                return _of_trace(path, document)
            case "ucp-mission-manifest":
                return _of_manifest(path, document)
    except (MissionError, ExportError) as error:
        raise UnreadableFileError(str(error).removeprefix(f"{path}: ")) from None
    except ValidationError as error:
        problem = error.errors()[0]
        where = ".".join(map(str, problem["loc"]))
        raise UnreadableFileError(f"`{where}` is wrong: {problem['msg'].lower()}") from None
    raise UnreadableFileError("not a mission file, manifest, chain export or trace")


def _beginning(path: Path) -> dict[str, Any]:
    """The JSON object that a file is, or begins with."""
    try:
        with path.open("rb") as file:
            first = file.readline(MAX_LINE_BYTES)
            with contextlib.suppress(ValueError, RecursionError):
                if isinstance(document := json.loads(first), dict):
                    return document
            text = first + file.read(MAX_EXPORT_BYTES)
        document = json.loads(text)
    except OSError as error:
        raise UnreadableFileError(f"cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError):
        why = "damaged: not JSON" if text.strip() else "empty"
        raise UnreadableFileError(f"{why}; so its values are not compared") from None
    if not isinstance(document, dict):
        raise UnreadableFileError("not a mission file, manifest, chain export or trace")
    return document


def _of_mission(path: Path, mission: Mission) -> Carried:
    shared = {
        INCEPTION: _inception("initial_data", mission.initial_data),
        ROSTER: _roster(mission.roster),
        FINGERPRINT: _fingerprint("settings", fingerprint(mission.settings)),
    }
    for name, value in dataclasses.asdict(mission.settings).items():
        shared[f"setting {name}"] = Shared(f"settings.{name}", value, _shown(value))
    for name, value in (
        ("broadcast address", mission.network.broadcast),
        ("port", mission.network.port),
    ):
        shared[name] = Shared(f"network.{name.split()[0]}", value, _shown(value))
    for name, value in (("speedup", mission.speedup), ("epoch_us", mission.epoch_us)):
        shared[name] = Shared(name, value, _shown(value))
    return Carried(path, "mission file", mission.agent_id, shared, mission)


def _of_export(path: Path) -> Carried:
    export = read_export(path)
    initial_data = base64.b64decode(export.inception.block_data)
    inception = InceptionBlock(initial_data)
    if inception.block_hash.hex() != export.inception.block_hash:
        raise UnreadableFileError("`inception.block_hash` does not match `inception.block_data`: it was edited")
    return Carried(path, "chain export", export.agent_id, {INCEPTION: _inception("inception.block_data", initial_data)})


def _of_trace(path: Path, document: dict[str, Any]) -> Carried:
    header = HEADER.validate_python(document)
    if header.initial_data is None:
        raise UnreadableFileError("a trace of version 1 has no `initial_data`, so its mission is unknown")
    try:
        initial_data = base64.b64decode(header.initial_data, validate=True)
    except ValueError:
        raise UnreadableFileError("`initial_data` is not base64") from None
    return Carried(
        path,
        "trace",
        header.agent_id,
        {INCEPTION: _inception("initial_data", initial_data), ROSTER: _roster(header.roster)},
    )


def _of_manifest(path: Path, document: dict[str, Any]) -> Carried:
    manifest = Manifest.model_validate(document)
    block_hash = manifest.inception.block_hash
    return Carried(
        path,
        "manifest",
        None,
        {
            INCEPTION: Shared("inception.block_hash", block_hash, block_hash[:HASH_DIGITS]),
            ROSTER: _roster(manifest.roster),
            FINGERPRINT: _fingerprint("settings_sha256", manifest.settings_sha256),
            "broadcast address": Shared("broadcast", manifest.broadcast, _shown(manifest.broadcast)),
            "port": Shared("port", manifest.port, _shown(manifest.port)),
        },
    )


def _inception(key: str, initial_data: bytes) -> Shared:
    block_hash = InceptionBlock(initial_data).block_hash.hex()
    return Shared(key, block_hash, block_hash[:HASH_DIGITS])


def _roster(roster: Iterable[int]) -> Shared:
    members = sorted(roster)
    return Shared("roster", tuple(members), ", ".join(ranges(members)))


def _fingerprint(key: str, sha256: str) -> Shared:
    return Shared(key, sha256, sha256[:HASH_DIGITS])


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= MAX_VALUE else f"{text[:MAX_VALUE]}…"


# What differs


def _unlike(carried: Sequence[Carried]) -> Iterator[Difference]:
    """Files that say otherwise than the manifest, or than most."""
    names = dict.fromkeys(name for file in carried for name in file.shared)
    for name in names:
        saying = [file for file in carried if name in file.shared]
        manifest = next((file for file in saying if file.kind == "manifest"), None)
        counts = Counter(file.shared[name].value for file in saying)
        wanted = manifest.shared[name].value if manifest else counts.most_common(1)[0][0]
        alike = [file for file in saying if file.shared[name].value == wanted]
        for file in saying:
            said = file.shared[name]
            if said.value == wanted or (name == FINGERPRINT and _told_by_key(file, alike)):
                continue
            where = manifest.path if manifest else alike[0].path
            others = f" and {len(alike) - 1} other{'s' if len(alike) > 2 else ''}" if len(alike) > 1 else ""
            what = f"`{said.key}`" if name not in (INCEPTION, FINGERPRINT) else f"`{said.key}` ({name})"
            yield Difference(
                file.path,
                said.key,
                f"{file.path}: {what} is {said.shown}, and {alike[0].shared[name].shown} in {where}{others}",
            )


def _told_by_key(file: Carried, others: Sequence[Carried]) -> bool:
    """Whether another mission file's settings say which of them differ."""
    return file.mission is not None and any(other.mission is not None for other in others)


def _not_distinct(carried: Sequence[Carried]) -> Iterator[Difference]:
    """Mission files that have alike what every vehicle has for itself."""
    for key in ("agent_id", "network.address", "seed"):
        first: dict[Hashable, Carried] = {}
        for file in carried:
            if file.mission is None:
                continue
            value: Hashable = file.mission.network.address if key == "network.address" else getattr(file.mission, key)
            if value in first:
                yield Difference(
                    file.path,
                    key,
                    f"{file.path}: `{key}` is {_shown(value)}, as in {first[value].path}, but must be "
                    "unique: one is wrong",
                )
            first.setdefault(value, file)


def _off_the_roster(carried: Sequence[Carried]) -> Iterator[Difference]:
    """Vehicles of the roster without a mission file, and files of vehicles that are not on it."""
    rosters = [file for file in carried if ROSTER in file.shared and file.kind in ("manifest", "mission file")]
    if not rosters:
        return
    by_count = Counter(file.shared[ROSTER].value for file in rosters)
    manifest = next((file for file in rosters if file.kind == "manifest"), None)
    roster: Any = manifest.shared[ROSTER].value if manifest else by_count.most_common(1)[0][0]
    for member, count in Counter(roster).items():
        if count > 1:
            yield Difference(rosters[0].path, "roster", f"{rosters[0].path}: `roster` names agent {member} twice")
    with_file = {file.agent_id for file in carried if file.kind == "mission file"}
    for member in dict.fromkeys(roster):
        if member not in with_file:
            yield Difference(None, "roster", f"agent {member} is on the `roster`, but its mission file is missing")
    for file in carried:
        if file.agent_id is not None and file.agent_id not in roster:
            yield Difference(
                file.path,
                "agent_id",
                f"{file.path}: `agent_id` {file.agent_id} is not on the roster of the other files",
            )


# Which files


def _files(paths: Iterable[Path]) -> list[tuple[Path, bool]]:
    """The files, each once, and whether it was named itself."""
    files: dict[Path, tuple[Path, bool]] = {}
    for path in paths:
        if path.is_dir():
            inside = _in_directory(path)
            if not inside:
                raise RunDirectoryError(f"{path}: holds no *{MISSION_SUFFIX} and no other files to compare")
            for file in inside:
                files.setdefault(file.resolve(), (file, False))
        elif path.exists():
            files[path.resolve()] = path, True
        else:
            raise RunDirectoryError(f"{path}: does not exist; give mission files (*{MISSION_SUFFIX}) or a directory")
    return list(files.values())


def _in_directory(directory: Path) -> list[Path]:
    """The JSON files in a directory or a run's; if there are none, those one level deeper, a directory per vehicle."""
    here = agents_directory(directory)
    for pattern in ("*.json*", "*/*.json*"):
        files = [path for path in here.glob(pattern) if path.is_file() and path.suffix in (".json", ".jsonl")]
        if files:
            return sorted(files, key=lambda path: (path.parent, len(path.name), path.name))
    return []
