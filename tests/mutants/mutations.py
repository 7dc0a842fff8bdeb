"""Small mistakes that somebody could make in a line of code: found in its syntax tree, put into its text."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

COMPARISONS: Final = {
    ast.Lt: ("<", ">="),
    ast.LtE: ("<=", ">"),
    ast.Gt: (">", "<="),
    ast.GtE: (">=", "<"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"),
    ast.In: ("in", "not in"),
    ast.NotIn: ("not in", "in"),
}
ARITHMETIC: Final = {ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*")}
LOGIC: Final = {ast.And: ("and", "or"), ast.Or: ("or", "and")}
EXTREMES: Final = {
    here: there
    for pair in (("min", "max"), ("minimum", "maximum"), ("argmin", "argmax"), ("nanmin", "nanmax"), ("fmin", "fmax"))
    for here, there in (pair, pair[::-1])
}
BOUNDS: Final = frozenset({"clip", "clamp", "maximum", "minimum", "max", "min"})
"""Calls that only bound their first argument, where they have more than one."""
MODULES: Final = frozenset({"np", "torch", "math"})
"""Of these `clip(x, low, high)` is a function; of anything else it is a method."""
NEGATED: Final = frozenset({"float", "int", "Array", "Tensor"})
"""Types of results that a sign can be put before."""
SAYS: Final = frozenset({"warn", "print", "echo", "watch"})
TEXTS: Final = frozenset({"__repr__", "__str__"})
LEFT_ALONE: Final = (ast.Import, ast.ImportFrom, ast.Raise, ast.Assert, ast.JoinedStr)


@dataclass(frozen=True)
class Mutation:
    """A change of one file.

    Attributes:
        file: below the root.  line: from 1, where the change begins.
        start, end: of the bytes that are replaced.
        before, after: these, and what stands there instead.
        old_line, new_line: the whole line without its indent, before and after.
    """

    file: str
    line: int
    start: int
    end: int
    before: str
    after: str
    old_line: str
    new_line: str

    def applied(self, source: bytes) -> bytes:
        """The file with the mistake in it."""
        assert source[self.start : self.end].decode() == self.before
        return source[: self.start] + self.after.encode() + source[self.end :]


def mutations_of(file: str, source: bytes) -> list[Mutation]:
    """All changes of a file, in the order of its lines; none of texts, annotations, imports and what is raised."""
    finder = _Finder(source)
    finder.visit(ast.parse(source))
    made = []
    for start, end, after in sorted(set(finder.found)):
        line = source[:start].count(b"\n") + 1
        before, changed = source[start:end].decode(), source[:start] + after.encode() + source[end:]
        lines = [text.decode().splitlines()[line - 1].strip() for text in (source, changed)]
        made.append(Mutation(file, line, start, end, before, after, *lines))
    return made


class _Finder(ast.NodeVisitor):
    """Collects (start, end, replacement) of bytes."""

    def __init__(self, source: bytes) -> None:
        self.source = source
        self.starts = [0, *(match.end() for match in re.finditer(rb"\n", source))]
        self.found: list[tuple[int, int, str]] = []
        self.result: str = ""
        self.indexing = False

    def _span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return self.starts[node.lineno - 1] + node.col_offset, self.starts[node.end_lineno - 1] + node.end_col_offset

    def _text(self, node: ast.expr) -> str:
        start, end = self._span(node)
        return self.source[start:end].decode()

    def _replace(self, node: ast.expr | ast.stmt, after: str) -> None:
        self.found.append((*self._span(node), after))

    def _between(self, left: ast.expr, right: ast.expr, old: str, new: str) -> None:
        """Replace an operator that stands between two operands."""
        start, end = self._span(left)[1], self._span(right)[0]
        pattern = r"\s+".join(map(re.escape, old.split()))
        match = re.search((rf"\b{pattern}\b" if old[0].isalpha() else pattern).encode(), self.source[start:end])
        if match is not None:
            self.found.append((start + match.start(), start + match.end(), new))

    def visit(self, node: ast.AST) -> None:
        if not isinstance(node, LEFT_ALONE):
            super().visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._block(node.body)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name in TEXTS:
            return
        outer, self.result = self.result, "" if node.returns is None else ast.unparse(node.returns)
        for default in (*node.args.defaults, *node.args.kw_defaults):
            if default is not None:
                self.visit(default)
        self._block(node.body)
        self.result = outer

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self.visit(node.body)

    def visit_Module(self, node: ast.Module) -> None:
        self._block(node.body)

    def visit_If(self, node: ast.If) -> None:
        if ast.unparse(node.test) not in ("TYPE_CHECKING", "__name__ == '__main__'"):
            self.visit(node.test)
            self._block(node.body)
            self._block(node.orelse)

    def generic_visit(self, node: ast.AST) -> None:
        for _, value in ast.iter_fields(node):
            if isinstance(value, list) and value and isinstance(value[0], ast.stmt):
                self._block(value)
            else:
                for child in value if isinstance(value, list) else [value]:
                    if isinstance(child, ast.AST):
                        self.visit(child)

    def _block(self, body: Sequence[ast.stmt]) -> None:
        for statement in body:
            if _is_droppable(statement):
                self._replace(statement, "pass")
            self.visit(statement)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_AugAssign(self, node: ast.AugAssign) -> None:
        if type(node.op) in ARITHMETIC:
            old, new = ARITHMETIC[type(node.op)]
            self._between(node.target, node.value, f"{old}=", f"{new}=")
        self.visit(node.target)
        self.visit(node.value)

    def visit_Return(self, node: ast.Return) -> None:
        if node.value is None:
            return
        if self.result in ("bool", "Mask"):
            self._replace(node.value, f"{'not ' if self.result == 'bool' else '~'}({self._text(node.value)})")
        elif self.result in NEGATED:
            self._replace(node.value, f"-({self._text(node.value)})")
        self.visit(node.value)

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, op, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            self._between(left, right, *COMPARISONS[type(op)])
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        texts = any(isinstance(side, ast.JoinedStr) or _is_text(side) for side in (node.left, node.right))
        if type(node.op) in ARITHMETIC and not texts:
            self._between(node.left, node.right, *ARITHMETIC[type(node.op)])
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for left, right in zip(node.values, node.values[1:], strict=False):
            self._between(left, right, *LOGIC[type(node.op)])
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if self.indexing and isinstance(node.op, ast.USub) and isinstance(node.operand, ast.Constant):
            self._replace(node, f"{self._text(node)} - 1")
            return
        if isinstance(node.op, ast.USub | ast.Not):
            self._replace(node, f"({self._text(node.operand)})")
        self.visit(node.operand)

    def visit_Constant(self, node: ast.Constant) -> None:
        if type(node.value) not in (int, float):
            return
        if self.indexing:
            self._replace(node, f"{self._text(node)} + 1")
        else:
            self._replace(node, f"{type(node.value)(1)}" if node.value == 0 else f"(2 * {self._text(node)})")

    def visit_Subscript(self, node: ast.Subscript) -> None:
        self.visit(node.value)
        outer, self.indexing = self.indexing, True
        self.visit(node.slice)
        self.indexing = outer

    def visit_Call(self, node: ast.Call) -> None:
        function = node.func
        name = getattr(function, "attr", getattr(function, "id", ""))
        if name in EXTREMES:
            end = self._span(function)[1]
            self.found.append((end - len(name), end, EXTREMES[name]))
        if name in BOUNDS:
            method = isinstance(function, ast.Attribute) and getattr(function.value, "id", "") not in MODULES
            if method and name in ("clip", "clamp"):
                assert isinstance(function, ast.Attribute)
                self._replace(node, self._text(function.value))
            elif not method and len(node.args) > 1 and not isinstance(node.args[0], ast.Starred):
                self._replace(node, f"({self._text(node.args[0])})")
        outer, self.indexing = self.indexing, False
        self.generic_visit(node)
        self.indexing = outer


def _is_droppable(statement: ast.stmt) -> bool:
    """Whether the rest can run without it: a call for its effect, a change of something that exists."""
    if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Call):
        function = statement.value.func
        return getattr(function, "attr", getattr(function, "id", "")) not in SAYS
    if isinstance(statement, ast.Assign):
        return all(isinstance(target, ast.Subscript | ast.Attribute) for target in statement.targets)
    return isinstance(statement, ast.AugAssign)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def by_line(mutations: Sequence[Mutation]) -> Iterator[list[Mutation]]:
    """Those of each line, lines in order."""
    for line in sorted({mutation.line for mutation in mutations}):
        yield [mutation for mutation in mutations if mutation.line == line]
