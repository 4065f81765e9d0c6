"""Makes a web page and charts of what ``manylights bench`` measured.

``bench.records`` reads and checks the measurements, ``statistics`` has means and intervals,
``grouping`` decides what is compared with what. ``charts``, ``pictures``, ``sheets`` and ``tables``
make the parts, ``page`` and ``markdown`` put them together. None of it is imported by
``import manylights``.
"""
