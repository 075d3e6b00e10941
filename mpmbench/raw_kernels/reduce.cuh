// Reduction: what is read (unary operator), how two values become one (binary operator), and the steps that strategies
// share. Operators are parameters: UNARY turns element i of the input into a value, BINARY combines two values.
//
// Constants: ELEMENT (type of the input: int, real, real4), UNARY (Identity, Length, Momentum, SpeedBound),
// BINARY (Add, Max), GROUP (threads of a thread block), LOADS (elements that a thread reads), REACH (see SpeedBound).
#pragma once
#include "operators.cuh"

using element = ELEMENT;

// --- unary operators --------------------------------------------------------------------------------------------------

struct Identity {
    __device__ static element of(const element* values, int, int i) { return values[i]; }
};

// Length of a vector, magnitude of a number.
struct Length {
    __device__ static auto of(const element* values, int, int i) { return length(values[i]); }
};

// Momentum and mass of particle i, from its first two attributes (SoA): their sums are what transfers conserve.
struct Momentum {
    __device__ static real4 of(const real4* attributes, int count, int i) {
        const real4 position = attributes[i];
        const real4 velocity = attributes[count + i];
        const real m = position.w;
        return {m * velocity.x, m * velocity.y, m * velocity.z, m};
    }
};

// |v| + REACH |C|, a bound on the speed of every node that particle i reaches; C = B D^-1 has attributes 2 to 4 as rows,
// |C| is its Frobenius norm, and REACH = kappa dx is the farthest node of a support [m].
struct SpeedBound {
    __device__ static real of(const real4* attributes, int count, int i) {
        const real4 v = attributes[count + i];
        real squares = 0;
#pragma unroll
        for (int row = 2; row < 5; ++row) {
            const real4 c = attributes[row * count + i];
            squares += c.x * c.x + c.y * c.y + c.z * c.z;
        }
        return sqrt(v.x * v.x + v.y * v.y + v.z * v.z) + real(REACH) * sqrt(squares);
    }
};

using Unary = UNARY;
using Binary = BINARY;

// --- steps ------------------------------------------------------------------------------------------------------------

// The value of element i, or the neutral one past the end.
template <typename Element>
__device__ inline auto value_at(const Element* values, int count, int i) {
    using Value = decltype(Unary::of(values, count, i));
    return i < count ? Unary::of(values, count, i) : Binary::neutral(Value());
}

// What this thread reads: LOADS elements, GROUP apart, so that neighbouring lanes read neighbouring elements.
template <typename Element>
__device__ inline auto sequential_part(const Element* values, int count) {
    const int first = blockIdx.x * (GROUP * LOADS) + threadIdx.x;
    auto sum = value_at(values, count, first);
#pragma unroll 8
    for (int j = 1; j < LOADS; ++j) sum = Binary::combine(sum, value_at(values, count, first + j * GROUP));
    return sum;
}
