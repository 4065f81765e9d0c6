"""Measures how methods of choosing lights compare at equal samples and at equal time.

``manylights bench`` renders scenes with each method and writes times and errors to a folder;
``manylights compare`` compares two images. What each file does:

- ``standard``: the scenes of ``--standard`` and ``--quick``;
- ``scene_source``: what SCENE may be; ``methods``: the methods and their integrators;
- ``runner``: what is rendered in which order; ``calibration``: how many samples fit into a time;
  ``reference``: the image that errors are measured against; ``drawing``: one timed render;
- ``records``: what is in results.json; ``folder``: where it and the images are; ``machine``: what
  they were measured on;
- ``moments``: variances over seeds; ``workload``: the time left;
- ``metrics``: errors; ``compare``: two images; ``extras``: packages needed.
"""
