// Idea: a scan inside each block of a grid follows from the scan of the whole grid, because rows of a block are pieces of
// rows of the grid: subtract what precedes a row, scan the sums of the rows, add them back. No cell is summed again.
// A thread block owns one block of BLOCK_X x BLOCK_Y x BLOCK_Z cells; a thread owns one cell (x fastest).
// scanned has one entry more than there are cells: the total.
// Constants: BLOCK_X, BLOCK_Y, BLOCK_Z, and those of real.cuh. Shared memory: one integer per row of the block.
#include "operators.cuh"

constexpr int ROWS = BLOCK_Y * BLOCK_Z;

extern "C" __global__ void __launch_bounds__(BLOCK_X * ROWS) block_scan_rows(
    const int nx, const int ny, const int nz, const int blocks_x, const int blocks_y, const int* __restrict__ scanned,
    int* __restrict__ block_scanned) {
    __shared__ int rows[ROWS];

    const int first_x = blockIdx.x % blocks_x * BLOCK_X;
    const int first_y = blockIdx.x / blocks_x % blocks_y * BLOCK_Y;
    const int first_z = blockIdx.x / (blocks_x * blocks_y) * BLOCK_Z;
    const int t = threadIdx.x;
    const int x = t % BLOCK_X;
    const int row = t / BLOCK_X;
    const int y = first_y + row % BLOCK_Y;
    const int z = first_z + row / BLOCK_Y;
    const bool row_exists = y < ny && z < nz;
    const bool exists = row_exists && first_x + x < nx;
    const int row_start = (z * ny + y) * nx + first_x;

    // Before this cell in its row (eq. 151), and the sum of the whole row (eqs. 152, 153).
    const int before_row = row_exists ? scanned[row_start] : 0;
    const int in_row = exists ? scanned[row_start + x] - before_row : 0;
    if (x == 0) rows[row] = row_exists ? scanned[row_start + min(BLOCK_X, nx - first_x)] - before_row : 0;
    __syncthreads();
    // The scan of one dimension less (eq. 154), by one warp.
    if (t < WARP) {
        int carried = 0;
        for (int start = 0; start < ROWS; start += WARP) {
            const int sum = start + t < ROWS ? rows[start + t] : 0;
            const int up_to_here = warp_inclusive_scan<Add>(sum, t);
            if (start + t < ROWS) rows[start + t] = carried + up_to_here - sum;
            carried += __shfl_sync(ALL_LANES, up_to_here, WARP - 1);
        }
    }
    __syncthreads();
    // Added back row by row (eq. 155).
    if (exists) block_scanned[row_start + x] = in_row + rows[row];
}
