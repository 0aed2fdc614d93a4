"""A Mitsuba scene file as a list of XML elements: defaults filled in, includes inlined, ids and files looked up."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar
from xml.etree import ElementTree

from scenes.errors import InputError, listed
from scenes.io.inputs import file_inside, read_bytes

MAX_INCLUDES = 256
MAX_DEPTH = 64
MAX_VALUE = 65536

Made = TypeVar("Made")


class LocatedError(InputError):
    """An InputError whose message already begins with the file it is about."""


class Notes:
    """Notes on what the loader changed or left out: one line a kind, with the names it happened to."""

    def __init__(self) -> None:
        self._names: dict[str, dict[str, None]] = {}

    def add(self, text: str, name: str = "") -> None:
        names = self._names.setdefault(text, {})
        if name:
            names[name] = None

    def lines(self) -> tuple[str, ...]:
        return tuple(text if not names else f"{text}: {listed(list(names))}" for text, names in self._names.items())


class _Builder(ElementTree.TreeBuilder):
    """Refuses a document type, the only place where entities can be declared, and elements nested without end."""

    def __init__(self) -> None:
        super().__init__()
        self._depth = 0

    def start(self, tag: str, attributes: dict[str, str]) -> ElementTree.Element:
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise InputError(f"elements are nested more than {MAX_DEPTH} deep")
        return super().start(tag, attributes)

    def end(self, tag: str) -> ElementTree.Element:
        self._depth -= 1
        return super().end(tag)

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise InputError("a DOCTYPE or entity declaration is not read; write the values out")


class Document:
    """A scene file with its includes inlined and its `$` parameters filled in."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes = Notes()
        self.legacy = False
        self.elements: list[ElementTree.Element] = []
        self._ids: dict[str, ElementTree.Element] = {}
        self._defaults: dict[str, str] = {}
        self._sources: dict[ElementTree.Element, Path] = {}
        self._made: dict[ElementTree.Element, object] = {}
        self._includes = 0
        root = _parse(path)
        if root.tag != "scene":
            raise LocatedError(f"{path}: the outermost element is <{root.tag}>, expected <scene>")
        self._check_version(root.get("version"))
        self._expand(root, path, (path.resolve(),))

    def _check_version(self, version: str | None) -> None:
        match = re.fullmatch(r"\s*(\d+)\.\d+(\.\d+)?\s*", version or "")
        if match is None or int(match[1]) not in (0, 2, 3):
            raise InputError(f"<scene version={version!r}>, expected 0.6.0 or 3.x")
        self.legacy = int(match[1]) == 0

    def _expand(self, root: ElementTree.Element, source: Path, stack: tuple[Path, ...]) -> None:
        for element in root:
            for inner in element.iter():
                self._sources[inner] = source
                self._fill_in(inner)
                if inner.tag == "default":
                    self._defaults.setdefault(self.need(inner, "name"), self.need(inner, "value"))
            if element.tag == "default":
                continue
            if element.tag == "include":
                self._include(element, stack)
            elif element.tag == "alias":
                self._register(element, self.need(element, "as"), self.target(element, self.need(element, "id")))
            elif element.tag == "path":
                self.notes.add("<path> is ignored, files are looked up beside the scene file")
            else:
                self._keep(element)

    def _fill_in(self, element: ElementTree.Element) -> None:
        """Replace `$name` in all attributes of one element: the longest known name that the text begins with."""
        known = "|".join(re.escape(name) for name in sorted(self._defaults, key=len, reverse=True) if name) or "(?!)"

        def value(match: re.Match[str]) -> str:
            if match[1] is None:
                raise self.error(
                    element, f'${match[2]} has no value, expected <default name="{match[2]}" value="..."/>'
                )
            return self._defaults[match[1]]

        for key, text in element.items():
            if "$" in text:
                filled = re.sub(rf"\$(?:({known})|(\w+))", value, text)
                if len(filled) > MAX_VALUE:
                    raise self.error(element, f"{key} grows over {MAX_VALUE} characters by its $names")
                element.set(key, filled)

    def _include(self, element: ElementTree.Element, stack: tuple[Path, ...]) -> None:
        path = self.file(element, self.need(element, "filename"), "included file")
        if path.resolve() in stack:
            raise self.error(element, f"{path.name} includes itself")
        self._includes += 1
        if self._includes > MAX_INCLUDES:
            raise self.error(element, f"there are more than {MAX_INCLUDES} includes")
        root = _parse(path)
        if root.tag != "scene":
            raise LocatedError(f"{path}: the outermost element is <{root.tag}>, expected <scene>")
        self._expand(root, path, (*stack, path.resolve()))

    def _keep(self, element: ElementTree.Element) -> None:
        self.elements.append(element)
        for inner in element.iter():
            name = inner.get("id")
            if name is not None and inner.tag != "ref":
                self._register(inner, name, inner)

    def _register(self, element: ElementTree.Element, name: str, target: ElementTree.Element) -> None:
        if name in self._ids:
            raise self.error(element, f"the id {name!r} is given twice")
        self._ids[name] = target

    def need(self, element: ElementTree.Element, attribute: str) -> str:
        """Return an attribute that must be there."""
        value = element.get(attribute)
        if value is None:
            raise self.error(element, f'lacks {attribute}="..."')
        return value

    def error(self, element: ElementTree.Element, message: str) -> LocatedError:
        """Return the one-line error about an element, with its file."""
        shown = " ".join(f'{key}="{element.get(key)}"' for key in ("type", "id", "name") if element.get(key))
        label = f"<{element.tag} {shown}>" if shown else f"<{element.tag}>"
        return LocatedError(f"{self._sources.get(element, self.path)}: {label}: {message}")

    def target(self, element: ElementTree.Element, name: str) -> ElementTree.Element:
        """Return the element that carries an id."""
        if name not in self._ids:
            raise self.error(element, f"unknown id {name!r}, known: {listed(sorted(self._ids)) or 'none'}")
        return self._ids[name]

    def shared(self, element: ElementTree.Element, make: Callable[[], Made]) -> Made:
        """Return what `make` makes of an element, once: all references to it share the one object."""
        if element not in self._made:
            self._made[element] = make()
        return self._made[element]  # type: ignore[return-value]  # what `make` made

    def file(self, element: ElementTree.Element, name: str, what: str) -> Path:
        """Return a file inside the scene's folder; anything else is refused, symbolic links followed."""
        try:
            return file_inside(self.path.parent, name, what, "the scene's folder")
        except InputError as error:
            raise self.error(element, str(error)) from None


def _parse(path: Path) -> ElementTree.Element:
    """Read the root element of an XML file without a document type."""
    try:
        data = read_bytes(path)
    except InputError as error:
        raise LocatedError(str(error)) from None
    try:
        return ElementTree.fromstring(data, parser=ElementTree.XMLParser(target=_Builder()))
    except InputError as error:
        raise LocatedError(f"{path}: {error}") from None
    except ElementTree.ParseError as error:
        raise LocatedError(f"{path}: broken XML, line {error.position[0]}: {str(error).split(':')[0]}") from None
    except (ValueError, LookupError) as error:
        raise LocatedError(f"{path}: broken XML ({error})") from None
