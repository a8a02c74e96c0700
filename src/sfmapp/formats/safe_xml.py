"""XML from outside: no document type, so that no entity can grow or fetch anything, and limits on size and depth."""

from __future__ import annotations

from xml.etree import ElementTree
from xml.parsers import expat

from sfmapp.errors import InputError

_MOST_ELEMENTS, _DEEPEST = 5_000_000, 100


def read_xml(text: str | bytes, place: str) -> ElementTree.Element:
    """The outermost element.

    Args:
        place: begins messages: the file.

    Raises:
        InputError: it is no XML, declares entities or a document type, or is deeper or larger than anything true.
    """
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate(namespace_separator="}")
    depth = count = 0

    def refuse(*_: object) -> None:
        raise InputError(f"{place}: expected XML without a document type or entities, found a declaration of them")

    def named(name: str) -> str:
        return "{" + name if "}" in name else name

    def start(name: str, attributes: dict[str, str]) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > _DEEPEST or count > _MOST_ELEMENTS:
            raise InputError(f"{place}: expected XML of at most {_DEEPEST} levels and {_MOST_ELEMENTS} elements")
        builder.start(named(name), {named(key): value for key, value in attributes.items()})

    def end(name: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(named(name))

    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(text, True)
        return builder.close()
    except (expat.ExpatError, AssertionError, ValueError) as error:
        raise InputError(f"{place}: expected XML: {error}") from None
