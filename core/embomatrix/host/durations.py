"""Durations in words, the same in reports, stories of runs and command lines."""

from typing import Final

DIGITS: Final = 3
UNITS: Final = (
    ("µs", 1e-6, 1e-3),
    ("ms", 1e-3, 1.0),
    ("s", 1.0, 120.0),
    ("min", 60.0, 7200.0),
    ("h", 3600.0, 172_800.0),
)
"""Name and length of each unit in seconds, and the duration from which the next unit is used."""
DAY_S: Final = 86_400.0


def seconds_text(seconds: float) -> str:
    """Return a duration with three digits and a fitting unit, such as `4.2 s`; `0` for none."""
    if not seconds:
        return "0"
    for name, unit_s, until_s in UNITS:
        # The unit fits the rounded number: 0.9996 s is 1 s and not 1000 ms.
        number = float(f"{seconds / unit_s:.{DIGITS}g}")
        if number * unit_s < until_s * (1 - 1e-9):
            return f"{number:g} {name}"
    days = seconds / DAY_S
    return f"{days:.{DIGITS}g} days" if days < 999.5 else f"{days:,.0f} days"
