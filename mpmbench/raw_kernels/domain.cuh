// The grid as kernels see it, and the numbering of its nodes and bins.
//
// Node (i, j, k) has index (k * ny + j) * nx + i. A bin collects the particles of one cell, named by its bin node; bins
// are numbered like nodes, or (BLOCK_INDEX) block after block with the cells of a block contiguous.
#pragma once
#include "spline.cuh"

struct Domain {
    int nx, ny, nz;     // nodes per axis
    int bx, by, bz;     // blocks per axis
    real ox, oy, oz;    // position of node (0, 0, 0) [m]
    real dx, inv_dx;    // spacing [m] and its inverse [1/m]
};

struct Cell {
    int x, y, z;
};

__device__ inline int node_index(const Domain& domain, int x, int y, int z) {
    return (z * domain.ny + y) * domain.nx + x;
}

// The node at an offset of a support that starts at `lowest`. Its row comes first, so that x is a displacement inside the
// instruction and a row of nodes shares one address.
template <typename Node>
__device__ inline Node* node_at(const Domain& domain, Node* lowest, const Offset& o) {
    return lowest + node_index(domain, 0, o.y, o.z) + o.x;
}

__device__ inline bool in_grid(const Domain& domain, int x, int y, int z) {
    // One unsigned comparison per axis refuses negative indices as well.
    return unsigned(x) < unsigned(domain.nx) && unsigned(y) < unsigned(domain.ny) && unsigned(z) < unsigned(domain.nz);
}

__device__ inline int bin_index(const Domain& domain, const Cell& cell) {
#if BLOCK_INDEX
    const int block = ((cell.z / BLOCK_Z) * domain.by + cell.y / BLOCK_Y) * domain.bx + cell.x / BLOCK_X;
    const int inside = ((cell.z % BLOCK_Z) * BLOCK_Y + cell.y % BLOCK_Y) * BLOCK_X + cell.x % BLOCK_X;
    return block * (BLOCK_X * BLOCK_Y * BLOCK_Z) + inside;
#else
    return node_index(domain, cell.x, cell.y, cell.z);
#endif
}

// Bin node and fraction of one coordinate.
__device__ inline int split_coordinate(real x, real origin, real inv_dx, real& fraction) {
    const real xi = rounded_product(x - origin, inv_dx);
    const int bin = floor_to_int(SPLINE == 2 ? xi - real(0.5) : xi);
    fraction = xi - real(bin);
    return bin;
}

__device__ inline Cell split_position(const Domain& domain, const real4& position, real3& fraction) {
    return {split_coordinate(position.x, domain.ox, domain.inv_dx, fraction.x),
            split_coordinate(position.y, domain.oy, domain.inv_dx, fraction.y),
            split_coordinate(position.z, domain.oz, domain.inv_dx, fraction.z)};
}
