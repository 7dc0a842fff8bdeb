"""Public names of rooms against the rules of docs/conventions.md: types, shapes and units, exceptions, docstrings."""

from __future__ import annotations

import ast
import importlib
import inspect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from tests.public_names.docstring import ONE_FOR_ALL, OTHER_SHAPE, Text, has_shape, has_unit, mention, shapes
from tests.public_names.exceptions import unannounced
from tests.public_names.source import (
    DEFINITION,
    Arrays,
    Source,
    arrays_in,
    definition,
    docstring_at,
    methods,
    source_of,
)

ROOMS = (
    "ballfg",
    "ballfg.parallel",
    "ballfg.tracks",
    "ballfg.vision",
    "ballfg.dynamics",
    "ballfg.simulation",
    "ballfg.factors",
    "ballfg.estimation",
    "ballfg.prediction",
    "ballfg.live",
    "ballfg.learning",
    "ballfg.diagnosis",
    "ballfg.benchmarks",
)


@dataclass
class Item:
    """One public name, or one member of a public class, and what its docstring lacks."""

    room: str
    name: str
    place: str
    lacks: list[str] = field(default_factory=list)


def parameters(node: ast.FunctionDef | ast.AsyncFunctionDef, method: bool) -> list[ast.arg]:
    """The parameters that a caller gives."""
    arguments = node.args
    listed = [*arguments.posonlyargs, *arguments.args]
    static = any(isinstance(d, ast.Name) and d.id == "staticmethod" for d in node.decorator_list)
    listed = listed[1:] if method and not static else listed
    return [*listed, *filter(None, [arguments.vararg]), *arguments.kwonlyargs, *filter(None, [arguments.kwarg])]


def first_line(texts: list[Text]) -> list[str]:
    """Whether the first of the docstrings that is one begins with a line that ends in a period."""
    written = [text for text in texts if text.whole.strip()]
    if not written:
        return ["no docstring"]
    line = written[0].whole.strip().splitlines()[0].rstrip()
    return [] if line.endswith(".") else [f"first line does not end in a period: {line[:60]!r}"]


def array_parameters(
    arguments: list[ast.arg], source: Source, texts: list[Text], consumed: set[int] | None = None
) -> Iterator[str]:
    """What is missing of parameters that are arrays; `consumed` takes where the first text gives their shapes."""
    names = {argument.arg for argument in arguments}
    for argument in arguments:
        held = arrays_in(argument.annotation, source)
        if not held.count or held.told:
            continue
        found = None
        for text in texts:
            found = text.entry(argument.arg, names)
            if found is not None and has_shape(found):
                break
            beside = mention(text.sections[""], argument.arg)
            if beside is not None:
                if consumed is not None and text is texts[0]:  # a shape tells of one array
                    consumed.add(beside.start())
                found = text.sections[""]
                break
        yield from missing(f"parameter {argument.arg}", found, held)


def missing(what: str, text: str | None, held: Arrays) -> Iterator[str]:
    """Shape and unit that a text does not give for an array."""
    if text is None:
        yield f"{what}: not described (shape and unit)"
        return
    if not has_shape(text):
        yield f"{what}: no shape"
    if not held.boolean and not has_unit(text):
        yield f"{what}: no unit"


def check_returned(
    node: ast.FunctionDef | ast.AsyncFunctionDef, source: Source, texts: list[Text], consumed: set[int]
) -> Iterator[str]:
    """What is missing of arrays that a function returns."""
    held = arrays_in(node.returns, source)
    if not held.count or held.told:
        return
    lacks = list(missing("returns", None, held))
    for text in texts:
        said = text.sections.get("Returns", text.sections.get("Yields"))
        before = text.sections[""]
        if said is None or not has_shape(said):
            free = [shape for shape in shapes(before) if text is not texts[0] or shape.start() not in consumed]
            said = f"{before} {said or ''}" if free or OTHER_SHAPE.search(before) else said
        lacks = list(missing("returns", said, held))
        if said and not lacks and len(shapes(said)) < held.count and not ONE_FOR_ALL.search(said):
            lacks = [f"returns: {held.count} arrays, fewer shapes"]
        if not lacks:
            return
    yield from lacks


