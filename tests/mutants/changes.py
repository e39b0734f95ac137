"""Wrong changes of a source file, each of one expression or one statement, as a tired programmer makes them."""

import ast
import copy
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any, NamedTuple

type Node = ast.AST


def _table(text: str) -> dict[type[Node], list[type[Any]]]:
    rows = [row.split() for row in text.split(",")]
    return {getattr(ast, right): [getattr(ast, name) for name in wrong] for right, *wrong in rows}


_COMPARISONS = _table(
    "Lt LtE GtE, LtE Lt Gt, Gt GtE LtE, GtE Gt Lt, Eq NotEq, NotEq Eq, Is IsNot, IsNot Is, In NotIn, NotIn In"
)
_ARITHMETIC = _table(
    "Add Sub, Sub Add, Mult Div, Div Mult, FloorDiv Mult, Mod FloorDiv, Pow Mult, LShift RShift, RShift LShift,"
    "BitAnd BitOr, BitOr BitAnd"
)
# Exchanging their first two arguments changes nothing.
_SYMMETRIC = {"max", "min", "maximum", "minimum", "hypot", "add", "multiply", "array_equal", "vdot", "dist", "gcd"}
_NO_CODE = (ast.Import, ast.ImportFrom, ast.TypeAlias, ast.Assert, ast.Global, ast.JoinedStr)
# Types, and what only persons or type checkers read.
_IGNORED_FIELDS = {"annotation", "returns", "decorator_list", "type_params", "bases", "pattern", "guard", "type"}
_IGNORED_CALLS = {"cast", "TypeVar", "NewType"}
_IGNORED_NAMES = {"__all__", "__slots__", "__repr__", "__str__"}
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases")
_SMALL_INTEGER = 10
# A literal string; a long one in a name would only make the name long.
_TEXT = re.compile(r"""f?(["'])(?:\\.|(?!\1).)*\1""")
_LONG_TEXT = 22


class Mutant(NamedTuple):
    """One wrong change."""

    name: str  # file, function, statement before and after: the same as long as that statement stays as it is
    file: str
    number: int  # position among the changes of the file
    lines: range  # of the statement without the blocks that it heads; empty outside functions


class _Place(NamedTuple):
    """A node, where it hangs, the function and the statement that hold it, and what that function returns."""

    node: Node
    parent: Node
    field: str
    at: int | None
    function: tuple[str, ...]
    statement: Node
    inside: bool
    returns: str

    @contextmanager
    def replaced(self, new: Node) -> Iterator[None]:
        """Put another node into the tree for a while."""
        self._put(new)
        try:
            yield
        finally:
            self._put(self.node)

    def _put(self, node: Node) -> None:
        if self.at is None:
            setattr(self.parent, self.field, node)
        else:
            getattr(self.parent, self.field)[self.at] = node


def mutants_of(file: str, source: str) -> list[Mutant]:
    """Return all mutants of a file."""
    mutants, uses = [], Counter[str]()
    for number, (place, _, after) in enumerate(_changes(ast.parse(source))):
        name = f"{file} {'.'.join(place.function) or '(module)'}: {_header(place.statement)} ⇒ {after}"
        uses[name] += 1
        name += f" ({uses[name]})" if uses[name] > 1 else ""
        mutants.append(Mutant(name, file, number, _lines(place.statement) if place.inside else range(0)))
    return mutants


def mutated(source: str, number: int) -> str:
    """Return the source with one of its changes."""
    tree = ast.parse(source)
    place, new, _ = next(islice(_changes(tree), number, None))
    with place.replaced(new):
        return ast.unparse(tree)


def _changes(tree: ast.Module) -> Iterator[tuple[_Place, Node, str]]:
    """Yield each place with what may stand there, and its statement with that; none twice."""
    texts = set()
    for place in _places(tree, tree, (), False, ""):
        for new in _replacements(place):
            with place.replaced(new):
                text = _header(new if place.node is place.statement else place.statement)
            if (id(place.statement), text) not in texts:
                texts.add((id(place.statement), text))
                yield place, new, text


def _places(parent: Node, statement: Node, function: tuple[str, ...], inside: bool, returns: str) -> Iterator[_Place]:
    """Yield the nodes below `parent` that are code."""
    for field, value in ast.iter_fields(parent):
        if field in _IGNORED_FIELDS or (isinstance(parent, ast.ClassDef) and field == "keywords"):
            continue
        for at, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(node, ast.AST) or _is_ignored(node, parent):
                continue
            holder = node if isinstance(node, (ast.stmt, ast.ExceptHandler)) else statement
            # The defaults of a function belong to its definition
            within = inside or (isinstance(parent, ast.FunctionDef) and field == "body")
            yield _Place(node, parent, field, at, function, holder, within, returns)
            name = (node.name,) if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else ()
            result = ast.unparse(node.returns) if isinstance(node, ast.FunctionDef) and node.returns else returns
            yield from _places(node, holder, (*function, *name), within, result)


def _is_ignored(node: Node, parent: Node) -> bool:
    """Return whether a node is no code: documentation, types, messages."""
    match node:
        case ast.Expr(value=ast.Constant()) | ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return True
        case ast.Call(func=ast.Name(id=name)) if name in _IGNORED_CALLS:
            return True
        case ast.keyword(arg="strict"):  # lengths that differ are bugs, which no test can bring about
            return True
        case ast.FunctionDef(name=name) | ast.Assign(targets=[ast.Name(id=name)]) if name in _IGNORED_NAMES:
            return True
    return isinstance(node, _NO_CODE) or isinstance(parent, ast.Raise)


