// Records in any memory layout, generated from one declaration of their attributes: kernels name an attribute and do not
// know where it lies.
//
// Constants: ATTRIBUTES(_), which lists _(type, name) for every attribute; TILE, places of a tile: 1 is an array of
// structures, 0 stands for all places, a structure of arrays, and 32 gives every warp a tile of its own.
#pragma once
#include "real.cuh"

template <int PLACES>
struct Tile {
#define MEMBER(type, name) type name[PLACES];
    ATTRIBUTES(MEMBER)
#undef MEMBER
};

// A buffer of records. capacity is a multiple of 32.
struct Records {
    const char* bytes;
    int capacity;

    __device__ Records(const char* bytes, int capacity) : bytes(bytes), capacity(capacity) {}

#if TILE > 0
#define ACCESSOR(type, name) \
    __device__ type name(int i) const { return reinterpret_cast<const Tile<TILE>*>(bytes)[i / TILE].name[i % TILE]; }
#else
// What precedes an attribute takes as many bytes per place as in a tile of 32, whose arrays need no padding.
#define ACCESSOR(type, name)                                                                             \
    __device__ type name(int i) const {                                                                  \
        const char* tile_of_32 = reinterpret_cast<const char*>(reinterpret_cast<const Tile<32>*>(bytes)->name); \
        return reinterpret_cast<const type*>(bytes + (tile_of_32 - bytes) / 32 * capacity)[i];           \
    }
#endif
    ATTRIBUTES(ACCESSOR)
#undef ACCESSOR
};
