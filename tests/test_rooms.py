"""How the code is laid out: who imports or includes whom, and how long things are."""

import ast
import builtins
import re
from collections import defaultdict
from pathlib import Path

import pytest

from tests.cpp_blocks import blocks

PACKAGE = Path(__file__).parents[1] / "python" / "manylights"

#: Each room imports at its top only those before it, and itself.
ROOMS = (
    *("_plugins", "errors", "files", "threads", "progress", "output", "scenes", "loading", "usd"),
    *("power", "lights", "rendering", "bench", "report", "cli", "__main__"),
)

TREES = {
    path.relative_to(PACKAGE).with_suffix("").parts: ast.parse(path.read_text())
    for path in sorted(PACKAGE.rglob("*.py"))
}


def imported_rooms(tree):
    """Return the rooms that a module imports when it is imported itself."""
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "manylights":
            parts = node.module.split(".")[1:]
            yield from parts[:1] or [alias.name for alias in node.names]


def imports_that_climb():
    """Return every pair of a room and a later one that it imports."""
    return {
        (parts[0], room)
        for parts, tree in TREES.items()
        if parts != ("__init__",)
        for room in imported_rooms(tree)
        if ROOMS.index(room) > ROOMS.index(parts[0])
    }


def test_every_room_has_its_place():
    assert {parts[0] for parts in TREES} - {"__init__"} == set(ROOMS)


def test_rooms_import_only_those_before_them():
    assert imports_that_climb() == set()


def test_an_import_of_a_later_room_is_found(monkeypatch):
    wrong = ast.parse("from manylights.bench import metrics\nfrom manylights import cli")
    monkeypatch.setitem(TREES, ("rendering", "wrong"), wrong)
    assert imports_that_climb() == {("rendering", "bench"), ("rendering", "cli")}


@pytest.mark.parametrize(
    ("kind", "longest"), [(ast.ClassDef, 300), ((ast.FunctionDef, ast.AsyncFunctionDef), 60)]
)
def test_classes_and_functions_are_short(kind, longest):
    lengths = {
        (*parts, node.name): node.end_lineno - node.lineno + 1
        for parts, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, kind)
    }
    assert {name: length for name, length in lengths.items() if length > longest} == {}


def unions_at_run_time(tree):
    """Return the lines with `X | Y` of types, outside of annotations, which nobody evaluates."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.BinOp)
        for part in ast.walk(node.value)
        if isinstance(part, ast.BinOp)
        and isinstance(part.op, ast.BitOr)
        and any(is_type(side) for side in (part.left, part.right))
    ]


def is_type(node):
    """Is this the name of a built-in type, None, or a generic type as `Sequence[float]`?"""
    if isinstance(node, ast.Constant):
        return node.value is None
    if isinstance(node, ast.Subscript):
        return isinstance(node.value, ast.Name) and node.value.id[:1].isupper()
    return isinstance(node, ast.Name) and isinstance(getattr(builtins, node.id, None), type)


def test_no_module_needs_a_later_python():
    """From 3.10 on types have the operator |; in 3.9 the import fails."""
    assert {
        parts: found for parts, tree in TREES.items() if (found := unions_at_run_time(tree))
    } == {}


def test_unions_at_run_time_are_found():
    text = (
        "x: int | None = 1\nW = float | Sequence[float]\ny = a | b\nV = str | None\nz = {} | c[0]"
    )
    assert unions_at_run_time(ast.parse(text)) == [2, 4]


def test_no_two_classes_have_one_name():
    homes = defaultdict(list)
    for parts, tree in TREES.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                homes[node.name].append(".".join(parts))
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


# ------------------------------------------------------------------------------------- the plugins

PLUGINS = PACKAGE.parents[1] / "plugins" / "manylights"

#: Folders of the C++, in the order of the data: each includes only those before it, and itself.
FOLDERS = (
    "base",
    "sampler",
    "emission",
    "kinds",
    "table",
    "receiver",
    "learning",
    "tree",
    "choice",
    "scene",
)
FOLDERS += ("direct", "paths", "render", "plugin")

INCLUDE = re.compile(r'#include ["<]manylights/(\w+)/')


def includes_that_climb(sources):
    """Return every pair of a folder and a later one of which it includes a file."""
    return {
        (folder, included)
        for folder, text in sources
        for included in INCLUDE.findall(text)
        if FOLDERS.index(included) > FOLDERS.index(folder)
    }


def sources_of_plugins():
    """Return folder and text of each file."""
    files = [path for path in sorted(PLUGINS.rglob("*")) if path.suffix in (".h", ".cpp")]
    return [(path.parent.name, path.read_text()) for path in files]


def test_every_folder_of_the_plugins_has_its_place():
    assert {path.name for path in PLUGINS.iterdir()} == set(FOLDERS)


def test_folders_include_only_those_before_them():
    assert includes_that_climb(sources_of_plugins()) == set()


def test_an_include_of_a_later_folder_is_found():
    wrong = '#include "manylights/direct/vertex.h"\n#include "manylights/base/loop.h"'
    assert includes_that_climb([("tree", wrong)]) == {("tree", "direct")}


#: The most lines that each may have.
LONGEST = {"class": 300, "function": 60}


def too_long(text):
    """Return classes and functions of a C++ file that are too long."""
    return [block for block in blocks(text) if block.length > LONGEST[block.kind]]


def cpp_files():
    """Return all files of the plugins."""
    return sorted(path for path in PLUGINS.parent.rglob("*") if path.suffix in (".h", ".cpp"))


@pytest.mark.parametrize("path", cpp_files(), ids=lambda path: path.name)
def test_cpp_classes_and_functions_are_short(path):
    assert too_long(path.read_text()) == []


def test_cpp_classes_and_functions_are_found():
    """In hard places: initializers, lambdas, braces that are no code, classes with a base."""
    text = """
#define OPEN {
template <typename T> struct alignas(16) A : B<T> {
    A(int x) : m_x{ x }, m_y(x) {
        auto f = [&](auto y) { return y; };
        if (x) { f('{'); } else { f("{"); } // {
        g([](int) -> int { return 1; });
    }
    int h() const noexcept { return m_x; }
    int m_x{ 1 }, m_y = { 2 };
};
enum class E { F };
namespace n { void last(const C<D> &c = {}) { for (;;) { } } }
"""
    found = {(each.kind, each.name): each.length for each in blocks(text)}
    assert found == {
        **{("class", "A"): 9, ("function", "A"): 5, ("function", "lambda"): 1},
        **{("function", "g"): 1, ("function", "h"): 1, ("function", "last"): 1},
    }


@pytest.mark.parametrize("head", ["void f()", "F::F() : m_x{ 1 }", "auto f = [](int)"])
def test_a_long_function_is_found(head):
    assert too_long(f"{head} {{\n" + "    ;\n" * 58 + "}\n") == []
    assert len(too_long(f"{head} {{\n" + "    ;\n" * 59 + "}\n")) == 1
