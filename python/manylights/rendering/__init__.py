"""Renders a loaded scene, in passes where that is useful, and reports the progress.

- ``plan``: which passes there are, as pure numbers;
- ``sums``: what they add up to;
- ``job``: a render with all that its image depends on;
- ``passes``: one pass after the other, without files;
- ``checkpoint``: keeps the sums in a file;
- ``render``: puts these together.
"""

from manylights.rendering.job import Job
from manylights.rendering.render import render

__all__ = ["Job", "render"]
