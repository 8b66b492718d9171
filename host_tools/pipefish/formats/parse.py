"""What the readers share: text, YAML with OpenCV's habits, and values that are named in errors."""

from __future__ import annotations

import json
import math
import re
import reprlib
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import yaml

from ..errors import ProfileError
from ..lenses import Lens

BYTES_MAX = 4 << 20  # a splined model of 60 x 40 control points is 120 kB
YAML_MAX = 512 << 10  # PyYAML reads some 200 kB a second; a calibration of 50 pictures with all its points is 200 kB


class Found:
    """One camera of a file: its name there, its lens, and what to tell people about it. Raises ProfileError, with the
    camera and the parameter, where the lens's model is not defined."""

    def __init__(self, name: str, lens: Lens, *notes: str) -> None:
        self.name, self.lens, self.notes = name, lens, list(notes)
        if wrong := lens.wrong():
            raise ProfileError(None, f"{name}.{wrong[0]}", wrong[1])


class Node:
    """A mapping out of a file; missing and wrong entries raise ProfileError with their place."""

    def __init__(self, value: Any, where: str = "") -> None:
        if not isinstance(value, dict):
            raise ProfileError(None, where or None, "not a mapping of names to values")
        self.value, self._where = value, where

    def __contains__(self, key: str) -> bool:
        return self.value.get(key) is not None

    def place(self, key: str) -> str:
        """The key with all that it lies in."""
        return f"{self._where}.{key}" if self._where else key

    def get(self, key: str) -> Any:
        """The value; ProfileError if it is missing."""
        if key not in self:
            raise ProfileError(None, self.place(key), "missing")
        return self.value[key]

    def child(self, key: str) -> Node:
        """A mapping inside."""
        return Node(self.get(key), self.place(key))

    def text(self, key: str, default: str | None = None) -> str:
        """A text."""
        if default is not None and key not in self:
            return default
        value = self.get(key)
        if not isinstance(value, str):
            raise ProfileError(None, self.place(key), "not a text")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number."""
        return default if default is not None and key not in self else finite(self.get(key), self.place(key))

    def numbers(self, key: str, counts: int | Sequence[int] | None = None) -> tuple[float, ...]:
        """A list of numbers, or an OpenCV or ROS matrix of them, of one of the lengths `counts`."""
        value = self.get(key)
        if isinstance(value, dict) and "data" in value:
            value = value["data"]
        return number_list(value, self.place(key), counts)

    def size(self, width: str = "width", height: str = "height") -> tuple[int, int]:
        """Two whole numbers."""
        return whole(self.get(width), self.place(width)), whole(self.get(height), self.place(height))


def shown(value: Any) -> str:
    """A value for an error's text: short, however large it is."""
    return reprlib.repr(value)[:60]


def finite(value: Any, where: str) -> float:
    """A finite number out of a number or its text (YAML 1.1 takes 1e-05 for a text)."""
    try:
        result = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        raise ProfileError(None, where, f"not a number: {shown(value)}") from None
    if not math.isfinite(result):
        raise ProfileError(None, where, "not a finite number")
    return result


def whole(value: Any, where: str) -> int:
    """A positive whole number; 966.0 too."""
    result = finite(value, where)
    if result != int(result) or not 1 <= result <= 16384:
        raise ProfileError(None, where, f"not a number of pixels, 1 to 16384: {shown(value)}")
    return int(result)


def number_list(value: Any, where: str, counts: int | Sequence[int] | None = None) -> tuple[float, ...]:
    """Numbers; lists of lists are flattened."""
    if not isinstance(value, list | tuple):
        raise ProfileError(None, where, "not a list of numbers")
    flat = [item for row in value for item in (row if isinstance(row, list | tuple) else [row])]
    allowed = (counts,) if isinstance(counts, int) else counts
    if allowed is not None and len(flat) not in allowed:
        wanted = " or ".join(map(str, allowed))
        raise ProfileError(None, where, f"{len(flat)} numbers where {wanted} belong")
    return tuple(finite(item, f"{where}[{i}]") for i, item in enumerate(flat))


