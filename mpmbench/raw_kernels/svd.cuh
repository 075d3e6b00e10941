// Polar SVD F = U diag(s) V^T and polar decomposition F = R S of a 3x3 matrix: in registers, the same steps for every F.
//
// U and V are rotations (det +1), s.x >= s.y >= |s.z|, and s.z carries the sign of det F. R = U V^T is a rotation too;
// S = V diag(s) V^T is symmetric, and indefinite where det F < 0. A NaN or infinity in F makes every result NaN; finite
// F gives finite rotations, and a singular value is infinite only where the type cannot hold it.
//
// After McAdams et al. 2011 (thesis section 4.2): Jacobi rotations diagonalise F^T F, which gives V; a QR factorisation
// of F V by Givens rotations gives U and s. Rotations are collected in quaternions. Three things differ:
// - Angles are exact. With approximate ones and four sweeps, one random matrix in 400 is wrong by more than 1e-3.
// - The last sweep turns the columns of F V. F^T F holds no singular value below sqrt(epsilon) s.x, the columns do.
//   Each of its rotations puts the longer column first, so it also sorts.
// - F is scaled by a power of two first, so that squares neither overflow nor vanish. That is exact, denormals included.
#pragma once
#include "real.cuh"

// Sweeps on F^T F, one more follows on the columns. One fewer leaves errors of 1e-2 (float) and 5e-9 (double).
constexpr int SWEEPS = REAL_IS_DOUBLE ? 4 : 3;

// Added to the length of a vector's first component, so that its angle is never 0 / 0. The square is a normal number,
// and next to a scaled matrix TINY vanishes.
constexpr real TINY = REAL_IS_DOUBLE ? real(1e-150) : real(1e-18);

struct Columns {
    real3 x, y, z;
};

// The six entries of a symmetric matrix.
struct Symmetric {
    real3 diagonal;  // xx, yy, zz
    real3 others;    // xy, yz, zx
};

// The rotation v -> q v q* / |q|^2. Its length is free, so products need not be normalised.
struct Quaternion {
    real w, x, y, z;
};

// Cosine and sine of an angle, or numbers in their ratio.
struct Angle {
    real c, s;
};

// --- memory -----------------------------------------------------------------------------------------------------------

// Entry (row, column) of matrix t is at [(3 row + column) count + t]: neighbouring threads read neighbouring places.
__device__ inline Columns load_matrix(const real* entries, int count, int t) {
    const size_t n = count;
    const real* e = entries + t;
    return {{e[0], e[3 * n], e[6 * n]}, {e[n], e[4 * n], e[7 * n]}, {e[2 * n], e[5 * n], e[8 * n]}};
}

// Component k of vector t is at [k count + t].
__device__ inline void store_vector(real* components, int count, int t, const real3& a) {
    const size_t n = count;
    components[t] = a.x;
    components[n + t] = a.y;
    components[2 * n + t] = a.z;
}

__device__ inline void store_matrix(real* entries, int count, int t, const Columns& a) {
    const size_t n = count;
    store_vector(entries, count, t, {a.x.x, a.y.x, a.z.x});
    store_vector(entries + 3 * n, count, t, {a.x.y, a.y.y, a.z.y});
    store_vector(entries + 6 * n, count, t, {a.x.z, a.y.z, a.z.z});
}

__device__ inline void store_symmetric(real* entries, int count, int t, const Symmetric& a) {
    store_vector(entries, count, t, a.diagonal);
    store_vector(entries + 3 * size_t(count), count, t, a.others);
}

// --- arithmetic -------------------------------------------------------------------------------------------------------

