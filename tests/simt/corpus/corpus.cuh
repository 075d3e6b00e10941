// Every kernel of the corpus reads the same three inputs and writes the same three outputs, so one test runs them all:
// ROOM values of each kind per thread. Kernels whose name starts with approx_ use functions that hardware approximates.
#define ROOM 32
#define KERNEL(name)                                                                                      \
    extern "C" __global__ void name(const float* __restrict__ fin, const double* __restrict__ din,        \
                                    const unsigned long long* __restrict__ uin, float* __restrict__ fout, \
                                    double* __restrict__ dout, unsigned long long* __restrict__ uout)
typedef unsigned long long u64;
typedef long long s64;
typedef unsigned int u32;
typedef unsigned short u16;
typedef unsigned char u8;
__device__ inline int thread_index() { return blockIdx.x * blockDim.x + threadIdx.x; }
