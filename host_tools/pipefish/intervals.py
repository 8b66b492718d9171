"""How uncertainty is told to people: every ± in a text, on a page or on a terminal is a 95 % interval. Files hold
standard deviations; their names end in sigma."""

from __future__ import annotations

Z95 = 1.96  # standard deviations of it
SAID = "every ± is a 95 % interval"  # once in each output that has some
