"""YAML as text is written by people: numbers as YAML 1.2 reads them, no key twice, nothing that exhausts the memory.

YAML 1.1, which PyYAML reads, takes 010 for eight, 1:30 for ninety and 1_0 for ten.
"""

from __future__ import annotations

import re
from typing import IO, Any

import yaml
from yaml._yaml import CParser
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

MAX_DOCUMENT_VALUES = 1_000_000  # values in one document; more is a mistake or an attack on the memory
INTEGER_TAG, FLOAT_TAG = "tag:yaml.org,2002:int", "tag:yaml.org,2002:float"
INTEGER = re.compile(r"[-+]?\d+$")
FLOAT = re.compile(r"([-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$")


def load_yaml(text: str | IO[str]) -> Any:
    """The values of a YAML document. Raises yaml.YAMLError, ValueError or RecursionError where it is none."""
    return load_with_nodes(text)[0]


def load_with_nodes(text: str | IO[str]) -> tuple[Any, yaml.Node | None]:
    """As `load_yaml`, and the nodes of the document, which have their places in the ``text``; None where it is
    empty."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        return (None if node is None else loader.construct_document(node)), node
    finally:
        loader.dispose()


class _Loader(Composer, CParser, SafeConstructor, Resolver):
    """Safe YAML that refuses a key given twice.

    The text is scanned by libyaml, six times as fast as by PyYAML. Its nodes are composed by PyYAML: libyaml's way ends
    the program where they are nested too deeply.
    """

    def __init__(self, text: str | IO[str]) -> None:
        CParser.__init__(self, text)
        Composer.__init__(self)
        SafeConstructor.__init__(self)
        Resolver.__init__(self)

    yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in (INTEGER_TAG, FLOAT_TAG)]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }

    def get_single_node(self) -> yaml.Node | None:
        node: yaml.Node | None = super().get_single_node()
        if node is not None and _values(node, {}) > MAX_DOCUMENT_VALUES:
            problem = f"holds more than {MAX_DOCUMENT_VALUES} values, those repeated by * included"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (AttributeError, LookupError, TypeError) as error:  # PyYAML's own, as of `!!timestamp x` and `!!bool x`
            problem = f"expected a {node.tag.rpartition(':')[2]}, as the tag says"
            raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        known_keys = set()
        for key, _ in node.value if isinstance(node, yaml.MappingNode) else ():  # else PyYAML refuses it below
            if isinstance(key, yaml.ScalarNode) and key.value in known_keys:
                problem = f"the key {key.value!r} occurs twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            known_keys.add(key.value if isinstance(key, yaml.ScalarNode) else key)
        return super().construct_mapping(node, deep)


def _values(node: yaml.Node, known: dict[int, int]) -> int:
    """How many values ``node`` holds, one that an alias repeats counted each time."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = 1  # while it is counted: it may hold itself
        inner = node.value if isinstance(node, yaml.SequenceNode) else [part for pair in node.value for part in pair]
        known[id(node)] = 1 + sum(_values(part, known) for part in inner)
    return known[id(node)]


def _integer(loader: yaml.SafeLoader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node))


_Loader.add_implicit_resolver(INTEGER_TAG, INTEGER, list("-+0123456789"))
_Loader.add_implicit_resolver(FLOAT_TAG, FLOAT, list("-+.0123456789"))
_Loader.add_constructor(INTEGER_TAG, _integer)
