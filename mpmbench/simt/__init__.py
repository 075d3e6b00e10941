"""A CUDA PTX engine for the CPU: compile PTX, launch kernels warp by warp, get outputs, counters and findings."""
