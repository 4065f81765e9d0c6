"""Makes a web page and charts of what ``manylights bench`` measured.

``results`` reads and checks the measurements, ``statistics`` has means and intervals, ``grouping``
decides what is compared with what. ``charts``, ``pictures`` and ``tables`` make the parts, and
``page`` puts them together. None of it is imported by ``import manylights``.
"""
