"""Reads files of OpenCV's FileStorage (XML, JSON, YAML) as plain values.

OpenCV's own parser trusts a matrix's rows, columns and type, and a file with one of them changed can make it write past
its memory. So this module reads the text: as YAML, of which JSON is a part, or as XML, within bounds.
"""

import math
import re
from pathlib import Path
from typing import Final, TypeAlias
from xml.etree import ElementTree

import numpy as np

from ballfg.checks import shown
from ballfg.files.strict_yaml import MAX_DEPTH, YamlError, parse_yaml

Tree: TypeAlias = str | list["Tree"] | dict[str, "Tree"] | None  # a scalar as written, a sequence, or a map
MAX_BYTES: Final = 1_000_000  # largest size of a file: each camera takes a few thousand
ENDINGS: Final = (".xml", ".json", ".yml", ".yaml")
_SHAPES: Final = (("rows", "cols"), ("sizes",))  # nodes with a matrix's size: of two dimensions, of any number
_TYPE: Final = re.compile(r"([1-9]?)[ucwsifdh]")  # type of a matrix: count and kind of the numbers in each place
_MAX_SIDE: Final = 1_000_000
_TOKEN: Final = re.compile(r'"(?:[^"\\]|\\.)*"|\S+', re.DOTALL)


def read_storage(path: Path) -> dict[str, Tree]:
    """The map at the top of a file; all values are text. Raises: ValueError: it cannot be parsed."""
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: must have at most {MAX_BYTES / 1e6:g} MB. Give the file of the cameras alone.")
    rule = f"{path}: must be a file of OpenCV's FileStorage"
    try:
        text = path.read_text(encoding="utf-8-sig")
        content = _from_xml(text) if path.suffix.lower() == ".xml" else _from_yaml(text)
    except (UnicodeDecodeError, YamlError, ElementTree.ParseError, _StorageError) as error:
        problem = error.problem if isinstance(error, YamlError) else " ".join(str(error).split())
        raise ValueError(f"{rule}; it cannot be parsed ({problem}). Correct it.") from None
    if not isinstance(content, dict):
        raise ValueError(f"{rule}, with names at its top. Correct it.")
    return content


def is_matrix(node: Tree) -> bool:
    """True if a node was written as a matrix."""
    return isinstance(node, dict) and {"dt", "data"} <= set(node) and any(set(shape) <= set(node) for shape in _SHAPES)


def number(node: Tree, where: str) -> float:
    """The number in a node. Raises: ValueError: another value; `where` begins the message."""
    text = node.strip().lower() if isinstance(node, str) else ""
    try:
        return float(text.replace(".nan", "nan").replace(".inf", "inf").replace("_", "x"))
    except ValueError:
        raise ValueError(f"{where} must be a number; got {shown(node)}. Correct it.") from None


def numbers(node: Tree, where: str) -> list[float] | list[list[float]]:
    """The numbers of a sequence or matrix, in rows if it has several and columns. Raises: ValueError: other values."""
    if isinstance(node, list) and all(isinstance(item, str) for item in node):
        return [number(item, where) for item in node]
    if not is_matrix(node):
        raise ValueError(f"{where} must be a matrix or a list of numbers. Correct it.")
    assert isinstance(node, dict)
    if "sizes" in node:
        sizes = node["sizes"] if isinstance(node["sizes"], list) else [node["sizes"]]
        first, *others = (_count(size, f"{where}, sizes") for size in sizes)
        rows, columns = (first, math.prod(others)) if others else (1, first)
    else:
        rows, columns = _count(node["rows"], f"{where}, rows"), _count(node["cols"], f"{where}, cols")
    kind = _TYPE.fullmatch(str(node["dt"]))
    if kind is None:
        raise ValueError(f"{where}, dt must be a type such as d; got {shown(node['dt'])}. Correct it.")
    data = node["data"]
    items = data if isinstance(data, list) else [] if data in (None, "") else [data]
    wanted = rows * columns * int(kind[1] or 1)
    if len(items) != wanted:
        raise ValueError(f"{where}, data must hold {wanted} numbers as rows, cols and dt say; got {len(items)}.")
    flat = [number(item, f"{where}, data") for item in items]
    if kind[0].endswith("f"):  # single precision has nine digits
        flat = np.asarray(flat, np.float32).astype(float).tolist()
    if rows <= 1 or wanted <= rows:
        return flat
    width = wanted // rows
    return [flat[row * width : (row + 1) * width] for row in range(rows)]


class _StorageError(ValueError):
    """Text in another format than FileStorage."""


def _count(node: Tree, where: str) -> int:
    value = number(node, where)
    if not (0 <= value <= _MAX_SIDE and value == int(value)):
        raise ValueError(f"{where} must be a whole number of at most {_MAX_SIDE}; got {shown(node)}. Correct it.")
    return int(value)


def _from_yaml(text: str) -> Tree:
    """A YAML or JSON file, without OpenCV's own first line and tags, and its escape of an apostrophe."""
    text = re.sub(r"\A%YAML[^\n]*\n?", "", text)
    text = re.sub(r"!!opencv-[a-z-]+", "", text).replace("\\'", "'")
    content: Tree = parse_yaml(text, "", text_only=True)
    return content


def _from_xml(text: str) -> Tree:
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):  # an entity may stand for a million others
        raise _StorageError("declarations such as <!DOCTYPE> have no place in it")
    root = ElementTree.fromstring(text)
    if root.tag != "opencv_storage":
        raise _StorageError("its outer node must be opencv_storage")
    content = _node(root, 0)
    return {} if content is None else content


def _node(element: ElementTree.Element, depth: int) -> Tree:
    if depth > MAX_DEPTH:
        raise _StorageError(f"nodes must be nested at most {MAX_DEPTH} deep")
    if len(element) == 0:
        tokens = [token.strip('"') for token in _TOKEN.findall(element.text or "")]
        return list(tokens) if len(tokens) > 1 else tokens[0] if tokens else None
    if all(child.tag == "_" for child in element):
        return [_node(child, depth + 1) for child in element]
    found: dict[str, Tree] = {}
    for child in element:
        if child.tag in found:
            raise _StorageError(f"{shown(child.tag)} stands twice")
        found[child.tag] = _node(child, depth + 1)
    return found
