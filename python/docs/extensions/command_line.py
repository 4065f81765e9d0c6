"""The directive `commands`: the command line, as its parser knows it."""

from __future__ import annotations

import argparse
import re

from docutils import nodes
from manylights.cli.main import parser
from sphinx.util.docutils import SphinxDirective


class Commands(SphinxDirective):
    """A section for each command, with its usage, description and options."""

    def run(self):
        """Return the sections."""
        made = parser()
        (commands,) = (
            action for action in made._actions if isinstance(action, argparse._SubParsersAction)
        )
        helps = {action.dest: action.help for action in commands._choices_actions}
        sections = [self._section("manylights", made, None)]
        sections += [
            self._section(name, command, helps.get(name))
            for name, command in commands.choices.items()
        ]
        return sections

    def _section(self, name, command, summary):
        section = nodes.section(ids=[nodes.make_id(f"command-{name}")])
        self.state.document.note_explicit_target(section)
        section += nodes.title("", "", nodes.Text(name))
        if summary and not command.description:
            section += _paragraph(_sentence(summary))
        section += nodes.literal_block("", _usage(command), language="text")
        for paragraph in (command.description or "").strip().split("\n\n"):
            section += _block(paragraph)
        for group in command._action_groups:
            actions = [a for a in group._group_actions if a.help != argparse.SUPPRESS]
            actions = [a for a in actions if not isinstance(a, argparse._SubParsersAction)]
            if actions:
                title = {"options": "Options", "positional arguments": "Arguments"}
                section += nodes.rubric("", title.get(group.title, group.title))
                section += _options(actions, command)
        if command.epilog:
            section += nodes.literal_block("", command.epilog.strip(), language="text")
        return section


def _sentence(text: str) -> str:
    text = text[0].upper() + text[1:]
    return text if text.endswith((".", ")")) else f"{text}."


def _usage(command) -> str:
    return command.format_usage().strip()


def _block(text: str):
    """A paragraph, or text whose lines were laid out by hand."""
    if any(line.startswith(" ") for line in text.splitlines()):
        return nodes.literal_block("", text, language="text")
    return _paragraph(" ".join(text.split()))


def _paragraph(text: str):
    """A paragraph in which options and `quoted` words are code."""
    paragraph = nodes.paragraph()
    for index, piece in enumerate(re.split(r"(`[^`]+`|(?<![\w-])--?[a-z][\w-]*)", text)):
        paragraph += nodes.literal("", piece.strip("`")) if index % 2 else nodes.Text(piece)
    return paragraph


def _options(actions, command):
    formatter = command._get_formatter()
    items = nodes.definition_list(classes=["command-options"])
    for action in actions:
        item, term = nodes.definition_list_item(), nodes.term()
        words = formatter._format_action_invocation(action)
        term += nodes.literal("", words)
        definition = nodes.definition()
        text = formatter._expand_help(action) if action.help else ""
        definition += _paragraph(text)
        item += [term, definition]
        items += item
    return items


def setup(app):
    """Add the directive."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}
