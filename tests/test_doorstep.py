"""What a visitor meets first: README, its commands and links, and what lies at the top level."""

import json
import re
import shlex
import subprocess
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from manylights.cli.main import parser

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()

#: Pages with links that must lead somewhere.
PAGES = (
    *("README.md", "CHANGELOG.md", ".github/CONTRIBUTING.md", ".github/SECURITY.md"),
    "plugins/README.md",
    *("scenes/README.md", "scenes/bench/README.md", "scenes/bench/more.md", "tests/README.md"),
)


def code_blocks(language):
    """The blocks of the README in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.M | re.S)


def commands(*programs):
    """The commands of the README that call one of these programs, without comments."""
    lines = re.findall(r"^    (\S.*)$", README, re.M) + re.findall(r"`([^`\n]+)`", README)
    return [line.split("  #")[0].strip() for line in lines if line.split()[0] in programs]


def test_readme_is_short():
    lines = README.splitlines()
    assert len(lines) <= 150
    assert [line for line in lines if len(line) > 100] == []


def test_commands_of_the_readme_are_understood():
    found = [shlex.split(line)[1:] for line in commands("manylights")]
    whole = [arguments for arguments in found if len(arguments) > 1 and "--help" not in arguments]
    assert len(whole) >= 4
    for arguments in whole:
        parser().parse_args(arguments)
    # In a sentence, without what follows
    for name in {arguments[0] for arguments in found}:
        with pytest.raises(SystemExit) as raised:
            parser().parse_args([name, "--help"])
        assert raised.value.code == 0


def test_make_knows_the_goals_of_the_readme():
    makefile = (ROOT / "Makefile").read_text()
    goals = [line.split()[1] for line in commands("make") if " " in line]
    assert "demo" in goals
    for goal in goals:
        assert re.search(rf"^{goal}:", makefile, re.M), goal


def test_python_of_the_readme_renders(scalar, plugin, tmp_path, monkeypatch):
    (text,) = code_blocks("python")
    for old, new in (
        ("llvm_ad_rgb", scalar),
        ("10_000", "50, width=16, height=8"),
        ("=16)", "=1)"),
    ):
        assert old in text
        text = text.replace(old, new)
    monkeypatch.chdir(tmp_path)
    exec(compile(text, "README.md", "exec"), {})
    pixels = np.array(mi.Bitmap(str(tmp_path / "city.exr")))
    assert np.isfinite(pixels).all() and pixels.shape[:2] == (8, 16)


def test_xml_of_the_readme_loads(scalar, plugin):
    (text,) = code_blocks("xml")
    assert mi.load_string(text).integrator().class_name() == "ManyLightsDirect"


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page):
    path = ROOT / page
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        if re.match(r"https?://|mailto:", target):
            continue
        name, _, anchor = target.partition("#")
        linked = path.parent / name if name else path
        assert linked.exists(), f"{page}: {target}"
        assert not anchor or anchor in anchors(linked.read_text()), f"{page}: {target}"


def anchors(text):
    """The names that GitHub gives to headings."""
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}


def table_rows(text):
    """The rows of the tables of a page, as lists of cells."""
    lines = (line for line in text.splitlines() if line.startswith("| "))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_numbers_of_the_readme_are_those_measured():
    """Of Mitsuba's methods in the report, of Cycles in what was measured by hand."""
    measured = table_rows((ROOT / "scenes" / "bench" / "README.md").read_text())
    by_hand = (ROOT / "scenes" / "bench" / "more.md").read_text()
    rows = table_rows(README.partition("## When it helps")[2].partition("## ")[0])
    assert len(rows) == 7
    for _, lights, *mitsubas, cycles in rows[1:]:
        numbers = [text for text in mitsubas if text[0].isdigit()]
        cells = [lights, *numbers]
        assert any(set(cells) <= set(row) for row in measured), cells
        assert cycles == "-" or re.search(rf"\b{re.escape(cycles)}\b", by_hand), cycles


def test_readme_of_the_tests_lists_all_of_them():
    listed = (ROOT / "tests" / "README.md").read_text()
    files = [path.name for path in (ROOT / "tests").glob("test_*.py")]
    assert [name for name in files if f"`{name}`" not in listed] == []


def test_every_scene_has_a_small_picture_in_the_documentation():
    scenes = [path.stem for path in (ROOT / "scenes").glob("*.xml")]
    scenes += [f"usd_{path.stem}" for path in (ROOT / "scenes" / "usd").glob("*.usda")]
    pictures = {path.stem: path for path in (ROOT / "python/docs/gallery").glob("*.jpg")}
    assert pictures.keys() == set(scenes)
    for path in pictures.values():
        assert path.stat().st_size < 40_000, path


def test_every_plugin_has_a_page_in_the_documentation():
    stubs = [path.read_text() for path in (ROOT / "python/docs/plugins").glob("*.rst")]
    named = {path for text in stubs for path in re.findall(r"source: (\S+)", text)}
    plugins = (ROOT / "plugins").glob("manylights_*.cpp")
    assert named == {str(path.relative_to(ROOT)) for path in plugins}


NOTEBOOK = ROOT / "scenes" / "tutorial.ipynb"


def cells():
    """The cells of code of the notebook."""
    notebook = json.loads(NOTEBOOK.read_text())
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def test_notebook_shows_pictures_and_is_small():
    assert NOTEBOOK.stat().st_size < 1_000_000
    shown = [output for cell in cells() for output in cell["outputs"]]
    assert len([one for one in shown if "text/html" in one.get("data", {})]) == 5
    # A log would name folders of the machine that ran it.
    assert all(one["output_type"] == "execute_result" or one["name"] == "stdout" for one in shown)


@pytest.mark.slow
def test_notebook_runs(plugin, monkeypatch):
    pytest.importorskip("pxr", reason="needs usd-core: pip install 'manylights[usd]'")
    monkeypatch.chdir(NOTEBOOK.parent)
    names = {}
    for cell in cells():
        exec(compile("".join(cell["source"]), NOTEBOOK.name, "exec"), names)
    noisy, image = np.array(names["noisy"]), np.array(names["image"])
    assert np.isfinite(image).all() and image.mean() > 0.0
    # The same light, less noise: neighbours differ less
    assert np.abs(np.diff(image, axis=1)).mean() < 0.5 * np.abs(np.diff(noisy, axis=1)).mean()
    assert names["result"].noise <= 0.06
    assert np.array(names["street"].bitmap)[..., :3].mean() > 0.0


def test_top_level_holds_only_rooms():
    """What a reader sees first: folders of code, and the files that tools expect there."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode != 0:
        pytest.skip("not a checkout")
    folders = {"plugins", "python", "scenes", "tests", "ext"}
    files = {"README.md", "CHANGELOG.md", "LICENSE", "CITATION.cff"}
    build = {"CMakeLists.txt", "Makefile", "pyproject.toml"}
    top = {name.split("/")[0] for name in listed.stdout.split()}
    assert {name for name in top if not name.startswith(".")} == folders | files | build
