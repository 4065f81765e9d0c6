"""Renders a scene step by step, and reports the progress.

- ``plan``: which steps and passes there are, and ``targets``: how many for a noise or a time; as
  pure numbers;
- ``sums``, ``noise``: what they add up to, and how noisy that is;
- ``driver``: has Mitsuba render a step, without files;
- ``develop``, ``state``: images of sums; all that a render has so far;
- ``job``: a render with all that its image depends on;
- ``parts``: which steps each of several machines has;
- ``state_file``, ``checkpoint``: the state in a file, and when it is written;
- ``workers``: the same steps by several processes and machines;
- ``arguments``: which of them exclude each other, before anything is loaded;
- ``render``: puts these together, and ``merge`` what several have rendered;
- ``mix``: other images of one with layers of light groups.
"""

from manylights.rendering.job import Job
from manylights.rendering.merge import Merged, merge
from manylights.rendering.mix import Mixed, mix
from manylights.rendering.render import Progress, RenderResult, render

__all__ = ["Job", "Merged", "Mixed", "Progress", "RenderResult", "merge", "mix", "render"]
