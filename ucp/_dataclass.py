"""A small replacement for the standard library's `dataclass` and `field`, for a faster start. An agent must start fast
and need little memory. `dataclasses` imports `inspect`, which imports Python's parser, tokenizer and disassembler. It
also compiles each generated method separately. Together this took a fifth of an agent's start time. Other code can use
the classes of this module like any dataclass: `dataclasses.fields`, `replace`, `asdict` and pydantic accept them. This
module lacks features that no agent needs, such as order and inherited fields.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, get_origin

_CLASS_VAR: Any = ClassVar


class _FieldOptions(dict[str, Any]):
    """The options of a dataclass field, as in `dataclasses.field`."""


class _DescribedFields:
    """The value of `__dataclass_fields__` as the standard library defines it. It is computed when a program first reads
    it.
    """

    def __init__(self, kinds: dict[str, Any], fields: dict[str, _FieldOptions]) -> None:
        self._kinds = kinds
        self._fields = fields

    def __get__(self, instance: object, owner: type) -> dict[str, Any]:
        import dataclasses

        made = [(name, self._kinds[name], dataclasses.field(**options)) for name, options in self._fields.items()]
        described = {each.name: each for each in dataclasses.fields(dataclasses.make_dataclass(owner.__name__, made))}
        owner.__dataclass_fields__ = described  # type: ignore[attr-defined]
        return described


def _field(**options: Any) -> Any:
    return _FieldOptions(options)


def _dataclass(
    *, eq: bool = True, unsafe_hash: bool = False, frozen: bool = False, slots: bool = False
) -> Callable[[type], type]:
    def make(plain: type) -> type:
        kinds = {name: kind for name, kind in plain.__annotations__.items() if get_origin(kind) is not _CLASS_VAR}
        content = dict(vars(plain))
        for name in ("__dict__", "__weakref__"):
            content.pop(name, None)
        fields = {name: _options(content, name) for name in kinds}
        if slots:
            content["__slots__"] = tuple(fields)
        else:
            content |= {name: options["default"] for name, options in fields.items() if "default" in options}
        content |= _methods(fields, frozen=frozen, eq=eq, then="__post_init__" in content)
        if vars(plain).get("__hash__") is not None:
            content["__hash__"] = vars(plain)["__hash__"]
        elif eq and not (frozen or unsafe_hash):
            content["__hash__"] = None
        content["__match_args__"] = tuple(name for name, options in fields.items() if options.get("init", True))
        content["__dataclass_fields__"] = _DescribedFields(kinds, fields)
        return type(plain)(plain.__name__, plain.__bases__, content)

    return make


def _options(content: dict[str, Any], name: str) -> _FieldOptions:
    """Return the options of a field, and remove its default value from the class."""
    if name not in content:
        return _FieldOptions()
    default = content.pop(name)
    return default if isinstance(default, _FieldOptions) else _FieldOptions(default=default)


def _methods(fields: dict[str, _FieldOptions], *, frozen: bool, eq: bool, then: bool) -> dict[str, Any]:
    """Generate the methods of a dataclass from its fields, and return them. If `then` is true, `__init__` calls
    `__post_init__` at its end.
    """
    parameters, assignments = [], []
    given: dict[str, Any] = {"_set": object.__setattr__}
    for name, options in fields.items():
        if not options.get("init", True):
            continue
        value = name
        if "default" in options:
            given[f"_default_{name}"] = options["default"]
            parameters.append(f"{name}=_default_{name}")
        elif "default_factory" in options:
            given[f"_default_{name}"], given[f"_make_{name}"] = _MISSING, options["default_factory"]
            parameters.append(f"{name}=_default_{name}")
            value = f"_make_{name}() if {name} is _default_{name} else {name}"
        else:
            parameters.append(name)
        assignments.append(f"_set(self, {name!r}, {value})" if frozen else f"self.{name} = {value}")
    if then:
        assignments.append("self.__post_init__()")
    shown = ", ".join(f"{name}={{self.{name}!r}}" for name, options in fields.items() if options.get("repr", True))
    lines = [
        f"def __init__(self, {', '.join(parameters)}):",
        *(f"    {assignment}" for assignment in assignments),
        f"def __repr__(self): return f'{{self.__class__.__qualname__}}({shown})'",
    ]
    if eq:
        ours, theirs = (
            "".join(f"{whose}.{name}, " for name, options in fields.items() if options.get("compare", True))
            for whose in ("self", "other")
        )
        lines += [
            f"def __eq__(self, other): return ({ours}) == ({theirs})"
            " if other.__class__ is self.__class__ else NotImplemented",
            f"def __hash__(self): return hash(({ours}))",
        ]
    methods: dict[str, Any] = {}
    exec("\n".join(lines), given, methods)  # noqa: S102  names of fields, no inputs
    if frozen:
        methods |= {"__setattr__": _refuse, "__delattr__": _refuse, "__setstate__": _set_state}
    return methods


_MISSING = object()


def _refuse(self: object, name: str, *value: object) -> None:
    raise AttributeError(f"{name} of a {type(self).__name__} cannot be changed")


def _set_state(self: object, state: Any) -> None:
    """Set the attributes of an object that is restored from a copy or a pickle."""
    for content in state if isinstance(state, tuple) else (state,):
        for name, value in (content or {}).items():
            object.__setattr__(self, name, value)


if TYPE_CHECKING:
    from dataclasses import dataclass as dataclass
    from dataclasses import field as field
else:
    dataclass, field = _dataclass, _field
