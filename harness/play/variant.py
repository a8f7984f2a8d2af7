"""Load protocol variants. A variant is a Python file in which a user changes algorithms of the protocol.

A variant changes some of Algorithms 1 to 20. For each changed algorithm, the file contains two implementations: the
handler that the agents use, and the function of the reference that judges the agents.

    '''Approve a tied vote.'''

    from harness.play.variant import of_core, of_reference

    @of_core(5)
    def approve_ties(core): ...

    @of_reference(5)
    def tied_vote_is_approved(state): ...

A variant replaces entries in the tables of `ucp.agent`, as if its user had edited `ucp/`. All users of the tables then
have the variant: every backend, the prover and the conformance test. The alternative was to pass a variant through all
of these layers. This would change each of them, and a layer that does not pass it on would use the original protocol
without an error.

The file is code of the user. It is loaded only if the user names it, never because a record names it.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, MutableMapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol, TypeVar, cast

from harness.errors import HarnessError
from ucp import agent
from ucp.handler import EventHandler, LocalEvent
from ucp.messages import Message
from ucp.plain_file import read_plain_file

LAST_ALGORITHM = 20


class VariantError(HarnessError):
    """An error: a variant cannot be loaded, or a run was made with a different variant."""


@dataclass(frozen=True)
class CoreChange:
    """A new handler, which replaces one algorithm of the agents in a variant. The fields after `run` list actions that
    only the new handler can make, such as sending further messages.
    """

    algorithm: int
    run: Callable[..., str]
    branches: tuple[str, ...] = ()
    sends: tuple[type[Message], ...] = ()
    starts: tuple[str, ...] = ()
    triggers: tuple[LocalEvent, ...] = ()

    def in_place_of(self, original: EventHandler[Any]) -> EventHandler[Any]:
        return replace(
            original,
            run=self.run,
            branches=original.branches + self.branches,
            sends=original.sends + self.sends,
            starts=original.starts + self.starts,
            triggers=original.triggers + self.triggers,
        )


@dataclass(frozen=True)
class ReferenceChange:
    """The new function of a variant for one algorithm of the reference implementation."""

    algorithm: int
    run: Callable[..., str]


def of_core(
    algorithm: int,
    *,
    branches: tuple[str, ...] = (),
    sends: tuple[type[Message], ...] = (),
    starts: tuple[str, ...] = (),
    triggers: tuple[LocalEvent, ...] = (),
) -> Callable[[Callable[..., str]], CoreChange]:
    """Return a decorator that declares a function as the new handler of an algorithm in the agents.

    The keyword arguments declare the additional actions of the new handler, compared with the original handler: the
    `branches` that it returns, the messages that it `sends`, the timers that it `starts`, and the local events that it
    `triggers`.
    """
    return lambda run: CoreChange(algorithm, run, branches, sends, starts, triggers)


def of_reference(algorithm: int) -> Callable[[Callable[..., str]], ReferenceChange]:
    """Return a decorator that declares a function as the new version of an algorithm in the reference."""
    return lambda run: ReferenceChange(algorithm, run)


@dataclass(frozen=True)
class Variant:
    """A protocol variant. `core` and `reference` map the number of each changed algorithm to the change."""

    name: str
    file: Path
    digest: str
    sentence: str
    core: Mapping[int, CoreChange]
    reference: Mapping[int, ReferenceChange]

    @property
    def version(self) -> str:
        """The name and digest of the variant, as run.json and other records contain them."""
        return f"{self.name} {self.digest}"

    @property
    def in_words(self) -> str:
        """The name and the changed algorithms, such as "approve_ties (Algorithm 5)"."""
        numbers = [str(number) for number in sorted(self.core)]
        return f"{self.name} (Algorithm{'s' * (len(numbers) > 1)} {', '.join(numbers)})"


MAX_BYTES = 1024 * 1024


def load_variant(path: Path) -> Variant:
    """Load a variant by executing its file, and return it. Raises VariantError."""
    try:
        content = read_plain_file(path, MAX_BYTES)
        module = ModuleType(path.stem)
        module.__file__ = str(path)
        exec(compile(content, path, "exec"), vars(module))  # noqa: S102  # it is the code of the user
    except OSError as error:
        raise VariantError(f"{path}: cannot be read: {error.strerror}") from None
    except Exception as error:
        raise VariantError(f"{path}: the variant cannot be loaded: {type(error).__name__}: {error}") from None
    found = vars(module).values()
    core = _by_algorithm(path, [value for value in found if isinstance(value, CoreChange)])
    reference = _by_algorithm(path, [value for value in found if isinstance(value, ReferenceChange)])
    if not core:
        raise VariantError(f"{path}: the variant changes nothing; declare a handler with of_core")
    for number in sorted(core.keys() ^ reference.keys()):
        has, lacks = ("of_core", "of_reference") if number in core else ("of_reference", "of_core")
        raise VariantError(f"{path}: Algorithm {number} has a function with {has} and none with {lacks}; add one")
    sentence = " ".join((module.__doc__ or "").split())
    return Variant(path.stem, path.resolve(), hashlib.sha256(content).hexdigest()[:12], sentence, core, reference)


Change = TypeVar("Change", CoreChange, ReferenceChange)


def _by_algorithm(path: Path, changes: list[Change]) -> dict[int, Change]:
    by_algorithm: dict[int, Change] = {}
    for change in changes:
        if not 1 <= change.algorithm <= LAST_ALGORITHM:
            raise VariantError(f"{path}: there is no Algorithm {change.algorithm}; name one of 1..{LAST_ALGORITHM}")
        if by_algorithm.setdefault(change.algorithm, change) is not change:
            raise VariantError(f"{path}: two functions change Algorithm {change.algorithm}; keep one of them")
    return by_algorithm


_in_use: list[Variant] = []


def variant_in_use() -> Variant | None:
    """Return the variant that this process uses. Return None if the process uses the original protocol."""
    return _in_use[-1] if _in_use else None


class NumberedHandler(Protocol):
    """Any handler that has the number of its algorithm."""

    @property
    def algorithm(self) -> int: ...


@contextmanager
def replaced(tables: list[MutableMapping[Any, Any]], new: Mapping[int, Callable[[Any], Any]]) -> Iterator[None]:
    """Return a context manager that replaces handlers in all `tables`. At the end of the context, it restores the
    original handlers. `new` maps the number of an algorithm to a function, which receives the original handler and
    returns the new one.
    """
    before = [dict(table) for table in tables]
    made: dict[int, Any] = {}
    for table in tables:
        for key, handler in table.items():
            number = cast(NumberedHandler, handler).algorithm
            if number in new:
                table[key] = made.setdefault(number, new[number](handler))
    try:
        yield
    finally:
        for table, entries in zip(tables, before, strict=True):
            table.update(entries)


@contextmanager
def core_in_force(variant: Variant) -> Iterator[None]:
    """Apply the variant to all agents that this process creates inside the context."""
    tables = [agent.ON_MESSAGE, agent.ON_TIMER, agent.ON_LOCAL_EVENT, agent.HANDLERS]
    with replaced(tables, {number: change.in_place_of for number, change in variant.core.items()}):  # type: ignore[arg-type]
        _in_use.append(variant)
        try:
            yield
        finally:
            _in_use.remove(variant)
