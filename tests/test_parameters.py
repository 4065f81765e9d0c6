"""What users are told of the parameters, against the table that the plugins read them with."""

import math
import re
from pathlib import Path

import pytest
from manylights.loading import ours

PLUGINS = ("manylights_direct", "manylights_volpath")
SOURCES = Path(__file__).parents[1] / "plugins"
BULLET = re.compile(r"^ \* - (\S.*?)\n   - (.*?)\n   - (.*?)(?=^ \* - |^\S)", re.M | re.S)


@pytest.fixture(scope="session")
def tables():
    """The parameters of each plugin by name, as its C++ has them."""
    core = pytest.importorskip("manylights._core")
    return {plugin: {each["name"]: each for each in core.parameters(plugin)} for plugin in PLUGINS}


def documented(text):
    """Type and text of the parameters in a documentation block.

    Without what only `mi.traverse` has: that has no default.
    """
    block = text[text.index(".. pluginparameters::") :]
    return {
        name: (kind, " ".join(about.split()))
        for name, kind, about in BULLET.findall(block)
        if "Default:" in about
    }


def default_in_words(about):
    """The end of what the documentation says of a parameter."""
    value = about["default"]
    if not value:
        return "(Default: none)"
    if about["type"] == "bool":
        value = {"true": "yes, i.e. |true|", "false": "no, i.e. |false|"}[value]
    return f"(Default: :code:`{value}`)" if about["type"] == "string" else f"(Default: {value})"


def bounds_in_words(about):
    """What the documentation says of the range of a number; nothing if it has no end."""
    if about["type"] != "int" or math.isinf(about["high"]):
        return ""
    end = f":code:`{about['high_name']}`" if about["high_name"] else f"{about['high']:g}"
    return f"{about['low']:g} to {end}"


def either(words):
    """Words as alternatives: "a, b or c"."""
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def range_in_words(about):
    """What the help of the commands says that a parameter may be."""
    if about["type"] == "bool":
        return either(["true", "false", *about["texts"]])
    if about["type"] == "string":
        return either(about["texts"]) if about["texts"] else "text"
    if about["type"] == "list":
        return f"NAME:TYPE between commas with the TYPE {either(about['texts'])}"
    if about["type"] == "float":
        return either([f"float >= {about['low']:g}", *about["texts"]])
    if about["high_name"]:
        return f"integer from {about['low']:g} to the number of {about['high_name']}"
    if about["low"] < 0:
        return "integer, -1 for no limit"
    if math.isinf(about["high"]):
        return f"integer >= {about['low']:g}"
    return f"integer from {about['low']:g} to {about['high']:g}"


def mistakes_in_documentation(text, table):
    """Compare a documentation block with the table; return what does not fit."""
    found = documented(text)
    wrong = [f"only on one side: {name}" for name in found.keys() ^ table.keys()]
    for name in found.keys() & table.keys():
        kind, about, wanted = *found[name], table[name]
        types = [wanted["type"].replace("list", "string")]
        types += ["string"] * (wanted["type"] == "bool" and bool(wanted["texts"]))
        if kind != " or ".join(f"|{each}|" for each in types):
            wrong.append(f"{name}: type {kind}")
        if not about.endswith(default_in_words(wanted)):
            wrong.append(f"{name}: {about[-50:]}")
        if bounds_in_words(wanted) not in about:
            wrong.append(f"{name}: range")
        wrong += [f"{name}: no {each}" for each in wanted["texts"] if each not in about]
        (method,) = wanted["methods"] if len(wanted["methods"]) == 1 else [None]
        if method and f"Method :code:`{method}` only" not in about:
            wrong.append(f"{name}: no word of its method")
    return wrong


@pytest.mark.parametrize("plugin", PLUGINS)
def test_documentation_says_what_the_plugin_reads(plugin, tables):
    text = (SOURCES / f"{plugin}.cpp").read_text()
    assert mistakes_in_documentation(text, tables[plugin]) == []


def test_a_wrong_word_in_the_documentation_is_found(tables):
    text = (SOURCES / "manylights_direct.cpp").read_text()
    table = tables["manylights_direct"]
    for old, new in (
        ("(Default: 16)", "(Default: 9)"),
        ("1 to 64", "1 to 32"),
        (":code:`far`", ":code:`away`"),
        (" * - counts\n   - |bool|", " * - counts\n   - |int|"),
        (" * - counts\n", " * - count\n"),
        ("Method :code:`talk` only", "For :code:`talk`"),
    ):
        assert old in text
        assert mistakes_in_documentation(text.replace(old, new), table) != [], new


@pytest.mark.parametrize("plugin", PLUGINS)
def test_help_of_the_commands_says_what_the_plugin_reads(plugin, tables):
    table, told = tables[plugin], ours.PARAMETERS[plugin]
    assert told.keys() == table.keys()
    for name, about in table.items():
        assert told[name].allowed == range_in_words(about), name
        assert ours.value_text(told[name].default) == about["default"], name
        if len(about["methods"]) == 1:
            assert told[name].remark == f"for method={about['methods'][0]} only", name


def test_methods_are_those_of_the_plugins(tables):
    for table in tables.values():
        assert tuple(table["method"]["texts"]) == ours.METHODS
