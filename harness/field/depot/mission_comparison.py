"""Compare the files of all vehicles key by key, to find out whether they belong to the same mission.

Mission files must be equal in all values that a swarm shares, and must differ in the values that are unique for each
vehicle. If a manifest exists, it contains the expected values. Without a manifest, the most frequent values are
expected. Chain exports and traces in the same directory must have the same inception block and roster. An unreadable
file counts as a difference.
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
from harness.archive.trace_files import PACKED_SUFFIX, has_rest, open_trace
from harness.archive.trace_files import SUFFIX as TRACE_SUFFIX
from harness.archive.traces import HEADER, MAX_LINE_BYTES
from harness.errors import ExportError, HarnessError, RunDirectoryError
from harness.field.depot.mission_files import FILE, Manifest, fingerprint
from harness.field.depot.mission_files import SUFFIX as MISSION_SUFFIX
from harness.report.chain_tree import ranges
from ucp.block import InceptionBlock
from ucp.mission import Mission, MissionError, load_mission
from ucp.plain_file import json_problem, parse_json
from ucp.quirks import active_quirks

Kind = Literal["mission file", "manifest", "chain export", "trace"]
INCEPTION, ROSTER, FINGERPRINT = "inception block", "roster", "settings fingerprint"
HASH_DIGITS = 12
MAX_VALUE = 60
_EXPECTED = (MISSION_SUFFIX, EXPORT_SUFFIX, TRACE_SUFFIX, PACKED_SUFFIX)
_READ = (".json", ".jsonl", PACKED_SUFFIX)


class UnreadableFileError(HarnessError):
    """An error: the file cannot be compared, because its format is unknown or it is damaged."""


@dataclass(frozen=True)
class SharedValue:
    """A value that must be the same in all files. `key` is the name of the value in the file from which it was read."""

    key: str
    value: Hashable
    shown: str


@dataclass
class ComparedFile:
    """A file of a vehicle or of the mission, with the values that are compared."""

    path: Path
    kind: Kind
    agent_id: int | None
    shared: dict[str, SharedValue]
    mission: Mission | None = None


@dataclass(frozen=True)
class MissionDifference:
    """A difference between the compared files. `file` is None if a file is missing. `key` is None if the whole file is
    wrong.
    """

    file: Path | None
    key: str | None
    sentence: str

    def __str__(self) -> str:
        return self.sentence


@dataclass
class MissionComparison:
    """The files of a mission that were compared, and their differences."""

    files: list[ComparedFile]
    differences: list[MissionDifference]

    @property
    def verdict(self) -> Literal["same", "differ", "nothing usable"]:
        if not self.files:
            return "nothing usable"
        return "differ" if self.differences else "same"

    def in_words(self) -> str:
        """Return a sentence with the values that are equal in all files."""
        kinds = Counter(file.kind for file in self.files)
        counted = ", ".join(f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in kinds.items())
        known = {name: shared.shown for file in self.files for name, shared in file.shared.items()}
        what = ", ".join(f"{name} {known[name]}" for name in (INCEPTION, ROSTER, FINGERPRINT) if name in known)
        equal_files = "are of one mission" if len(self.files) > 1 else "is of a mission"
        sentence = f"{counted} {equal_files}: {what}"
        if not kinds["mission file"]:
            sentence += "; without a mission file, settings, network and seeds were not compared"
        return sentence

    def to_json(self) -> dict[str, object]:
        return {
            "verdict": self.verdict,
            "files": [{"file": str(file.path), "kind": file.kind, "agent_id": file.agent_id} for file in self.files],
            "shared": {name: shared.shown for file in reversed(self.files) for name, shared in file.shared.items()}
            if self.verdict == "same"
            else {},
            "differences": [
                {
                    "file": None if difference.file is None else str(difference.file),
                    "key": difference.key,
                    "sentence": difference.sentence,
                }
                for difference in self.differences
            ],
        }


def compare(paths: Iterable[Path]) -> MissionComparison:
    """Compare the files in `paths`. A directory in `paths` stands for the files in it.

    Raises RunDirectoryError if a path does not exist, or a directory has no files to compare.
    """
    comparison = MissionComparison([], [])
    for path, named in _files(paths):
        try:
            comparison.files.append(read(path))
        except UnreadableFileError as error:
            is_empty = path.name.endswith(TRACE_SUFFIX) and not path.stat().st_size  # no line is written yet
            if named or (path.name.endswith(_EXPECTED) and not is_empty) or path.name == FILE:
                comparison.differences.append(MissionDifference(path, None, f"{path}: {error}"))
    comparison.differences += differences(comparison.files)
    return comparison


def differences(files: Sequence[ComparedFile]) -> list[MissionDifference]:
    """Return all differences between the files. Each of them shows that the files do not belong to one mission."""
    found = [*_deviating_values(files), *_duplicate_values(files), *_roster_differences(files)]
    for file in files:
        if file.mission is not None:
            found += [
                MissionDifference(
                    file.path, f"quirks.{name}", f"{file.path}: `quirks.{name}` asks for a mistake: set it to 0"
                )
                for name in active_quirks(file.mission.quirks)
            ]
    return found


# Reading files


def read(path: Path) -> ComparedFile:
    """Read a file of a vehicle or of the mission. Raises UnreadableFileError, whose message contains the reason but not
    the name of the file.
    """
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


def _beginning(path: Path) -> dict[str, object]:
    """Return the JSON object in the first line of the file. If the first line is not an object, return the object in
    the whole file.
    """
    try:
        with open_trace(path) as file:
            first = file.readline(MAX_LINE_BYTES)
            with contextlib.suppress(ValueError):
                if isinstance(document := parse_json(first), dict):
                    return document
            text = first + file.read(MAX_EXPORT_BYTES)
        document = parse_json(text)
    except OSError as error:
        raise UnreadableFileError(f"cannot be read: {error.strerror}") from None
    except ValueError as error:
        why = f"damaged: {json_problem(error)}" if text.strip() else "empty"
        raise UnreadableFileError(f"{why}; so its values are not compared") from None
    if not isinstance(document, dict):
        raise UnreadableFileError("not a mission file, manifest, chain export or trace")
    return document


def _of_mission(path: Path, mission: Mission) -> ComparedFile:
    shared = {
        INCEPTION: _inception("initial_data", mission.initial_data),
        ROSTER: _roster(mission.roster),
        FINGERPRINT: _fingerprint("settings", fingerprint(mission.settings)),
    }
    for name, value in dataclasses.asdict(mission.settings).items():
        shared[f"setting {name}"] = SharedValue(f"settings.{name}", value, _shown(value))
    for name, value in (
        ("broadcast address", mission.network.broadcast),
        ("port", mission.network.port),
    ):
        shared[name] = SharedValue(f"network.{name.split()[0]}", value, _shown(value))
    for name, value in (("speedup", mission.speedup), ("epoch_us", mission.epoch_us)):
        shared[name] = SharedValue(name, value, _shown(value))
    return ComparedFile(path, "mission file", mission.agent_id, shared, mission)


def _of_export(path: Path) -> ComparedFile:
    export = read_export(path)
    initial_data = base64.b64decode(export.inception.block_data)
    inception = InceptionBlock(initial_data)
    if inception.block_hash.hex() != export.inception.block_hash:
        raise UnreadableFileError("`inception.block_hash` does not match `inception.block_data`: it was edited")
    return ComparedFile(
        path, "chain export", export.agent_id, {INCEPTION: _inception("inception.block_data", initial_data)}
    )


def _of_trace(path: Path, document: dict[str, Any]) -> ComparedFile:
    header = HEADER.validate_python(document)
    if header.initial_data is None:
        raise UnreadableFileError("a trace of version 1 has no `initial_data`, so its mission is unknown")
    try:
        initial_data = base64.b64decode(header.initial_data, validate=True)
    except ValueError:
        raise UnreadableFileError("`initial_data` is not base64") from None
    return ComparedFile(
        path,
        "trace",
        header.agent_id,
        {INCEPTION: _inception("initial_data", initial_data), ROSTER: _roster(header.roster)},
    )


def _of_manifest(path: Path, document: dict[str, Any]) -> ComparedFile:
    manifest = Manifest.model_validate(document)
    block_hash = manifest.inception.block_hash
    return ComparedFile(
        path,
        "manifest",
        None,
        {
            INCEPTION: SharedValue("inception.block_hash", block_hash, block_hash[:HASH_DIGITS]),
            ROSTER: _roster(manifest.roster),
            FINGERPRINT: _fingerprint("settings_sha256", manifest.settings_sha256),
            "broadcast address": SharedValue("broadcast", manifest.broadcast, _shown(manifest.broadcast)),
            "port": SharedValue("port", manifest.port, _shown(manifest.port)),
        },
    )


def _inception(key: str, initial_data: bytes) -> SharedValue:
    block_hash = InceptionBlock(initial_data).block_hash.hex()
    return SharedValue(key, block_hash, block_hash[:HASH_DIGITS])


def _roster(roster: Iterable[int]) -> SharedValue:
    members = sorted(roster)
    return SharedValue("roster", tuple(members), ", ".join(ranges(members)))


def _fingerprint(key: str, sha256: str) -> SharedValue:
    return SharedValue(key, sha256, sha256[:HASH_DIGITS])


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= MAX_VALUE else f"{text[:MAX_VALUE]}…"


# Differences


def _deviating_values(files: Sequence[ComparedFile]) -> Iterator[MissionDifference]:
    """Yield a difference for each value that differs from the expected value. The manifest contains the expected
    values. Without a manifest, the most frequent value is expected.
    """
    names = dict.fromkeys(name for file in files for name in file.shared)
    for name in names:
        files_with_value = [file for file in files if name in file.shared]
        manifest = next((file for file in files_with_value if file.kind == "manifest"), None)
        counts = Counter(file.shared[name].value for file in files_with_value)
        expected = manifest.shared[name].value if manifest else counts.most_common(1)[0][0]
        equal_files = [file for file in files_with_value if file.shared[name].value == expected]
        for file in files_with_value:
            shared = file.shared[name]
            if shared.value == expected or (name == FINGERPRINT and _has_settings_to_compare(file, equal_files)):
                continue
            where = manifest.path if manifest else equal_files[0].path
            others = (
                f" and {len(equal_files) - 1} other{'s' if len(equal_files) > 2 else ''}"
                if len(equal_files) > 1
                else ""
            )
            what = f"`{shared.key}`" if name not in (INCEPTION, FINGERPRINT) else f"`{shared.key}` ({name})"
            yield MissionDifference(
                file.path,
                shared.key,
                f"{file.path}: {what} is {shared.shown}, and {equal_files[0].shared[name].shown} in {where}{others}",
            )


def _has_settings_to_compare(file: ComparedFile, others: Sequence[ComparedFile]) -> bool:
    """Return true if the settings can be compared one by one. The comparison then names the settings that differ, and
    does not report a different hash of all settings.
    """
    return file.mission is not None and any(other.mission is not None for other in others)


def _duplicate_values(files: Sequence[ComparedFile]) -> Iterator[MissionDifference]:
    """Yield a difference for each value that must be unique for each vehicle but occurs in several mission files."""
    for key in ("agent_id", "network.address", "seed"):
        first: dict[Hashable, ComparedFile] = {}
        for file in files:
            if file.mission is None:
                continue
            value: Hashable = file.mission.network.address if key == "network.address" else getattr(file.mission, key)
            if value in first:
                yield MissionDifference(
                    file.path,
                    key,
                    f"{file.path}: `{key}` is {_shown(value)}, as in {first[value].path}, but must be "
                    "unique: one is wrong",
                )
            first.setdefault(value, file)


def _roster_differences(files: Sequence[ComparedFile]) -> Iterator[MissionDifference]:
    """Yield a difference for each agent on the roster that has no mission file, and for each file of an agent that is
    not on the roster.
    """
    rosters = [file for file in files if ROSTER in file.shared and file.kind in ("manifest", "mission file")]
    if not rosters:
        return
    by_count = Counter(file.shared[ROSTER].value for file in rosters)
    manifest = next((file for file in rosters if file.kind == "manifest"), None)
    roster: Any = manifest.shared[ROSTER].value if manifest else by_count.most_common(1)[0][0]
    for member, count in Counter(roster).items():
        if count > 1:
            yield MissionDifference(
                rosters[0].path, "roster", f"{rosters[0].path}: `roster` names agent {member} twice"
            )
    with_file = {file.agent_id for file in files if file.kind == "mission file"}
    for member in dict.fromkeys(roster):
        if member not in with_file:
            yield MissionDifference(
                None, "roster", f"agent {member} is on the `roster`, but its mission file is missing"
            )
    for file in files:
        if file.agent_id is not None and file.agent_id not in roster:
            yield MissionDifference(
                file.path,
                "agent_id",
                f"{file.path}: `agent_id` {file.agent_id} is not on the roster of the other files",
            )


# Finding files


def _files(paths: Iterable[Path]) -> list[tuple[Path, bool]]:
    """Return each file once, in a pair. The second element is true if the user named the file itself, and false if the
    user named its directory.
    """
    files: dict[Path, tuple[Path, bool]] = {}
    for path in paths:
        if path.is_dir():
            found_files = _in_directory(path)
            if not found_files:
                raise RunDirectoryError(f"{path}: holds no *{MISSION_SUFFIX} and no other files to compare")
            for file in found_files:
                files.setdefault(file.resolve(), (file, False))
        elif path.exists():
            files[path.resolve()] = path, True
        else:
            raise RunDirectoryError(f"{path}: does not exist; give mission files (*{MISSION_SUFFIX}) or a directory")
    return list(files.values())


def _in_directory(directory: Path) -> list[Path]:
    """Return the JSON files in a directory. If it has none, return the JSON files in its subdirectories, because each
    vehicle may have its own subdirectory.
    """
    agents_folder = agents_directory(directory)
    for pattern in ("*.json*", "*/*.json*"):
        files = [path for path in agents_folder.glob(pattern) if path.is_file() and path.name.endswith(_READ)]
        files = [path for path in files if not has_rest(path)]
        if files:
            return sorted(files, key=lambda path: (path.parent, len(path.name), path.name))
    return []
