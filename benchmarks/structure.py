"""How the source is built: modules, imports, signatures and helpers, counted from its text.

Usage: python benchmarks/structure.py [SOURCE] [--list] [--only SUBPACKAGE]

SOURCE is a folder of the package (src/perrin where it is left out; that of another revision serves
for a comparison). Printed are:

* modules, and the levels of their imports: the modules of the first level import none of the
  package, those of the second only modules of the first, and so on;
* the widest signatures;
* functions, how many of them are private, and how many private ones are called at one place. A
  function is public where the `__all__` of its subpackage holds its name, or its class's name (in a
  package without subpackages: where its name has no underscore); a method of a public class is
  public where its name has no underscore;
* for every public function the private functions of its own module that it needs, directly or
  through each other: their mean and their largest number;
* private names of a module that another module uses for something else.

With --list every item is printed, not only its number.
"""

from __future__ import annotations

import argparse
import ast
import re
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

WIDE = 13
MANY = 12


@dataclass(frozen=True)
class Function:
    """One function or method of the source."""

    module: str
    name: str  # "Class.method" for a method
    public: bool
    node: ast.FunctionDef


def parse(source: Path) -> dict[str, ast.Module]:
    """Return the syntax tree of every module, by its name below the package."""
    paths = sorted(source.rglob("*.py"))
    names = {path: ".".join(path.relative_to(source).with_suffix("").parts) for path in paths}
    return {names[path]: ast.parse(path.read_text()) for path in paths}


def exported(trees: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Return what the `__all__` of every folder holds, by the name of the folder."""
    faces = {}
    for module, tree in trees.items():
        for node in tree.body:
            if (
                isinstance(node, ast.Assign)
                and isinstance(node.targets[0], ast.Name)
                and node.targets[0].id == "__all__"
                and isinstance(node.value, ast.List)
            ):
                faces[module.removesuffix("__init__").removesuffix(".")] = set(
                    ast.literal_eval(node.value)
                )
    return faces


def imported(tree: ast.Module, modules: set[str]) -> set[str]:
    """Return the modules of the package that a module imports anywhere in it."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("perrin"):
            name = node.module.removeprefix("perrin").lstrip(".")
            found |= {name, *(f"{name}.{alias.name}".lstrip(".") for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name.removeprefix("perrin.") for alias in node.names}
    return found & modules


def levels(trees: dict[str, ast.Module]) -> int:
    """Return the length of the longest chain of imports."""
    modules = {name for name in trees if not name.endswith("__init__")}
    above = {name: imported(trees[name], modules) - {name} for name in modules}
    depth: dict[str, int] = {}

    def level(name: str) -> int:
        if name not in depth:
            depth[name] = 1 + max((level(other) for other in above[name]), default=0)
        return depth[name]

    return max(level(name) for name in modules)


def functions(trees: dict[str, ast.Module]) -> list[Function]:
    """Return all functions and methods, without those defined inside functions."""
    faces = exported(trees)
    found = []
    for module, tree in trees.items():
        if module.endswith("__init__"):
            continue
        face = faces.get(module.split(".")[0]) if "." in module else None
        for node in tree.body:
            open_name = not getattr(node, "name", "_").startswith("_")
            public = open_name and (face is None or node.name in face)
            if isinstance(node, ast.FunctionDef):
                found.append(Function(module, node.name, public, node))
            elif isinstance(node, ast.ClassDef):
                for inner in node.body:
                    if isinstance(inner, ast.FunctionDef) and not is_special(inner.name):
                        shown = public and not inner.name.startswith("_")
                        found.append(Function(module, f"{node.name}.{inner.name}", shown, inner))
    return found


def is_special(name: str) -> bool:
    """Return whether Python itself calls a method: __init__ and its kin."""
    return name.startswith("__") and name.endswith("__")


def names_used(node: ast.AST) -> Counter[str]:
    """Count the names and attributes that a piece of code uses."""
    used: Counter[str] = Counter()
    for inner in ast.walk(node):
        if isinstance(inner, ast.Name):
            used[inner.id] += 1
        elif isinstance(inner, ast.Attribute):
            used[inner.attr] += 1
    return used


def helpers_behind(function: Function, private: dict[str, Function]) -> set[str]:
    """Return the private functions of its module that a function needs, by any way."""
    found: set[str] = set()
    waiting = [function.node]
    while waiting:
        used = set(names_used(waiting.pop())) & set(private) - found
        found |= used
        waiting += [private[name].node for name in used]
    return found - {function.name}


def double_meanings(trees: dict[str, ast.Module]) -> dict[str, list[str]]:
    """Return the private names that several modules define, each with a text of its own."""
    texts: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for module, tree in trees.items():
        for node in tree.body:
            targets = []
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                targets = [node.name]
            elif isinstance(node, ast.Assign):
                targets = [
                    name.id
                    for target in node.targets
                    for name in ast.walk(target)
                    if isinstance(name, ast.Name)
                ]
            for name in targets:
                if re.match(r"_[A-Za-z]", name):
                    texts[name][module].add(ast.unparse(node))
    return {
        name: sorted(places)
        for name, places in texts.items()
        if len({text for found in places.values() for text in found}) > 1 and len(places) > 1
    }


def arguments(node: ast.FunctionDef) -> int:
    """Return how many arguments a function takes, self aside."""
    given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return len([a for a in given if a.arg not in ("self", "cls")])


def main() -> None:
    """Print the figures of one source tree."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("source", type=Path, nargs="?", default=Path("src/perrin"))
    parser.add_argument("--list", action="store_true", help="print every item")
    parser.add_argument("--only", default="", help="a subpackage whose items are listed")
    options = parser.parse_args()
    trees = parse(options.source)
    every = functions(trees)
    modules = [name for name in trees if not name.endswith("__init__")]
    used = sum((names_used(tree) for tree in trees.values()), Counter())
    kept = [f for f in every if f.module.startswith(options.only)]
    private = [f for f in kept if not f.public]
    once = [f for f in private if used[f.name.split(".")[-1]] == 1]
    by_module: dict[str, dict[str, Function]] = defaultdict(dict)
    for f in every:
        if not f.public:
            by_module[f.module][f.name.split(".")[-1]] = f
    behind = {f: helpers_behind(f, by_module[f.module]) for f in kept if f.public}
    wide = sorted(kept, key=lambda f: -arguments(f.node))[:8]
    double = double_meanings(trees)

    print(f"modules: {len(modules)}")
    print(f"levels of imports: {levels(trees)}")
    print("widest signatures: " + ", ".join(f"{f.name} {arguments(f.node)}" for f in wide))
    print(f"functions: {len(kept)}, private {len(private)} ({len(private) / len(kept):.0%})")
    print(f"private functions used at one place: {len(once)}")
    counts = [len(names) for names in behind.values()]
    print(f"helpers behind a public function: mean {sum(counts) / len(counts):.1f}, ", end="")
    print(f"largest {max(counts)}, over {MANY}: {sum(n > MANY for n in counts)}")
    print(f"private names with two meanings: {len(double)}")
    if options.list:
        print("\nused at one place:")
        for f in once:
            print(f"  {f.module}:{f.node.lineno} {f.name}")
        print("\nmany helpers:")
        for f, names in sorted(behind.items(), key=lambda item: -len(item[1])):
            if len(names) > MANY:
                print(f"  {f.module} {f.name}: {len(names)}")
        print("\ntwo meanings:")
        for name, places in sorted(double.items()):
            if any(place.startswith(options.only) for place in places):
                print(f"  {name}: {', '.join(places)}")


if __name__ == "__main__":
    main()
