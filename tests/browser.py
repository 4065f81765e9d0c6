"""Looks at a page in headless Chromium: console, pictures, and whether it fits a phone."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess

NAMES = ("chromium", "chromium-browser", "google-chrome")

# Chromium's windows are never narrower than 500 pixels, so the page goes into a frame. The frame
# is inspected from outside: the page itself stays as it is, and forbids scripts anyway.
HARNESS = """<!DOCTYPE html>
<title>harness</title>
<iframe id="frame" src="{page}" style="width: {width}px; height: 800px; border: 0"></iframe>
<pre id="findings"></pre>
<script>
const frame = document.getElementById("frame");
frame.onload = () => {{
    const page = frame.contentDocument, root = page.documentElement;
    const images = [...page.images];
    const inside = (element) => element.closest(".scroll, .wide");
    const findings = {{
        images: images.length,
        broken: images.filter(image => !image.complete || !image.naturalWidth || !image.clientWidth)
            .map(image => image.alt),
        width: root.clientWidth,
        content: Math.max(root.scrollWidth, page.body.scrollWidth),
        wide: [...page.body.querySelectorAll("*")].filter(element => !inside(element)
            && element.getBoundingClientRect().right > root.clientWidth + 1).map(e => e.tagName),
        headings: [...page.querySelectorAll("h2")].map(heading => heading.textContent),
    }};
    document.getElementById("findings").textContent = JSON.stringify(findings);
}};
</script>
"""


def find():
    """Path of a Chromium, or None."""
    return next(filter(None, map(shutil.which, NAMES)), None)


def look_at(page, folder, width=380, dark=False):
    """What the browser says about the file `page`; `folder` takes its profile and the harness.

    Returns a dict: the number of `images`, the `broken` ones, the `width` of the window and that of
    the `content`, elements that are too `wide`, `headings`, and lines of the `console`.
    """
    harness = folder / "harness.html"
    harness.write_text(HARNESS.format(page=page.as_uri(), width=width))
    command = [
        *(find(), "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr"),
        *("--allow-file-access-from-files", f"--user-data-dir={folder / 'profile'}"),
        *("--virtual-time-budget=10000", "--window-size=1280,900", "--dump-dom"),
        # Phones lay scroll bars over the page.
        "--hide-scrollbars",
    ]
    if dark:
        command.append("--blink-settings=preferredColorScheme=0")
    process = subprocess.run(
        [*command, harness.as_uri()], capture_output=True, text=True, timeout=120
    )
    found = re.search(r'<pre id="findings">(.+?)</pre>', process.stdout, re.DOTALL)
    assert found, f"the page did not load: {process.stderr[-2000:]}"
    findings = json.loads(html.unescape(found.group(1)))
    findings["console"] = re.findall(r":CONSOLE[:(].*", process.stderr)
    return findings
