"""The words that Mitsuba's documentation blocks have beyond reStructuredText."""

from __future__ import annotations

from docutils import nodes
from docutils.parsers.rst import Directive
from sphinx.util.docutils import SphinxDirective
from sphinx_inline_tabs._impl import TabContainer

HEADINGS = ("Parameter", "Type", "Description", "Flags")
WIDTHS = (18, 12, 60, 10)


class PluginParameters(Directive):
    """A table from a list of lists: name, type, description and perhaps flags."""

    has_content = True

    def run(self):
        """Return the table."""
        parsed = nodes.Element()
        self.state.nested_parse(self.content, self.content_offset, parsed)
        rows = [[cell.children for cell in row[0]] for row in parsed[0]]
        columns = max(map(len, rows))
        table = nodes.table(classes=["plugin-parameters"])
        group = nodes.tgroup(cols=columns)
        table += group
        group += [nodes.colspec(colwidth=width) for width in WIDTHS[:columns]]
        head, body = nodes.thead(), nodes.tbody()
        group += [head, body]
        head += self._row([[nodes.paragraph("", text)] for text in HEADINGS[:columns]])
        for row in rows:
            # Names are code, and may be broken after a comma
            (name,) = row[0]
            names = name.astext().split(", ")
            spaced = [node for name in names for node in (nodes.literal("", name), nodes.Text(" "))]
            name.children = []
            name += spaced[:-1]
            body += self._row(row + [[]] * (columns - len(row)))
        return [table]

    @staticmethod
    def _row(cells):
        row = nodes.row()
        row += [nodes.entry("", *cell) for cell in cells]
        return row


class Tabs(Directive):
    """Several `code-tab`."""

    has_content = True

    def run(self):
        """Return what is in it."""
        parsed = nodes.container()
        self.state.nested_parse(self.content, self.content_offset, parsed)
        return parsed.children


class CodeTab(SphinxDirective):
    """A tab with code, labelled with its language."""

    has_content = True
    required_arguments = 1
    option_spec = {"name": str}  # noqa: RUF012

    def run(self):
        """Return the tab, which sphinx-inline-tabs puts together with its neighbours."""
        language = self.arguments[0]
        tab = TabContainer("", type="tab", new_set=False)
        title = {"xml": "XML", "python": "Python"}[language]
        tab += nodes.label("", "", nodes.Text(title))
        code = "\n".join(self.content)
        content = nodes.container("", is_div=True, classes=["tab-content"])
        content += nodes.literal_block(code, code, language=language)
        tab += content
        return [tab]


def monospaced(name, rawtext, text, lineno, inliner, options=None, content=None):
    """The role `monosp`."""
    return [nodes.literal(rawtext, text)], []


def setup(app):
    """Add directives and the role."""
    app.add_directive("pluginparameters", PluginParameters)
    app.add_directive("tabs", Tabs)
    app.add_directive("code-tab", CodeTab)
    app.add_role("monosp", monospaced)
    return {"parallel_read_safe": True}
