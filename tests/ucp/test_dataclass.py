"""Compare the dataclass decorator of `ucp` with that of the standard library."""

import copy
import dataclasses
import pickle
from typing import Any, ClassVar

import pytest
from pydantic import TypeAdapter

from ucp._dataclass import dataclass, field
from ucp.settings import Settings


@dataclass(frozen=True, slots=True)
class Frozen:
    KIND: ClassVar[str] = "of all"
    number: int
    hidden: bytes = field(default=b"", repr=False)
    twice: int = field(init=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "twice", 2 * self.number)


@dataclass(slots=True)
class Changing:
    name: str
    parts: list[int] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Unequal:
    name: str = "so"


MADE: list[Any] = [Frozen(3, b"x"), Changing("a"), Changing("a", [1]), Unequal(), Settings(vote_timeout_s=3.0)]


def of_the_standard_library(kind: Any) -> Any:
    fields = [(each.name, each.type, _anew(each)) for each in dataclasses.fields(kind)]
    parameters = {"eq": kind is not Unequal, "frozen": kind not in (Changing,), "slots": kind is not Unequal}
    methods = {name: vars(kind)[name] for name in ("__post_init__", "_check", "told") if name in vars(kind)}
    return dataclasses.make_dataclass(kind.__name__, fields, namespace=methods, **parameters)


def _anew(each: dataclasses.Field[Any]) -> Any:
    names = ("default", "default_factory", "init", "repr", "compare")
    return dataclasses.field(**{name: getattr(each, name) for name in names})


@pytest.mark.parametrize("made", MADE, ids=repr)
def test_dataclass_equals_that_of_the_standard_library(made: Any) -> None:
    theirs = of_the_standard_library(type(made))
    arguments = {each.name: getattr(made, each.name) for each in dataclasses.fields(made) if each.init}
    twin = theirs(**arguments)
    assert repr(made) == repr(twin).replace(theirs.__qualname__, type(made).__qualname__)
    assert dataclasses.asdict(made) == dataclasses.asdict(twin)
    assert hasattr(made, "__dict__") == hasattr(twin, "__dict__")
    assert (type(made).__hash__ is None) == (theirs.__hash__ is None)
    assert type(made).__match_args__ == theirs.__match_args__


def test_objects_of_one_class_with_equal_fields_are_equal() -> None:
    assert Frozen(3) == Frozen(3)
    assert hash(Frozen(3)) == hash(Frozen(3))
    assert Frozen(3) != Frozen(3, b"x")
    assert Changing("a") != Frozen(3)
    assert Unequal() != Unequal()
    with pytest.raises(TypeError):
        hash(Changing("a"))


def test_default_factory_gives_each_object_its_own_value() -> None:
    one, other = Changing("a"), Changing("b")
    one.parts.append(1)
    assert other.parts == []


@pytest.mark.parametrize("made", [Frozen(3), Unequal()], ids=repr)
def test_frozen_object_cannot_be_changed(made: Any) -> None:
    name = dataclasses.fields(made)[0].name
    with pytest.raises(AttributeError):
        setattr(made, name, 4)
    with pytest.raises(AttributeError):
        delattr(made, name)


@pytest.mark.parametrize("made", [made for made in MADE if not isinstance(made, Unequal)], ids=repr)
def test_object_survives_pickle_and_copy(made: Any) -> None:
    assert pickle.loads(pickle.dumps(made)) == made  # noqa: S301  made here
    assert copy.deepcopy(made) == copy.copy(made) == made
    assert dataclasses.replace(made) == made


def test_pydantic_validates_the_class() -> None:
    assert TypeAdapter(Changing).validate_json('{"name": "a", "parts": [1]}') == Changing("a", [1])
    with pytest.raises(ValueError, match="parts"):
        TypeAdapter(Changing).validate_json('{"name": "a", "parts": ["x"]}')
