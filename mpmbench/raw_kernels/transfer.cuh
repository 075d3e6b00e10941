// What a particle gives to a node and takes from it, for both payloads. Every strategy calls these and nothing else.
//
// P2G: a node receives w m and w m v (PIC) or w m (v + C (x_i - x_p)) (APIC).
// G2P: v_p = sum w v_i; C = D^-1 B with B = sum w v_i (x_i - x_p)^T and D = dx^2/4 (quadratic), dx^2/3 (cubic). The
// linear D is singular at nodes, so there C = sum v_i (grad w)^T.
#pragma once
#include "domain.cuh"
#include "particles.cuh"

// A particle ready to be spread: payload in registers, C times dx because distances are counted in cells.
struct Source {
    real3 f;
    real mass;
    real3 v;
    real3 c[3];  // rows
};

__device__ inline real3 xyz(const real4& a) { return {a.x, a.y, a.z}; }

// A particle that gives nothing, for the places of a batch that have no particle.
__device__ inline Source no_source() {
    return {{0, 0, 0}, 0, {0, 0, 0}, {{0, 0, 0}, {0, 0, 0}, {0, 0, 0}}};
}

__device__ inline Source load_particle(const Domain& domain, const real4* particles, int particle_count, int p, Cell& bin) {
    Source source = no_source();
    const real4 position = load_attribute(particles, particle_count, p, 0);
    bin = split_position(domain, position, source.f);
    source.mass = position.w;
    source.v = xyz(load_attribute(particles, particle_count, p, 1));
    if constexpr (APIC) {
#pragma unroll
        for (int row = 0; row < 3; ++row) {
            const real4 c = load_attribute(particles, particle_count, p, 2 + row);
            source.c[row] = {domain.dx * c.x, domain.dx * c.y, domain.dx * c.z};
        }
    }
    return source;
}

// velocity + C (x_i - x_p) along one row; z first, so that a row of nodes shares the z and y terms.
__device__ inline real affine_row(real v, const real3& c, const real3& d) { return v + c.z * d.z + c.y * d.y + c.x * d.x; }

// What the node at this offset receives, given w m: momentum and mass.
__device__ inline real4 contribution(const Source& source, real weighted_mass, const Offset& o) {
    real3 v = source.v;
    if constexpr (APIC) {
        const real3 d = {distance(source.f.x, o.x), distance(source.f.y, o.y), distance(source.f.z, o.z)};
        v = {affine_row(v.x, source.c[0], d), affine_row(v.y, source.c[1], d), affine_row(v.z, source.c[2], d)};
    }
    return {weighted_mass * v.x, weighted_mass * v.y, weighted_mass * v.z, weighted_mass};
}

// What a particle has gathered so far.
struct Gathered {
    real3 v;
    real3 b[3];  // rows of sum v_i g^T, g the factor below
};

__device__ inline Gathered nothing_gathered() { return {{0, 0, 0}, {{0, 0, 0}, {0, 0, 0}, {0, 0, 0}}}; }

// w (x_i - x_p) / dx for quadratic and cubic, grad w * dx for linear.
__device__ inline real3 affine_factor(const Weights& weights, real w, const real3& f, const Offset& o) {
    if constexpr (SPLINE == 1) {
        const real wx = weights.x.at(o.x), wy = weights.y.at(o.y), wz = weights.z.at(o.z);
        return {o.x ? wz * wy : -wz * wy, o.y ? wz * wx : -wz * wx, o.z ? wy * wx : -wy * wx};
    } else {
        return {w * distance(f.x, o.x), w * distance(f.y, o.y), w * distance(f.z, o.z)};
    }
}

__device__ inline void add_scaled(real3& sum, real factor, const real3& a) {
    sum.x += factor * a.x;
    sum.y += factor * a.y;
    sum.z += factor * a.z;
}

__device__ inline void gather(Gathered& sum, const Weights& weights, const real3& f, const Offset& o, const real4& node) {
    const real w = weights.scaled(real(1), o);
    const real3 v = xyz(node);
    add_scaled(sum.v, w, v);
    if constexpr (APIC) {
        const real3 g = affine_factor(weights, w, f, o);
        add_scaled(sum.b[0], v.x, g);
        add_scaled(sum.b[1], v.y, g);
        add_scaled(sum.b[2], v.z, g);
    }
}

__device__ inline void store_gathered(
    const Domain& domain, const Gathered& sum, real4* results, int particle_count, int p) {
    store_result(results, particle_count, p, 0, {sum.v.x, sum.v.y, sum.v.z, 0});
    if constexpr (APIC) {
        constexpr int INVERSE_D = SPLINE == 1 ? 1 : SPLINE == 2 ? 4 : 3;  // of D / dx^2
        const real scale = real(INVERSE_D) * domain.inv_dx;
#pragma unroll
        for (int row = 0; row < 3; ++row) {
            const real3& b = sum.b[row];
            store_result(results, particle_count, p, 1 + row, {scale * b.x, scale * b.y, scale * b.z, 0});
        }
    }
}
