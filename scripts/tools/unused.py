"""Names of the package that nothing references, and parameters and fields with one value.

    python scripts unused

A name of the package counts as referenced if it occurs anywhere in the package outside its own
definition, also in a string. Parameters are compared over all calls of functions with the same
name, so that a parameter of a name that is defined twice may be missed.
"""

from __future__ import annotations

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

from script_arguments import make_parser

import collocation_sysid

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "collocation_sysid"
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
# Functions that a decorator of these names registers, or that a library calls by their names.
REGISTERED = {"command", "callback", "overload", "fixture", "field_validator", "model_validator"}
REGISTERED |= {"field_serializer", "register", "singledispatch", "wraps"}
# Methods that typer, pickle, IPython, SciPy, mcap and CasADi call.
CALLED = {"list_commands", "get_command", "resolve_command", "format_commands", "find_class"}
CALLED |= {"_repr_png_", "_matvec", "decoder_for"}


def words_of(node: ast.AST) -> Counter[str]:
    """Return how often each identifier occurs in a syntax tree, also as a word of a string."""
    words = Counter[str]()
    for each in ast.walk(node):
        match each:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.keyword(arg=str(name)):
                words[name] += 1
            case ast.alias(name=name):
                words.update(name.split("."))
            case ast.Constant(value=str(text)):
                words.update(set(re.findall(r"\w+", text)))
            case ast.MatchClass(kwd_attrs=names):
                words.update(names)
    return words


def decorators(node: Definition) -> set[str]:
    """Return the words of the decorators of a definition."""
    return {word for each in node.decorator_list for word in re.findall(r"\w+", ast.unparse(each))}


def definitions(tree: ast.Module) -> Iterator[tuple[str, ast.AST, str | None]]:
    """Yield the names that a module defines: name, definition, and the class that has it."""
    for node in tree.body:
        if isinstance(node, Definition):
            yield node.name, node, None
        if isinstance(node, ast.ClassDef):
            for member in node.body:
                if isinstance(member, FUNCTIONS):
                    yield member.name, member, node.name
                elif isinstance(member, ast.AnnAssign) and isinstance(member.target, ast.Name):
                    yield member.target.id, member, node.name
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                if isinstance(target, ast.Name):
                    yield target.id, node, None


def documented_words() -> set[str]:
    """Return the words of pages and problem files, which use names of the public interface."""
    files = [*ROOT.glob("docs/**/*.md"), *ROOT.glob("problems/**/*.toml"), ROOT / "README.md"]
    return {word for file in files for word in re.findall(r"\w+", file.read_text())}


