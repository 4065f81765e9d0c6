"""Pages that are files of the repository: README, the documentation blocks of plugins, others.

A stub `direct.rst` that begins with `source: plugins/manylights_direct.cpp` in a comment takes the
place of nothing: what that file says becomes the page, followed by the rest of the stub. Links
between such files become links between pages.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

ROOT = Path(__file__).parents[3]

#: In a comment of Markdown or reStructuredText, at the beginning of a page
SOURCE = re.compile(r"(?:%|\.\.) source: (\S+)\n")

#: A link or a picture of Markdown: what comes before the target, and the target
LINK = re.compile(r"(!?\[(?:[^\[\]]|!?\[[^\]]*\]\([^)]*\))*\]\()([^)\s]+)\)")

#: The documentation block of a plugin
BLOCK = re.compile(r"/\*\*!\n(.*?)\n \*/", re.S)


def setup(app):
    """Have Sphinx call `replace_stub` for each page it reads."""
    app.connect("builder-inited", find_stubs)
    app.connect("source-read", replace_stub)
    return {"parallel_read_safe": True}


def find_stubs(app) -> None:
    """Note which file of the repository has which page."""
    app.manylights_pages = {}
    for name in app.project.discover():
        stub = SOURCE.match(Path(app.env.doc2path(name)).read_text())
        if stub:
            app.manylights_pages[(ROOT / stub[1]).resolve()] = name


def replace_stub(app, name: str, source: list[str]) -> None:
    """Put the file that a stub names into its place."""
    stub = SOURCE.match(source[0])
    if not stub:
        return
    path = ROOT / stub[1]
    app.env.note_dependency(str(path), docname=name)
    if path.suffix == ".cpp":
        (text,) = BLOCK.findall(path.read_text())
    else:
        text = with_pictures(relinked(app, name, path))
    source[0] = f"{text}\n{source[0][stub.end() :]}"


def relinked(app, name: str, path: Path) -> str:
    """Return a file of Markdown with its links as they are from the page `name`."""
    here = Path(app.env.doc2path(name)).parent

    def target(match) -> str:
        opening, link = match.groups()
        file, hash_sign, anchor = link.partition("#")
        if ":" in link or not file:
            return match[0]
        linked = (path.parent / file).resolve()
        page = app.manylights_pages.get(linked)
        if page:
            suffix = Path(app.env.doc2path(page)).suffix
            return f"{opening}/{page}{suffix}{hash_sign}{anchor})"
        return f"{opening}{'' if opening[0] == '!' else 'path:'}{os.path.relpath(linked, here)})"

    # Pictures in links are not needed: no file has one.
    return LINK.sub(target, path.read_text())


def with_pictures(text: str) -> str:
    """Replace the tables of scene files by their pictures."""
    rows = re.compile(r"\| `(\w+)\.(xml|usda)` \| (.*?) \| (.*?) \|(?: (.*?) \|)?")
    lines, gallery = [], False
    for line in text.splitlines():
        row = rows.fullmatch(line)
        if row:
            if not gallery:
                # The table's head
                del lines[-2:]
                lines.append("::::{container} gallery")
            stem, ending, purpose, lights, emitters = row.groups()
            lights = {"0": "no light", "1": "1 light"}.get(lights, f"{lights} lights")
            emitters = f": {emitters}" if emitters and lights != "no light" else ""
            picture = f"usd_{stem}" if ending == "usda" else stem
            lines += [f":::{{figure}} /gallery/{picture}.jpg", f":alt: {stem}.{ending}", ""]
            lines += [f"`{stem}.{ending}`: {purpose}. *{lights}{emitters}*", ":::"]
        elif gallery:
            lines.append("::::")
        gallery = bool(row)
        if not row:
            lines.append(line)
    return "\n".join([*lines, "::::"] if gallery else lines)
