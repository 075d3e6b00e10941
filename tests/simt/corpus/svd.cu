// Singular values of a 3 x 3 matrix by Jacobi rotations: a long straight-line kernel with data-dependent exits.
#include "corpus.cuh"

__device__ void rotate(float (&s)[3][3], int p, int q) {
    if (fabsf(s[p][q]) < 1e-12f) return;
    float theta = (s[q][q] - s[p][p]) / (2.0f * s[p][q]);
    float t = copysignf(1.0f, theta) / (fabsf(theta) + sqrtf(theta * theta + 1.0f));
    float c = rsqrtf(t * t + 1.0f), r = t * c;
    for (int k = 0; k < 3; ++k) {
        float a = s[k][p], b = s[k][q];
        s[k][p] = c * a - r * b;
        s[k][q] = r * a + c * b;
    }
    for (int k = 0; k < 3; ++k) {
        float a = s[p][k], b = s[q][k];
        s[p][k] = c * a - r * b;
        s[q][k] = r * a + c * b;
    }
}

KERNEL(approx_svd) {
    int i = thread_index();
    float m[3][3], s[3][3];
    for (int a = 0; a < 9; ++a) m[a / 3][a % 3] = __sinf((float)(i * 9 + a)) + (a % 4 == 0);
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) s[a][b] = m[0][a] * m[0][b] + m[1][a] * m[1][b] + m[2][a] * m[2][b];
    for (int sweep = 0; sweep < 6; ++sweep) {
        float off = s[0][1] * s[0][1] + s[0][2] * s[0][2] + s[1][2] * s[1][2];
        if (off < 1e-14f) break;
        rotate(s, 0, 1);
        rotate(s, 0, 2);
        rotate(s, 1, 2);
    }
    float a = s[0][0], b = s[1][1], c = s[2][2];
    fout[i * ROOM] = sqrtf(fmaxf(fmaxf(a, b), fmaxf(c, 0.0f)));
    fout[i * ROOM + 1] = sqrtf(fmaxf(fminf(fminf(a, b), c), 0.0f));
    fout[i * ROOM + 2] = a + b + c;
}
