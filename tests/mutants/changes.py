"""Small changes of a module's source, of which every one should make a test fail."""

from __future__ import annotations

import ast
import copy
import random
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

# Every operator with those that replace it; others would mostly fail to run.
_BINARY = {
    ast.Add: (ast.Sub, ast.Mult),
    ast.Sub: (ast.Add, ast.Mult),
    ast.Mult: (ast.Div, ast.Add),
    ast.Div: (ast.Mult, ast.Sub),
    ast.Pow: (ast.Mult, ast.Div),
    ast.FloorDiv: (ast.Div, ast.Mult),
    ast.Mod: (ast.FloorDiv, ast.Mult),
    ast.MatMult: (ast.Mult,),
    ast.BitAnd: (ast.BitOr, ast.BitXor),
    ast.BitOr: (ast.BitAnd, ast.BitXor),
    ast.BitXor: (ast.BitAnd, ast.BitOr),
}
_COMPARISONS = {
    ast.Lt: (ast.LtE, ast.GtE, ast.NotEq),
    ast.LtE: (ast.Lt, ast.Gt, ast.Eq),
    ast.Gt: (ast.GtE, ast.LtE, ast.NotEq),
    ast.GtE: (ast.Gt, ast.Lt, ast.Eq),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}


@dataclass(frozen=True)
class Change:
    """One change: the number of its node in the order of the tree, and which of its variants."""

    node: int
    variant: int
    line: int
    where: str
    before: str
    after: str


def _replaced_operators(node: ast.Compare) -> list[ast.AST]:
    """Return a comparison with one of its operators replaced."""
    return [
        _with(node, ops=[*node.ops[:k], other(), *node.ops[k + 1 :]])
        for k, op in enumerate(node.ops)
        for other in _COMPARISONS[type(op)]
    ]


def _other_constants(node: ast.Constant) -> list[ast.AST]:
    """Return the other truth value, or the number more and less by 1."""
    if isinstance(node.value, bool):
        return [ast.Constant(not node.value)]
    if isinstance(node.value, int | float):
        return [ast.Constant(node.value + 1), ast.Constant(node.value - 1)]
    return []


def _negated(node: ast.If | ast.While | ast.IfExp) -> list[ast.AST]:
    """Return a branch or a loop with the opposite condition."""
    return [_with(node, test=ast.UnaryOp(ast.Not(), node.test))]


_VARIANTS = {
    ast.BinOp: lambda node: [_with(node, op=op()) for op in _BINARY.get(type(node.op), ())],
    ast.AugAssign: lambda node: [_with(node, op=op()) for op in _BINARY[type(node.op)][:1]],
    ast.Compare: _replaced_operators,
    ast.BoolOp: lambda node: [
        _with(node, op=ast.Or() if isinstance(node.op, ast.And) else ast.And())
    ],
    ast.UnaryOp: lambda node: [node.operand],
    ast.If: _negated,
    ast.While: _negated,
    ast.IfExp: _negated,
    ast.For: lambda node: [_with(node, iter=ast.List([], ast.Load()))],
    ast.Break: lambda node: [ast.Continue()],
    ast.Continue: lambda node: [ast.Break()],
    ast.Constant: _other_constants,
}


def _variants(node: ast.AST) -> list[ast.AST]:
    """Return what may stand in place of a node."""
    return _VARIANTS[type(node)](node) if type(node) in _VARIANTS else []


def _with(node: ast.AST, **fields: object) -> ast.AST:
    """Return a copy of a node with other fields."""
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed


def _places(tree: ast.Module) -> Iterator[tuple[ast.AST, str, int | None, str]]:
    """Yield every place that holds code: parent, field, index in it, and the function around.

    Annotations, decorators, the texts of errors and what only guards the program against its own
    mistakes or states the caller's line (strict=, stacklevel=) are left out.
    """
    waiting: list[tuple[ast.AST, str]] = [(tree, "module")]
    while waiting:
        parent, where = waiting.pop()
        for field, value in ast.iter_fields(parent):
            if field in ("annotation", "returns", "decorator_list", "type_comment"):
                continue
            several = isinstance(value, list)
            for index, child in enumerate(value if several else [value]):
                if not isinstance(child, ast.AST) or isinstance(child, ast.JoinedStr | ast.Raise):
                    continue
                if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                    continue
                if isinstance(child, ast.keyword) and child.arg in ("strict", "stacklevel"):
                    continue
                yield parent, field, index if several else None, where
                named = isinstance(child, ast.FunctionDef | ast.ClassDef)
                waiting.append((child, child.name if named else where))


def _at(parent: ast.AST, field: str, index: int | None) -> ast.AST:
    """Return what is at a place."""
    value = getattr(parent, field)
    return value if index is None else value[index]


def changes_of(source: str) -> list[Change]:
    """Return all changes of a source."""
    found = []
    for number, (parent, field, index, where) in enumerate(_places(ast.parse(source))):
        node = _at(parent, field, index)
        for variant, other in enumerate(_variants(node)):
            texts = (_words(node), _words(other))
            found.append(Change(number, variant, node.lineno, where, *texts))
    return found


def _words(node: ast.AST) -> str:
    """Return the first line of a node's source."""
    return ast.unparse(node).splitlines()[0][:120]


def changed(source: str, change: Change) -> ast.Module:
    """Return the tree of a source with one change."""
    tree = ast.parse(source)
    for number, (parent, field, index, _) in enumerate(_places(tree)):
        if number == change.node:
            other = _variants(_at(parent, field, index))[change.variant]
            if index is None:
                setattr(parent, field, other)
            else:
                getattr(parent, field)[index] = other
            return ast.fix_missing_locations(tree)
    raise LookupError(f"the source has no node {change.node}")


def sample(source: str, count: int, *, seed: int) -> list[Change]:
    """Return a random choice of the changes of a source, in the order of its lines."""
    everything = changes_of(source)
    chosen = random.Random(seed).sample(everything, min(count, len(everything)))
    return sorted(chosen, key=lambda change: (change.line, change.node, change.variant))
