// Idea: one pass. A thread block scans its segment by shuffles and publishes its sum; then it looks back over the
// segments before it, adding their sums until it meets one that already knows everything before itself. So each value is
// read once and written once, whatever the length.
// A thread block owns the segment on its ticket; tickets are drawn in the order in which thread blocks start, so that
// whoever is waited for is already running. A warp owns RUNS runs of 128 neighbouring values, a thread four of each run.
// state: the ticket and one 64-bit word per segment, all zero before the launch.
// Constants: RUNS, and those of scan.cuh. Shared memory: one integer per warp and two more.
#include "scan.cuh"

constexpr int WARPS = GROUP / WARP;
constexpr int RUN = 4 * WARP;  // values that a warp reads at once
constexpr int SEGMENT = WARPS * RUNS * RUN;

// What a segment has published: its status and a sum, in one word, so that no fence is needed between them.
using State = unsigned long long;
constexpr int NOTHING = 0;  // yet
constexpr int SUM = 1;      // of the segment alone
constexpr int PREFIX = 2;   // of the segment and all before it

__device__ inline void publish(State* state, int status, int sum) {
    *static_cast<volatile State*>(state) = State(status) << 32 | unsigned(sum);
}
__device__ inline int status_of(State word) { return int(word >> 32); }
__device__ inline int sum_in(State word) { return int(unsigned(word)); }

// Sum of all segments before this one, in lane 0. One warp: lane l looks at the l-th segment back.
__device__ inline int look_back(State* states, int segment, int lane) {
    int before = 0;
    for (int nearest = segment - 1;; nearest -= WARP) {
        const int other = nearest - lane;
        State word;
        do {
            // In front of the first segment everything is known: nothing.
            word = other < 0 ? State(PREFIX) << 32 : static_cast<volatile State*>(states)[other];
        } while (__any_sync(ALL_LANES, status_of(word) == NOTHING));
        const unsigned known = __ballot_sync(ALL_LANES, status_of(word) == PREFIX);
        const int last = known ? __ffs(known) - 1 : WARP - 1;
        before += warp_reduce<Add>(lane <= last ? sum_in(word) : 0);
        if (known) return before;
    }
}

extern "C" __global__ void __launch_bounds__(GROUP) scan_lookback(
    const int count, const int* __restrict__ values, int* __restrict__ scanned, int* state) {
    __shared__ int warp_sums[WARPS];
    __shared__ int own_ticket;
    __shared__ int before_segment;

    const int lane = threadIdx.x % WARP;
    const int warp = threadIdx.x / WARP;
    State* states = reinterpret_cast<State*>(state + 2);  // after the ticket and a place for alignment
    if (threadIdx.x == 0) own_ticket = atomicAdd(state, 1);
    __syncthreads();
    const int segment = own_ticket;
    const int first = segment * SEGMENT + warp * (RUNS * RUN) + 4 * lane;

    int4 four[RUNS];
    int before[RUNS];  // sums of the warp's values before this thread's four
    int warp_sum = 0;
#pragma unroll
    for (int r = 0; r < RUNS; ++r) four[r] = four_at(values, count, first + r * RUN);
#pragma unroll
    for (int r = 0; r < RUNS; ++r) {
        const int up_to_here = warp_inclusive_scan<Add>(sum_of(four[r]), lane);
        before[r] = warp_sum + up_to_here - sum_of(four[r]);
        warp_sum += __shfl_sync(ALL_LANES, up_to_here, WARP - 1);
    }
    if (lane == 0) warp_sums[warp] = warp_sum;
    __syncthreads();
    if (warp == 0) {
        const int sum = scan_warp_sums<WARPS>(warp_sums, lane);
        if (lane == 0 && segment > 0) publish(states + segment, SUM, sum);
        const int all_before = segment > 0 ? look_back(states, segment, lane) : 0;
        if (lane == 0) {
            publish(states + segment, PREFIX, all_before + sum);
            before_segment = all_before;
        }
    }
    __syncthreads();
    const int before_warp = before_segment + warp_sums[warp];
#pragma unroll
    for (int r = 0; r < RUNS; ++r) store_scanned(scanned, count, first + r * RUN, four[r], before_warp + before[r]);
}
