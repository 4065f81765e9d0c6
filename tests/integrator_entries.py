"""Writes the arrays among an integrator's entries of ``mi.traverse``."""

import mitsuba as mi
import numpy as np

#: Roles of passes
ALL, TRAIN, REST = range(3)


def write(integrator, **entries):
    """Write ``plan`` and ``visibility_counts`` (for ``visibility.counts``), whatever their size.

    ``params[key] = value`` compares both arrays first, which scalar variants cannot if their sizes
    differ.
    """
    params = mi.traverse(integrator)
    for key, value in entries.items():
        key = key.replace("_", ".")
        pointer, cpptype, node, _ = params.properties[key]
        array = type(params.get_property(pointer, cpptype, node))
        params.set_dirty(key)
        numbers = np.ravel(np.array(value, dtype=np.uint32))
        params.set_property(pointer, cpptype, array(numbers if len(numbers) else []))
    params.update()


def read(integrator, key):
    """Return one of these arrays."""
    return np.array(mi.traverse(integrator)[key], dtype=np.uint32)