class _Loader(yaml.SafeLoader):
    """YAML as OpenCV, ROS and Kalibr write it; a key twice is an error."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):  # a few lines of them stand for terabytes, and no calibration has one
            event = self.peek_event()
            raise ProfileError(None, f"line {event.start_mark.line + 1}", f"the alias *{event.anchor:.40} is not read")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str):
                if key in seen:
                    raise ProfileError(None, f"line {key_node.start_mark.line + 1}", f"{key} appears twice")
                seen.add(key)
        return super().construct_mapping(node, deep)


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)
_Loader.add_constructor("tag:yaml.org,2002:opencv-nd-matrix", _opencv_matrix)
# Dates stay texts: no calibration needs one, and PyYAML stumbles over impossible ones.
_Loader.add_constructor("tag:yaml.org,2002:timestamp", yaml.SafeLoader.construct_yaml_str)


def decode(data: bytes) -> str:
    """UTF-8 text of a file of reasonable size."""
    if len(data) > BYTES_MAX:
        raise ProfileError(None, None, f"longer than {BYTES_MAX} bytes: this is not a calibration")
    try:
        return data.decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ProfileError(None, f"byte {error.start}", "not UTF-8 text: this is not a calibration") from None


def parse_yaml(text: str) -> Any:
    """A YAML document; OpenCV's first line `%YAML:1.0` is no YAML and is left out, and so is what is empty before and
    after a `---`: ROS prints one behind each message."""
    if len(text) > YAML_MAX:
        raise ProfileError(None, None, f"YAML longer than {YAML_MAX} bytes: this is not a calibration")
    text = re.sub(r"\A%YAML:[^\n]*\n", "\n", text)
    try:
        documents = [d for d in yaml.load_all(text.replace("\t", "  "), Loader=_Loader) if d is not None]
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or "cannot be read"
        place = f"line {mark.line + 1} column {mark.column + 1}" if mark else None
        raise ProfileError(None, place, f"not YAML: {problem}") from None
    except (ValueError, RecursionError, TypeError) as error:
        raise ProfileError(None, None, f"not YAML: {error}") from None
    if len(documents) > 1:
        raise ProfileError(None, None, f"{len(documents)} documents, divided by ---, where one belongs")
    return documents[0] if documents else None


def parse_xml(text: str) -> Any:
    """The XML of OpenCV's FileStorage, as the mapping that its YAML would be. Entities are not read: OpenCV writes none
    but XML's own, and a few lines of them stand for terabytes."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ProfileError(None, None, "XML with a DOCTYPE or ENTITY is not read")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        line, column = getattr(error, "position", (1, 0))
        place = f"line {line} column {column + 1}"
        raise ProfileError(None, place, f"not XML: {str(error).partition(':')[0]}") from None
    if root.tag != "opencv_storage":
        raise ProfileError(None, None, f"XML of <{root.tag:.40}>, not OpenCV's <opencv_storage>")
    return _xml_value(root, "", 0)


def _xml_value(element: ElementTree.Element, where: str, depth: int) -> Any:
    """A mapping, a list (of elements named _, or of words), or a single number or text."""
    if depth > 20:
        raise ProfileError(None, where[:80], "too deep for a calibration")
    inner = [(child.tag, _xml_value(child, f"{where}.{child.tag}".strip("."), depth + 1)) for child in element]
    if inner and all(tag == "_" for tag, _ in inner):
        return [value for _, value in inner]
    if inner:
        mapping = dict(inner)
        if len(mapping) < len(inner):
            raise ProfileError(None, where or None, "a name appears twice")
        return mapping
    text = (element.text or "").strip()
    if text.startswith('"'):
        return text.strip('"')
    words = [_xml_word(word) for word in text.split()]
    return words if len(words) > 1 or element.tag == "data" else words[0] if words else None


def _xml_word(word: str) -> Any:
    try:
        return float(word)
    except ValueError:
        return word


def parse_json(text: str) -> Any:
    """A JSON document."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        place = f"line {error.lineno} column {error.colno}" if isinstance(error, json.JSONDecodeError) else None
        raise ProfileError(None, place, f"not JSON: {getattr(error, 'msg', error)}") from None
