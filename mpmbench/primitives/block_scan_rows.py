"""Scan inside every block of a grid, row by row, from the scan of the whole grid.

Idea: what a block's row holds before a cell is a difference of two entries of the global scan; only the sums of the
rows are scanned anew, one dimension less.

Wins when: particles of a block are wanted in one numbering of their own and the global scan exists anyway.
Loses when: a block works bin by bin, as the transfers here do: they take differences of the global scan as they need
them.

Source: thesis appendix B, eqs. 147 to 155, figure 10; Hoetzlein, Fast fixed-radius nearest neighbors, GTC 2014, for
whose neighbour search it was meant.
"""

import numpy as np

from mpmbench.operations.block_scan import BLOCK_SCAN, grid_of, requires
from mpmbench.operations.scan import NEUTRAL
from mpmbench.primitives import Bench, Built, Primitive


def build(bench: Bench) -> Built:
    shape = bench.axes["block_shape"]
    grid = grid_of(len(bench.inputs["counts"]))
    blocks = grid.blocks(shape)
    result = bench.empty(grid.node_count, np.int32)
    kernel = bench.kernel(**NEUTRAL, BLOCK_X=shape[0], BLOCK_Y=shape[1], BLOCK_Z=shape[2])
    args = (*map(np.int32, (*grid.shape, *blocks[:2])), bench.upload(bench.inputs["scanned"]), result)
    return Built(bench.launch(kernel, int(np.prod(blocks)), int(np.prod(shape)), *args), {"block_scanned": result})


PRIMITIVE = Primitive(
    name="block_scan_rows",
    operation=BLOCK_SCAN,
    summary="rows of a block from the grid's scan, then their sums",
    kernel="block_scan_rows",
    axes={"block_shape": ((8, 4, 4), (4, 4, 4), (8, 8, 4), (4, 4, 2), (3, 5, 2))},
    build=build,
    reference="thesis appendix B",
    requires=requires,
)
