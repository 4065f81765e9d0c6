"""How the code is laid out: who imports or includes whom, and how long things are."""

import ast
import re
from collections import defaultdict
from pathlib import Path

import pytest

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
FOLDERS = ("base", "sampler", "table", "receiver", "learning", "tree", "choice", "scene")
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
