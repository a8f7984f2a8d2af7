"""A YAML loader that is safe with files of unknown origin."""

from collections.abc import Hashable, Iterator
from typing import Any

import yaml
from yaml.composer import Composer, ComposerError
from yaml.constructor import ConstructorError, SafeConstructor
from yaml.parser import Parser
from yaml.reader import Reader
from yaml.resolver import Resolver
from yaml.scanner import Scanner

from ucp.short_value import shown_key

try:
    from yaml._yaml import CParser  # three times as fast
except ImportError:  # PyYAML was built without libyaml

    class CParser(Reader, Scanner, Parser):  # type: ignore[no-redef]
        def __init__(self, text: str) -> None:
            Reader.__init__(self, text)
            Scanner.__init__(self)
            Parser.__init__(self)


MAX_NESTING = 50
MAX_VALUES = 300_000
MAX_NUMBER = 200
"""Maximum number of characters of a number or a time in a YAML file."""


class YamlLoader(Composer, CParser, SafeConstructor, Resolver):
    """A safe loader that rejects duplicate keys, deep nesting, many values, and long numbers.

    YAML forbids duplicate keys, but the safe loader of PyYAML uses the last one. When the loader counts values, it
    counts those in the anchor again for each alias of the anchor, because a few lines of aliases can stand for
    gigabytes. The time to convert a number grows with the square of its length.
    """

    def __init__(self, text: str) -> None:
        CParser.__init__(self, text)
        Composer.__init__(self)
        SafeConstructor.__init__(self)
        Resolver.__init__(self)
        self._depth = 0
        self._composed = 0
        self._values: dict[yaml.Node, int] = {}

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > MAX_NESTING:
            event: Any = self.peek_event()
            raise ComposerError(problem="it is nested too deeply", problem_mark=event.start_mark)
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        self._composed += 1
        if not isinstance(node, yaml.ScalarNode) and node not in self._values:
            self._values[node] = 1 + sum(self._values.get(part, 1) for part in _parts(node))
        if self._values.get(node, self._composed) > MAX_VALUES or self._composed > MAX_VALUES:
            raise ComposerError(problem=f"more than {MAX_VALUES} values", problem_mark=node.start_mark)
        return node

    def construct_scalar(self, node: Any) -> Any:
        if not node.tag.endswith(":str") and len(node.value) > MAX_NUMBER:
            raise ConstructorError(problem="a number of hundreds of digits", problem_mark=node.start_mark)
        return super().construct_scalar(node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen: set[str] = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in seen:
                problem = f"{shown_key(key.value)} is repeated"
                raise ConstructorError(problem=problem, problem_mark=key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _parts(node: yaml.Node) -> Iterator[yaml.Node]:
    if isinstance(node, yaml.MappingNode):
        for pair in node.value:
            yield from pair
    elif isinstance(node, yaml.SequenceNode):
        yield from node.value