def find_unused(trees: dict[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for each name that nothing references."""
    words = sum((words_of(tree) for tree in trees.values()), Counter[str]())
    public = set(collocation_sysid.__all__) | documented_words()
    for file, tree in trees.items():
        is_table = "vars().values()" in ast.unparse(tree) or "vars().items()" in ast.unparse(tree)
        for name, node, owner in definitions(tree):
            if name.startswith("__") or name in public | CALLED:
                continue
            if is_table and isinstance(node, ast.Assign):
                continue
            if (
                isinstance(node, ast.AnnAssign)
                and node.value
                and "_method_key" in ast.unparse(node.value)
            ):
                continue
            if file.name in ("callbacks.py", "casadi_functions.py") and owner:
                continue  # CasADi calls the methods
            if isinstance(node, Definition) and decorators(node) & REGISTERED:
                continue
            own = words_of(node)[name]
            if words[name] <= own:
                line = getattr(node, "lineno", 0)
                place = f"{owner}.{name}" if owner else name
                yield f"{file.relative_to(ROOT)}:{line}: {place} is not referenced"


def calls_by_name(trees: dict[Path, ast.Module]) -> tuple[dict[str, list[ast.Call]], set[str]]:
    """Return the calls of each name, those of `cls` by the name of the class, and the names that
    are also passed without a call, of classes as arguments of functions that may construct them.
    """
    calls = defaultdict[str, list[ast.Call]](list)
    called: set[int] = set()
    passed: set[str] = set()
    classes = {name for tree in trees.values() for name, _, _ in definitions(tree)}
    classes = {name for name in classes if name.lstrip("_")[:1].isupper()}
    for tree in trees.values():
        owners = {
            id(node): owner.name
            for owner in tree.body
            if isinstance(owner, ast.ClassDef)
            for node in ast.walk(owner)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name | ast.Attribute):
                function = node.func
                name = function.id if isinstance(function, ast.Name) else function.attr
                calls[owners.get(id(node), name) if name == "cls" else name].append(node)
                called.add(id(function))
                if name not in ("isinstance", "issubclass", "cast"):
                    arguments = [each for each in node.args if isinstance(each, ast.Name)]
                    passed |= {each.id for each in arguments}
    for tree in trees.values():
        for node in ast.walk(tree):
            if isinstance(node, ast.Name | ast.Attribute) and id(node) not in called:
                name = node.id if isinstance(node, ast.Name) else node.attr
                if isinstance(node.ctx, ast.Load) and name not in classes:
                    passed.add(name)
    return calls, passed


def values_of(calls: list[ast.Call], name: str, position: int | None) -> set[str] | None:
    """Return the texts of the values that calls pass for a parameter, "" where none is passed;
    None if this cannot be read from a call.
    """
    values: set[str] = set()
    for call in calls:
        by_name = {each.arg: each.value for each in call.keywords}
        if None in by_name or any(isinstance(each, ast.Starred) for each in call.args):
            return None
        if name in by_name:
            values.add(ast.unparse(by_name[name]))
        elif position is not None and position < len(call.args):
            values.add(ast.unparse(call.args[position]))
        else:
            values.add("")
    return values


def find_single_values(trees: dict[Path, ast.Module]) -> Iterator[str]:
    """Yield a line for each parameter or field that no call of the package, of scripts and of tests
    sets, or that all set to one literal.
    """
    others = [*ROOT.glob("tests/**/*.py"), *ROOT.glob("scripts/**/*.py")]
    calls, passed = calls_by_name(trees | {file: ast.parse(file.read_text()) for file in others})
    counts = Counter(
        name
        for tree in trees.values()
        for name, node, _ in definitions(tree)
        if isinstance(node, Definition)
    )
    words = documented_words() | set(collocation_sysid.__all__)
    classes = [
        each for tree in trees.values() for each in tree.body if isinstance(each, ast.ClassDef)
    ]
    bases = {ast.unparse(base) for each in classes for base in each.bases}
    texts = {
        node.value
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    replaced = {each.arg for call in calls["replace"] for each in call.keywords}
    for file, tree in trees.items():
        for name, node, owner in definitions(tree):
            if not isinstance(node, Definition) or name in words or name.startswith("__"):
                continue
            if counts[name] > 1 or not calls[name]:
                continue
            if isinstance(node, ast.ClassDef):
                if name.endswith(("Options", "Tolerances")):
                    continue
                given = any(call.args or call.keywords for call in calls[name])
                is_frozen = {"dataclass", "frozen"} <= decorators(node)
                if not is_frozen or not given or name in passed | bases:
                    continue  # a state, or a table of constants, or constructed elsewhere
                parameters = [
                    (each.target.id, position)
                    for position, each in enumerate(
                        member for member in node.body if isinstance(member, ast.AnnAssign)
                    )
                    if isinstance(each.target, ast.Name)
                    and each.target.id not in replaced | texts
                    and "ClassVar" not in ast.unparse(each.annotation)
                    and not (
                        each.value
                        and re.search("init=False|default_factory", ast.unparse(each.value))
                    )
                ]
                if node.bases and any(call.args for call in calls[name]):
                    continue
            elif name in passed or decorators(node) & {*REGISTERED, "property", "cached_property"}:
                continue
            else:
                bound = owner is not None and "staticmethod" not in decorators(node)
                arguments = [*node.args.posonlyargs, *node.args.args]
                parameters = [(a.arg, k - bound) for k, a in enumerate(arguments) if k >= bound]
                parameters += [(each.arg, None) for each in node.args.kwonlyargs]
            for parameter, position in parameters:
                values = values_of(calls[name], parameter, position)
                if values is None or len(values) != 1:
                    continue
                (value,) = values
                try:
                    ast.literal_eval(value or "0")
                except (ValueError, SyntaxError):
                    continue
                which = f"is always {value}" if value else "is never passed"
                place = f"{file.relative_to(ROOT)}:{node.lineno}"
                yield f"{place}: parameter {parameter} of {name} {which}"


def main() -> None:
    make_parser(__doc__).parse_args()
    trees = {file: ast.parse(file.read_text()) for file in sorted(PACKAGE.rglob("*.py"))}
    for line in (*find_unused(trees), *find_single_values(trees)):
        print(line)


if __name__ == "__main__":
    main()