__device__ inline real dot(const real3& a, const real3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
__device__ inline real3 scaled(const real3& a, real factor) { return {a.x * factor, a.y * factor, a.z * factor}; }

__device__ inline real3 add_scaled(const real3& a, real factor, const real3& b) {
    return {a.x + factor * b.x, a.y + factor * b.y, a.z + factor * b.z};
}

// By component, so that it becomes no jump.
__device__ inline real3 select(bool first, const real3& a, const real3& b) {
    return {first ? a.x : b.x, first ? a.y : b.y, first ? a.z : b.z};
}

__device__ inline real3 times(const Columns& f, const real3& a) {
    return add_scaled(add_scaled(scaled(f.x, a.x), a.y, f.y), a.z, f.z);
}

// The hardware's float approximations are wrong in the last two places; a Newton step puts that right. Doubles are
// exact to one place as they are.
__device__ inline float accurate_rsqrt(float a) {
    const float y = rsqrtf(a);
    return y + (0.5f * y) * (1.0f - a * y * y);
}
__device__ inline double accurate_rsqrt(double a) { return rsqrt(a); }

__device__ inline float accurate_reciprocal(float a) {
    const float y = __fdividef(1.0f, a);
    return y + y * (1.0f - a * y);
}
__device__ inline double accurate_reciprocal(double a) { return 1.0 / a; }

// --- scaling ----------------------------------------------------------------------------------------------------------

// Numbers seen as bits. LIFT is the power of two that takes small matrices, denormals among them, to where every power
// of two that scaling needs is a normal number.
#if REAL_IS_DOUBLE
using Bits = unsigned long long;
constexpr int MANTISSA = 52, EXPONENTS = 0x7ff, LIFT = 200;
__device__ inline Bits to_bits(double a) { return __double_as_longlong(a); }
__device__ inline double from_bits(Bits a) { return __longlong_as_double(a); }
#else
using Bits = unsigned int;
constexpr int MANTISSA = 23, EXPONENTS = 0xff, LIFT = 100;
__device__ inline Bits to_bits(float a) { return __float_as_uint(a); }
__device__ inline float from_bits(Bits a) { return __uint_as_float(a); }
#endif
constexpr int BIAS = EXPONENTS / 2;
constexpr int LOWEST = 1 - BIAS;  // exponent of the smallest normal number, and of all denormals
constexpr Bits SIGN = Bits(1) << (8 * sizeof(Bits) - 1);

// 2^k, for normal results only.
__device__ inline real power_of_two(int k) { return from_bits(Bits(k + BIAS) << MANTISSA); }

__device__ inline Bits magnitude(real a) { return to_bits(a) & ~SIGN; }
__device__ inline real with_sign_of(Bits size, real a) { return from_bits(size | (to_bits(a) & SIGN)); }

// 2^LIFT a. A denormal goes by way of its integer mantissa, because float arithmetic flushes it.
__device__ inline real lift(real a) {
    const Bits size = magnitude(a);
    const bool denormal = size >> MANTISSA == 0;
    const real lifted = denormal ? real(size) * power_of_two(LIFT + LOWEST - MANTISSA)
                                 : from_bits(size) * power_of_two(LIFT);
    return with_sign_of(to_bits(lifted), a);
}

// 2^-LIFT a, rounded once also where the result is denormal.
__device__ inline real lower(real a) {
    const real size = from_bits(magnitude(a));
    const bool denormal = size < power_of_two(LIFT + LOWEST);
    const Bits lowered = denormal ? Bits(rint(size * power_of_two(MANTISSA - LOWEST - LIFT)))
                                  : to_bits(size * power_of_two(-LIFT));
    return with_sign_of(lowered, a);
}

__device__ inline real3 lift(const real3& a) { return {lift(a.x), lift(a.y), lift(a.z)}; }

__device__ inline Bits magnitude(const real3& a) { return max(max(magnitude(a.x), magnitude(a.y)), magnitude(a.z)); }

__device__ inline int largest_exponent(const Columns& f) {
    return int(max(max(magnitude(f.x), magnitude(f.y)), magnitude(f.z)) >> MANTISSA);
}

// How to lead results back to the matrix as it was.
struct Scale {
    real factor;
    bool lifted, finite;

    __device__ real undo(real a) const { return lifted ? lower(a * factor) : a * factor; }
    __device__ real3 undo(const real3& a) const {
        const real3 b = {undo(a.x), undo(a.y), undo(a.z)};
        return finite ? b : real3{nan(), nan(), nan()};
    }
    // A quaternion whose rotation matrix is NaN where F was not finite.
    __device__ Quaternion mark(const Quaternion& q) const { return {finite ? q.w : nan(), q.x, q.y, q.z}; }
    __device__ static real nan() { return from_bits(~SIGN); }
};

// Brings the largest entry to [4, 8), where the factor there and the factor back are both normal for every F.
__device__ inline Scale prescale(Columns& f) {
    int exponent = largest_exponent(f);
    const bool lifted = exponent < LIFT / 2;
    const bool finite = exponent < EXPONENTS;
    if (lifted) {
        f = {lift(f.x), lift(f.y), lift(f.z)};
        exponent = max(largest_exponent(f), 3);  // the zero matrix stays zero
    }
    const int k = exponent - BIAS - 2;
    f = {scaled(f.x, power_of_two(-k)), scaled(f.y, power_of_two(-k)), scaled(f.z, power_of_two(-k))};
    return {power_of_two(k), lifted, finite};
}

// --- rotations --------------------------------------------------------------------------------------------------------

// q times the rotation by twice the angle h about axis r; (p, q, r) is a cyclic order of the axes.
__device__ inline void turn(real& w, real& p, real& q, real& r, const Angle& h) {
    const real old_w = w, old_p = p;
    w = w * h.c - r * h.s;
    r = r * h.c + old_w * h.s;
    p = p * h.c + q * h.s;
    q = q * h.c - old_p * h.s;
}

__device__ inline void turn_xy(Quaternion& q, const Angle& h) { turn(q.w, q.x, q.y, q.z, h); }
__device__ inline void turn_yz(Quaternion& q, const Angle& h) { turn(q.w, q.y, q.z, q.x, h); }
__device__ inline void turn_zx(Quaternion& q, const Angle& h) { turn(q.w, q.z, q.x, q.y, h); }
__device__ inline void turn_xz(Quaternion& q, const Angle& h) { turn_zx(q, {h.c, -h.s}); }

__device__ inline Columns rotation_matrix(const Quaternion& q) {
    const real k = real(2) * accurate_reciprocal(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z);
    const real x = k * q.x, y = k * q.y, z = k * q.z;
    return {{real(1) - (y * q.y + z * q.z), x * q.y + z * q.w, x * q.z - y * q.w},
            {x * q.y - z * q.w, real(1) - (x * q.x + z * q.z), y * q.z + x * q.w},
            {x * q.z + y * q.w, y * q.z - x * q.w, real(1) - (x * q.x + y * q.y)}};
}

// The rotation A B^T.
__device__ inline Quaternion times_inverse(const Quaternion& a, const Quaternion& b) {
    return {a.w * b.w + a.x * b.x + a.y * b.y + a.z * b.z, a.x * b.w - a.w * b.x - a.y * b.z + a.z * b.y,
            a.y * b.w - a.w * b.y - a.z * b.x + a.x * b.z, a.z * b.w - a.w * b.z - a.x * b.y + a.y * b.x};
}

// --- eigenanalysis of F^T F -------------------------------------------------------------------------------------------

struct JacobiAngle {
    real c, s, tangent;
};

// The angle of [-pi/4, pi/4] that makes [[a, b], [b, d]] diagonal, from a - d and 2 b: half of atan(2 b / (a - d)).
__device__ inline JacobiAngle jacobi_angle(real difference, real twice_b) {
    const real size = fabs(difference) + TINY;
    const real inverse = rsqrt(size * size + twice_b * twice_b);
    const real c_square = real(0.5) + real(0.5) * size * inverse;
    const real inverse_c = rsqrt(c_square);
    const real s = real(0.5) * (difference < real(0) ? -twice_b : twice_b) * inverse * inverse_c;
    return {c_square * inverse_c, s, s * inverse_c};
}

// A rotation in the plane (p, q) that makes pq vanish; r is the third axis. Returns (in the ratio of) half its angle.
__device__ inline Angle jacobi_rotate(real& pp, real& qq, real& pq, real& rp, real& rq) {
    const JacobiAngle angle = jacobi_angle(pp - qq, real(2) * pq);
    pp += angle.tangent * pq;
    qq -= angle.tangent * pq;
    pq = 0;
    const real old = rp;
    rp = angle.c * rp + angle.s * rq;
    rq = angle.c * rq - angle.s * old;
    return {real(1) + angle.c, angle.s};
}

__device__ inline Quaternion eigenvectors(const Columns& f) {
    real xx = dot(f.x, f.x), yy = dot(f.y, f.y), zz = dot(f.z, f.z);
    real xy = dot(f.x, f.y), yz = dot(f.y, f.z), zx = dot(f.z, f.x);
    Quaternion v = {1, 0, 0, 0};
#pragma unroll
    for (int sweep = 0; sweep < SWEEPS; ++sweep) {
        turn_xy(v, jacobi_rotate(xx, yy, xy, zx, yz));
        turn_yz(v, jacobi_rotate(yy, zz, yz, xy, zx));
        turn_zx(v, jacobi_rotate(zz, xx, zx, yz, xy));
    }
    return v;
}

// --- columns of F V ---------------------------------------------------------------------------------------------------

// Rotates a and b in their plane so that they are orthogonal and a is the longer. Returns half the angle.
__device__ inline Angle orthogonalise(real3& a, real3& b) {
    const real difference = dot(a, a) - dot(b, b);
    const JacobiAngle angle = jacobi_angle(difference, real(2) * dot(a, b));
    // c = 1 - s t with t the tangent of half the angle: written so, a small angle leaves lengths as they are.
    const real t = angle.s * accurate_reciprocal(real(1) + angle.c);
    const real3 turned_a = add_scaled(a, angle.s, add_scaled(b, -t, a));
    const real3 turned_b = add_scaled(b, -angle.s, add_scaled(a, t, b));
    const bool swap = difference < real(0);  // a quarter turn more
    a = select(swap, turned_b, turned_a);
    b = select(swap, scaled(turned_a, real(-1)), turned_b);
    return {swap ? real(1) - t : real(1), swap ? real(1) + t : t};
}

// The rotation that takes (a, b) to (|(a, b)|, 0), applied to both.
__device__ inline Angle givens(real& a, real& b) {
    const real size = fabs(a) + TINY;
    const real inverse = accurate_rsqrt(size * size + b * b);
    const Angle angle = {copysign(size, a) * inverse, b * inverse};
    a = angle.c * a + angle.s * b;
    b = 0;
    return angle;
}

__device__ inline void rotate(const Angle& angle, real& a, real& b) {
    const real old = a;
    a = angle.c * a + angle.s * b;
    b = angle.c * b - angle.s * old;
}

// In the ratio of cosine and sine of half an angle from (-pi, pi].
__device__ inline Angle half(const Angle& angle) {
    const real larger = real(1) + fabs(angle.c), smaller = fabs(angle.s);
    const bool obtuse = angle.c < real(0);
    return {obtuse ? smaller : larger, copysign(obtuse ? larger : smaller, angle.s)};
}

// Of a scaled matrix; returns its singular values.
__device__ inline real3 scaled_svd(const Columns& f, Quaternion& u, Quaternion& v) {
    v = eigenvectors(f);
    const Columns axes = rotation_matrix(v);
    real3 a = times(f, axes.x), b = times(f, axes.y), c = times(f, axes.z);

    turn_xy(v, orthogonalise(a, b));
    turn_xz(v, orthogonalise(a, c));
    turn_yz(v, orthogonalise(b, c));

    // QR. The columns are orthogonal, so what remains above the diagonal is rounding.
    u = {1, 0, 0, 0};
    const Angle first = givens(a.x, a.y);
    rotate(first, b.x, b.y);
    rotate(first, c.x, c.y);
    turn_xy(u, half(first));
    const Angle second = givens(a.x, a.z);
    rotate(second, b.x, b.z);
    rotate(second, c.x, c.z);
    turn_xz(u, half(second));
    const Angle third = givens(b.y, b.z);
    rotate(third, c.y, c.z);
    turn_yz(u, half(third));

    // Rounding may have put equal values in the wrong order.
    const real middle = min(b.y, a.x);
    return {a.x, middle, max(-middle, min(c.z, middle))};
}

// --- what kernels call ------------------------------------------------------------------------------------------------

// F = U diag(s) V^T
__device__ inline void polar_svd(Columns f, Columns& u, real3& s, Columns& v) {
    const Scale scale = prescale(f);
    Quaternion qu, qv;
    s = scale.undo(scaled_svd(f, qu, qv));
    u = rotation_matrix(scale.mark(qu));
    v = rotation_matrix(scale.mark(qv));
}

// F = R S
__device__ inline void polar_decomposition(Columns f, Columns& r, Symmetric& s) {
    const Scale scale = prescale(f);
    Quaternion qu, qv;
    const real3 values = scaled_svd(f, qu, qv);
    r = rotation_matrix(scale.mark(times_inverse(qu, qv)));
    const Columns v = rotation_matrix(qv);
    const real3 x = {v.x.x, v.y.x, v.z.x}, y = {v.x.y, v.y.y, v.z.y}, z = {v.x.z, v.y.z, v.z.z};  // rows
    const real3 sx = {values.x * x.x, values.y * x.y, values.z * x.z};
    const real3 sy = {values.x * y.x, values.y * y.y, values.z * y.z};
    const real3 sz = {values.x * z.x, values.y * z.y, values.z * z.z};
    s = {scale.undo(real3{dot(sx, x), dot(sy, y), dot(sz, z)}), scale.undo(real3{dot(sx, y), dot(sy, z), dot(sz, x)})};
}
