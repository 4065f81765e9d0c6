"""Finds the classes and functions of C++ files, and how many lines they have, by their braces."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple

#: Comments, strings, characters and lines of the preprocessor: none of their braces counts.
NO_CODE = re.compile(
    r'//[^\n]*|/\*.*?\*/|R"\((.*?)\)"|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])+\''
    r"|^[ \t]*#(?:[^\n]*\\\n)*[^\n]*",
    re.S | re.M,
)
#: Labels, and macros that stand in a line of their own like Mitsuba's NAMESPACE_BEGIN(mitsuba).
LABEL = re.compile(r"\b(?:public|private|protected):|^[A-Z_]+\(\w+\)$", re.M)
TOKEN = re.compile(r"[{};()\n]|[^{};()\n]+")
CLASS = re.compile(r"\b(?:class|struct|union)\s+(?:alignas\(\d+\)\s*)?(\w+)")
CONTROL = re.compile(r"(?:if|else|for|while|switch|do|try|catch)\b")
#: What may stand between the parameters of a function, or a lambda, and its body.
FUNCTION = re.compile(r"\)\s*(?:const|noexcept|override|final|mutable|\s)*(?:->[^(){};]*)?$")
NAME = re.compile(r"([\w~]+|operator\W+)\s*\(")


class Block(NamedTuple):
    """A class or function: what it is, its name, the line where it begins, and its length."""

    kind: str
    name: str
    line: int
    length: int


def _kind_and_name(head: str) -> tuple[str, str]:
    """Tell what the braces after this text are: class, function, control, scope or value."""
    if CONTROL.match(head):
        return "control", ""
    if re.search(r"\b(?:namespace|enum|extern)\b", head):
        return "scope", ""
    outside = re.sub(r"<[^<>]*>", "", head)
    if (found := CLASS.search(outside)) and "(" not in outside.replace("alignas(", ""):
        return "class", found[1]
    if FUNCTION.search(head):
        found = NAME.search(head)
        return "function", found[1] if found else "lambda"
    return "value", ""


def blocks(text: str) -> Iterator[Block]:
    """Yield all classes and functions of a file, lambdas included, each where it ends."""
    text = NO_CODE.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), text)
    text = LABEL.sub("", text)
    outer = []  # of each open brace: kind, name, line of its head, parentheses around it, head
    head, head_line, parentheses, line = "", 1, 0, 1
    for token in TOKEN.findall(text):
        if token == "\n":
            line += 1
            head += " "
        elif token == "{":
            kind, name = _kind_and_name(head.strip())
            outer.append((kind, name, head_line, parentheses, head))
            head, parentheses = "", 0
        elif token == "}":
            kind, name, start, parentheses, before = outer.pop()
            if kind in ("class", "function"):
                yield Block(kind, name, start, line - start + 1)
            # A member's value in a list of initializers: the body is still to come
            head, head_line = (f"{before}()", start) if kind == "value" else ("", line)
        elif token == ";" and parentheses == 0:
            head = ""
        else:
            parentheses += (token == "(") - (token == ")")
            if not head.strip():
                head_line = line
            head += token