def check_function(
    node: ast.FunctionDef | ast.AsyncFunctionDef,
    source: Source,
    texts: list[Text],
    owner: ast.ClassDef | None = None,
    classes: Sequence[Text] = (),
) -> list[str]:
    """What a function or method lacks.

    Args:
        texts: its docstring, then those of the methods that it overrides; the first that speaks holds.
        classes: docstrings of its class and of that one's bases: they may tell of parameters for all methods.
    """
    arguments = parameters(node, owner is not None)
    lacks = first_line(texts)
    lacks += [f"parameter {argument.arg}: no type" for argument in arguments if argument.annotation is None]
    lacks += ["returns: no type"] if node.returns is None else []
    consumed: set[int] = set()
    lacks += array_parameters(arguments, source, [*texts, *classes], consumed)
    lacks += check_returned(node, source, texts, consumed)
    lacks += unannounced([node], source, owner, texts)
    return lacks


def check_fields(node: ast.ClassDef, source: Source, text: Text) -> Iterator[str]:
    """What is missing of the array fields in a class's body."""
    names = {s.target.id for s in node.body if isinstance(s, ast.AnnAssign) and isinstance(s.target, ast.Name)}
    for i, statement in enumerate(node.body):
        if not (isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)):
            continue
        name = statement.target.id
        held = arrays_in(statement.annotation, source)
        if held.count and not held.told and not name.startswith("_"):
            below = docstring_at(node.body, i + 1)
            yield from missing(f"field {name}", f"{name}: {below}" if below else text.entry(name, names), held)


def check_class(node: ast.ClassDef, source: Source) -> list[str]:
    """What a class lacks beside its methods: docstring, fields, and what its construction takes and raises."""
    text = Text.parse(ast.get_docstring(node))
    making = [method for method in methods(node) if method.name in ("__init__", "__post_init__", "__new__")]
    texts = [text, *(Text.parse(ast.get_docstring(method)) for method in making)]
    lacks = first_line([text]) + list(check_fields(node, source, text))
    for method in making:
        arguments = parameters(method, True)
        lacks += [f"parameter {argument.arg}: no type" for argument in arguments if argument.annotation is None]
        if method.name == "__init__":
            lacks += array_parameters(arguments, source, texts)
    return lacks + unannounced(list(making), source, node, texts)


def class_items(room: str, cls: type) -> Iterator[Item]:
    """A class and its public methods, those that it inherits from classes of the package too."""
    family = [c for c in cls.__mro__ if c.__module__.startswith("ballfg")]
    pairs = [(source_of(c.__module__), definition(source_of(c.__module__), c.__name__)) for c in family]
    known = [(source, node) for source, node in pairs if isinstance(node, ast.ClassDef)]
    classes = [Text.parse(ast.get_docstring(node)) for _, node in known]
    for i, (source, node) in enumerate(known):
        yield Item(room, node.name, f"{source.place}:{node.lineno}", check_class(node, source))
        for method in methods(node):
            if method.name.startswith("_") and method.name != "__call__":
                continue
            if any(isinstance(d, ast.Attribute) and d.attr in ("setter", "deleter") for d in method.decorator_list):
                continue
            overridden = [m for _, base in known[i + 1 :] for m in methods(base) if m.name == method.name]
            texts = [text for m in (method, *overridden) if (text := Text.parse(ast.get_docstring(m))).whole]
            lacks = check_function(method, source, texts, node, classes[i:])
            yield Item(room, f"{node.name}.{method.name}", f"{source.place}:{method.lineno}", lacks)


def items(room: str) -> list[Item]:
    """All public functions, classes and members of a room, each once; constants and aliases of types are none."""
    module = importlib.import_module(room)
    found: dict[str, Item] = {}
    for name in getattr(module, "__all__", ()):
        value = inspect.unwrap(getattr(module, name))
        if not getattr(value, "__module__", "").startswith("ballfg"):
            continue
        if inspect.isclass(value):
            for item in class_items(room, value):
                found.setdefault(item.place, item)
        elif inspect.isfunction(value):
            source = source_of(value.__module__)
            node = definition(source, value.__name__)
            assert isinstance(node, DEFINITION), f"{room}.{name} has no definition in {source.place}"
            lacks = check_function(node, source, [Text.parse(ast.get_docstring(node))])
            found.setdefault(f"{source.place}:{node.lineno}", Item(room, name, f"{source.place}:{node.lineno}", lacks))
    return list(found.values())


def report(room: str) -> str:
    """Share of the names of a room that lack nothing, and what the others lack."""
    names = items(room)
    if not names:
        return f"{room}: no public names"
    lines = [f"{item.place}: {item.name}: {lack}" for item in names for lack in item.lacks]
    good = sum(not item.lacks for item in names)
    summary = "lacks nothing" if good == len(names) else f"{len(lines)} lacks"
    return "\n".join([f"{room}: {100 * good / len(names):.0f} % of {len(names)} names, {summary}", *lines])
