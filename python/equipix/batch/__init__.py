"""Many sensors: manifests evaluated on one machine or on a cluster.

`run` evaluates each manifest on a worker of dask.distributed, which writes the result, a page and a
row of the lot. What was evaluated before with the same inputs, options and version is kept.

`average` and `correct` do so with the frames of one long series, piece by piece.
"""

from equipix.batch.averages import average
from equipix.batch.evaluation import Row
from equipix.batch.lot import Lot
from equipix.batch.recordings import correct
from equipix.batch.run import run

__all__ = ["Lot", "Row", "average", "correct", "run"]
