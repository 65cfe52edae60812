"""Objects that are alive, for tests of what is forgotten."""

import gc


def alive(kind):
    """Number of objects of a type in this process, those of other tests included."""
    gc.collect()
    return sum(type(item) is kind for item in gc.get_objects())