def _replacements(place: _Place) -> Iterator[Node]:
    """Yield what may stand in place of a node."""
    match place.node:
        case ast.Compare(left, operators, operands):
            for k, operator in enumerate(operators):
                for wrong in _COMPARISONS[type(operator)]:
                    yield ast.Compare(left, [*operators[:k], wrong(), *operators[k + 1 :]], operands)
        case ast.BoolOp(operator, values):
            yield ast.BoolOp(ast.And() if isinstance(operator, ast.Or) else ast.Or(), values)
            for k in range(len(values)):
                rest = [*values[:k], *values[k + 1 :]]
                yield ast.BoolOp(operator, rest) if len(rest) > 1 else rest[0]
        case ast.UnaryOp(ast.Not() | ast.USub(), operand):
            yield operand
        case ast.BinOp(left, operator, right) if type(operator) in _ARITHMETIC and not (
            _is_text(left) or _is_text(right)
        ):
            yield ast.BinOp(left, _ARITHMETIC[type(operator)][0](), right)
        case ast.Constant(value):
            yield from (ast.Constant(wrong) for wrong in _wrong_values(value))
        case ast.Call(function, [first, second, *rest], keywords) if _order_matters(function, first, second):
            yield ast.Call(function, [second, first, *rest], keywords)
        case ast.IfExp(test, body, orelse):
            yield ast.IfExp(_negated(test), body, orelse)
        case ast.stmt():
            yield from _wrong_statements(place)


def _wrong_statements(place: _Place) -> Iterator[Node]:
    """Yield what may stand in place of a statement."""
    in_branch = not isinstance(place.parent, (ast.Module, ast.ClassDef, ast.FunctionDef))
    match place.node:
        case ast.If(test, body, orelse):
            yield ast.If(_negated(test), body, orelse)
            if not orelse:
                yield ast.If(ast.Constant(False), body, orelse)
        case ast.Return(value) if value is not None and not (isinstance(value, ast.Constant) and value.value is None):
            yield ast.Return(_wrong_result(value, place.returns))
        case ast.Raise() | ast.Expr(ast.Call()):
            yield ast.Pass()
        case ast.Assign(targets) if in_branch or not isinstance(targets[0], (ast.Name, ast.Tuple)):
            yield ast.Pass()
        case ast.AugAssign(target, operator, value):
            yield ast.Pass()
            if type(operator) in _ARITHMETIC:
                yield ast.AugAssign(target, _ARITHMETIC[type(operator)][0](), value)


def _wrong_result(value: ast.expr, returns: str) -> ast.expr:
    """Return what a function may return wrongly."""
    if returns == "bool":
        return _negated(value)
    return ast.UnaryOp(ast.USub(), value) if returns in ("int", "float") else ast.Constant(None)


def _negated(test: ast.expr) -> ast.expr:
    """Return the contrary of a test, as the other changes would write it, so that none is made twice."""
    match test:
        case ast.UnaryOp(ast.Not(), operand):
            return operand
        case ast.Compare(left, [operator], operands):
            return ast.Compare(left, [_COMPARISONS[type(operator)][-1]()], operands)
        case ast.Constant(bool() as value):
            return ast.Constant(not value)
    return ast.UnaryOp(ast.Not(), test)


def _wrong_values(value: object) -> tuple[float, ...]:
    """Return wrong values of a constant."""
    match value:
        case bool():
            return (not value,)
        case int():
            return (value + 1, value - 1) if abs(value) <= _SMALL_INTEGER else (2 * value, 0)
        case float():
            return (1.5 * value, 0.0) if value else (1.0,)
    return ()


def _is_text(node: Node) -> bool:
    """Return whether a node is a literal string, which arithmetic joins or formats."""
    return isinstance(node, ast.JoinedStr) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _order_matters(function: Node, first: Node, second: Node) -> bool:
    """Return whether two arguments can be exchanged and the exchange is a change."""
    name = ast.unparse(function).rpartition(".")[2]
    starred = isinstance(first, ast.Starred) or isinstance(second, ast.Starred)
    return name not in _SYMMETRIC and not starred and ast.dump(first) != ast.dump(second)


def _header(statement: Node) -> str:
    """Return a statement without the block that it heads."""
    bare = copy.copy(statement)
    for block in (*_BLOCKS, "decorator_list"):
        if hasattr(bare, block):
            setattr(bare, block, [])
    text = " ".join(ast.unparse(bare).split())
    return _TEXT.sub(lambda match: match[0] if len(match[0]) < _LONG_TEXT else f"{match[1]}…{match[1]}", text)


def _lines(statement: Node) -> range:
    """Return the lines of a statement without the blocks that it heads."""
    assert isinstance(statement, (ast.stmt, ast.ExceptHandler))
    blocks = [getattr(statement, block, []) for block in _BLOCKS]
    starts = [block[0].lineno for block in blocks if block and isinstance(block[0], (ast.stmt, ast.ExceptHandler))]
    end = min([statement.end_lineno or statement.lineno, *(start - 1 for start in starts)])
    return range(statement.lineno, max(end, statement.lineno) + 1)
