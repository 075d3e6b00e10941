// Shared memory for one value per place, free of bank conflicts wherever neighbouring lanes take neighbouring places.
#pragma once

// Values wider than one access lie in pieces, one array per piece: lanes that step over 32 bytes would share banks.
template <typename Value, int PLACES>
struct Tile {
    static constexpr bool WIDE = sizeof(Value) > 16;
    static constexpr int PIECES = WIDE ? sizeof(Value) / 16 : 1;
    struct alignas(16) Piece {
        double low, high;
    };
    union Whole {
        Value value;
        Piece pieces[PIECES];
        __device__ Whole() {}
    };

    alignas(16) unsigned char bytes[PLACES * sizeof(Value)];

    __device__ Value get(int place) const {
        if constexpr (!WIDE) {
            return reinterpret_cast<const Value*>(bytes)[place];
        } else {
            Whole whole;
#pragma unroll
            for (int k = 0; k < PIECES; ++k) {
                whole.pieces[k] = reinterpret_cast<const Piece*>(bytes)[k * PLACES + place];
            }
            return whole.value;
        }
    }

    __device__ void set(int place, const Value& value) {
        if constexpr (!WIDE) {
            reinterpret_cast<Value*>(bytes)[place] = value;
        } else {
            Whole whole;
            whole.value = value;
#pragma unroll
            for (int k = 0; k < PIECES; ++k) {
                reinterpret_cast<Piece*>(bytes)[k * PLACES + place] = whole.pieces[k];
            }
        }
    }
};
