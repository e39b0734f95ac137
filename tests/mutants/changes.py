"""Wrong changes of a source file, each of one expression or one statement, as a tired programmer makes them."""

import ast
import copy
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

type Node = ast.AST

_COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
# Exchanging their first two arguments changes nothing.
_SYMMETRIC = {
    *(
        "max",
        "min",
        "maximum",
        "minimum",
        "hypot",
        "add",
        "multiply",
        "array_equal",
        "vdot",
        "dist",
        "gcd",
        "broadcast_shapes",
    ),
}
_NO_CODE = (ast.Import, ast.ImportFrom, ast.TypeAlias, ast.Assert, ast.Global, ast.JoinedStr)
# Types, and what only persons or type checkers read.
_UNSEEN_FIELDS = {"annotation", "returns", "decorator_list", "type_params", "bases"}
_UNSEEN_CALLS = {"cast", "TypeVar", "NewType"}
_UNSEEN_NAMES = {"__all__", "__slots__", "__repr__", "__str__"}
_BLOCKS = ("body", "orelse", "finalbody", "handlers", "cases", "decorator_list")
_SMALL_INTEGER = 10
# A literal string; a long one in a name would only make the name long.
_TEXT = re.compile(r"""f?(["'])(?:\\.|(?!\1).)*\1""")
_LONG_TEXT = 22


@dataclass(frozen=True)
class Mutant:
    """One wrong change.

    Attributes
    ----------
    name : str
        File, function, statement before and after: the same as long as that statement stays as it is.
    file : str
        Path from the top of the repository.
    place : int
        Its number among the changes of the file.
    function : tuple of str
        Names of the classes and functions that hold it, the outermost first.
    lines : range
        Lines of the changed statement without the block that it heads; empty outside functions.
    """

    name: str
    file: str
    place: int
    function: tuple[str, ...]
    lines: range


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
    found, seen = [], Counter[str]()
    for number, (place, _, after) in enumerate(_changes(ast.parse(source))):
        name = f"{file} {'.'.join(place.function) or '(module)'}: {_header(place.statement)} ⇒ {after}"
        seen[name] += 1
        name += f" ({seen[name]})" if seen[name] > 1 else ""
        lines = _lines(place.statement) if place.inside else range(0)
        found.append(Mutant(name, file, number, place.function, lines))
    return found


def mutated(source: str, number: int) -> str:
    """Return the source with one of its changes."""
    tree = ast.parse(source)
    place, new, _ = next(islice(_changes(tree), number, None))
    with place.replaced(new):
        return ast.unparse(tree)


def _changes(tree: ast.Module) -> Iterator[tuple[_Place, Node, str]]:
    """Yield each place with what may stand there, and its statement with that; none twice."""
    seen = set()
    for place in _places(tree, tree, (), False, ""):
        for new in _replacements(place):
            with place.replaced(new):
                text = _header(new if place.node is place.statement else place.statement)
            if (id(place.statement), text) not in seen:
                seen.add((id(place.statement), text))
                yield place, new, text


def _places(parent: Node, statement: Node, function: tuple[str, ...], inside: bool, returns: str) -> Iterator[_Place]:
    """Yield the nodes below `parent` that are code."""
    for field, value in ast.iter_fields(parent):
        if field in _UNSEEN_FIELDS or (isinstance(parent, ast.ClassDef) and field == "keywords"):
            continue
        for at, node in enumerate(value) if isinstance(value, list) else [(None, value)]:
            if not isinstance(node, ast.AST) or _unseen(node, parent):
                continue
            whole = isinstance(node, (ast.stmt, ast.ExceptHandler, ast.match_case))
            holder = node if whole else statement
            # The defaults of a function belong to where it is defined
            within = inside or (isinstance(parent, ast.FunctionDef) and field == "body")
            yield _Place(node, parent, field, at, function, holder, within, returns)
            name = (node.name,) if isinstance(node, (ast.FunctionDef, ast.ClassDef)) else ()
            result = ast.unparse(node.returns) if isinstance(node, ast.FunctionDef) and node.returns else returns
            yield from _places(node, holder, (*function, *name), within, result)


def _unseen(node: Node, parent: Node) -> bool:
    """Return whether a node is no code: documentation, types, messages."""
    match node:
        case ast.Expr(value=ast.Constant()) | ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return True
        case ast.Call(func=ast.Name(id=name)) if name in _UNSEEN_CALLS:
            return True
        case ast.keyword(arg="strict"):  # lengths that differ are bugs, which no test can bring about
            return True
        case ast.FunctionDef(name=name) | ast.Assign(targets=[ast.Name(id=name)]) if name in _UNSEEN_NAMES:
            return True
    return isinstance(node, _NO_CODE) or isinstance(parent, ast.Raise)


