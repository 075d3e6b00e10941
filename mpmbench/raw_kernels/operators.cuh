// Operators on numbers and four-component values: lengths, associative operators with their neutral elements, and what a
// warp does with them by shuffles alone.
#pragma once
#include "real.cuh"

constexpr unsigned ALL_LANES = 0xffffffffu;

__device__ inline int length(int a) { return abs(a); }
__device__ inline real length(real a) { return fabs(a); }
__device__ inline real length(const real4& a) { return sqrt(a.x * a.x + a.y * a.y + a.z * a.z + a.w * a.w); }

__device__ inline int lowest(int) { return -2147483647 - 1; }
__device__ inline float lowest(float) { return __int_as_float(0xff800000); }
__device__ inline double lowest(double) { return __longlong_as_double(0xfff0000000000000ll); }

struct Add {
    template <typename Number>
    __device__ static Number neutral(Number) {
        return 0;
    }
    __device__ static real4 neutral(const real4&) { return {0, 0, 0, 0}; }
    template <typename Value>
    __device__ static Value combine(const Value& a, const Value& b) {
        return a + b;
    }
};

struct Max {
    template <typename Number>
    __device__ static Number neutral(Number number) {
        return lowest(number);
    }
    __device__ static real4 neutral(const real4&) {
        const real least = lowest(real());
        return {least, least, least, least};
    }
    template <typename Number>
    __device__ static Number combine(const Number& a, const Number& b) {
        return max(a, b);
    }
    // Component by component.
    __device__ static real4 combine(const real4& a, const real4& b) {
        return {max(a.x, b.x), max(a.y, b.y), max(a.z, b.z), max(a.w, b.w)};
    }
};

// The value of the lane `reach` above.
template <typename Number>
__device__ inline Number from_above(const Number& value, int reach) {
    return __shfl_down_sync(ALL_LANES, value, reach);
}
__device__ inline real4 from_above(const real4& value, int reach) {
    return {from_above(value.x, reach), from_above(value.y, reach), from_above(value.z, reach),
            from_above(value.w, reach)};
}

// All values of a warp combined; only lane 0 holds the result. Every lane takes part.
template <typename Operator, typename Value>
__device__ inline Value warp_reduce(Value value) {
#pragma unroll
    for (int reach = WARP / 2; reach > 0; reach /= 2) value = Operator::combine(value, from_above(value, reach));
    return value;
}

// The values of this lane and of those below it combined. Every lane takes part.
template <typename Operator, typename Number>
__device__ inline Number warp_inclusive_scan(Number value, int lane) {
#pragma unroll
    for (int reach = 1; reach < WARP; reach *= 2) {
        const Number below = __shfl_up_sync(ALL_LANES, value, reach);
        if (lane >= reach) value = Operator::combine(below, value);
    }
    return value;
}
