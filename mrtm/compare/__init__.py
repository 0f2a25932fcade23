"""The paper's off-line optimisation against the on-line one, on the same local maps."""

from mrtm.compare.comparison import Score, compare, rows
from mrtm.compare.table import table
from mrtm.compare.ways import Way, three_ways

__all__ = ["Score", "Way", "compare", "rows", "table", "three_ways"]