def _replacements(place: _Place) -> Iterator[Node]:
    """Yield what may stand in place of a node."""
    match place.node:
        case ast.Compare(left, operators, others):
            for k, operator in enumerate(operators):
                for other in _COMPARISONS[type(operator)]:
                    yield ast.Compare(left, [*operators[:k], other(), *operators[k + 1 :]], others)
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
            yield ast.BinOp(left, _ARITHMETIC[type(operator)](), right)
        case ast.Constant(value):
            yield from (ast.Constant(other) for other in _other_values(value))
        case ast.Call(function, [first, second, *rest], keywords) if _order_matters(function, first, second):
            yield ast.Call(function, [second, first, *rest], keywords)
        case ast.IfExp(test, body, orelse):
            yield ast.IfExp(_negated(test), body, orelse)
        case ast.comprehension(target, source, [_, *_], is_async):
            yield ast.comprehension(target, source, [], is_async)
        case ast.stmt() | ast.ExceptHandler():
            yield from _other_statements(place)


def _other_statements(place: _Place) -> Iterator[Node]:
    """Yield what may stand in place of a statement."""
    in_branch = not isinstance(place.parent, (ast.Module, ast.ClassDef, ast.FunctionDef))
    match place.node:
        case ast.If(test, body, orelse):
            yield ast.If(_negated(test), body, orelse)
            if not orelse:
                yield ast.If(ast.Constant(False), body, orelse)
        case ast.Return(value) if value is not None and not (isinstance(value, ast.Constant) and value.value is None):
            yield ast.Return(_wrong_result(value, place.returns))
        case ast.Raise(ast.Call(ast.Name(), arguments, keywords), cause):
            yield ast.Pass()
            yield ast.Raise(ast.Call(ast.Name("Exception"), arguments, keywords), cause)
        case ast.Raise() | ast.Expr(ast.Call()) | ast.Delete():
            yield ast.Pass()
        case ast.Assign(targets) if in_branch or not isinstance(targets[0], (ast.Name, ast.Tuple)):
            yield ast.Pass()
        case ast.AugAssign(target, operator, value):
            yield ast.Pass()
            if type(operator) in _ARITHMETIC:
                yield ast.AugAssign(target, _ARITHMETIC[type(operator)](), value)
        case ast.Break():
            yield ast.Continue()
        case ast.Continue():
            yield ast.Break()
        case ast.ExceptHandler(ast.Tuple(classes), name, body):
            for k in range(len(classes)):
                yield ast.ExceptHandler(ast.Tuple([*classes[:k], *classes[k + 1 :]]), name, body)
        case ast.ExceptHandler(ast.expr(), name, body):
            yield ast.ExceptHandler(ast.Name("ZeroDivisionError"), name, body)


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
        case ast.Compare(left, [operator], others):
            return ast.Compare(left, [_COMPARISONS[type(operator)][-1]()], others)
        case ast.Constant(bool() as value):
            return ast.Constant(not value)
    return ast.UnaryOp(ast.Not(), test)


def _other_values(value: object) -> tuple[float, ...]:
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
    name = (
        function.attr if isinstance(function, ast.Attribute) else function.id if isinstance(function, ast.Name) else ""
    )
    starred = isinstance(first, ast.Starred) or isinstance(second, ast.Starred)
    return name not in _SYMMETRIC and not starred and ast.dump(first) != ast.dump(second)


def _header(statement: Node) -> str:
    """Return a statement without the block that it heads."""
    bare = copy.copy(statement)
    for block in _BLOCKS:
        if hasattr(bare, block):
            setattr(bare, block, [])
    text = " ".join(ast.unparse(bare).split())
    return _TEXT.sub(lambda found: found[0] if len(found[0]) < _LONG_TEXT else f"{found[1]}…{found[1]}", text)


def _lines(statement: Node) -> range:
    """Return the lines of a statement without the block that it heads."""
    first = statement.pattern if isinstance(statement, ast.match_case) else statement
    assert isinstance(first, (ast.stmt, ast.ExceptHandler, ast.pattern))
    end = first.end_lineno or first.lineno
    for block in _BLOCKS:
        held = getattr(statement, block, None)
        if held and block != "decorator_list":
            start = held[0].pattern if isinstance(held[0], ast.match_case) else held[0]
            end = min(end, start.lineno - 1)
    return range(first.lineno, max(end, first.lineno) + 1)
