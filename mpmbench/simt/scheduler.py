"""The memory that a launch shares with compiled code, and the compiled loop that runs thread blocks warp by warp.

A *job* is one launch: 64-bit fields that every warp sees. A *context* is one warp of the thread block that runs now.
Both are plain memory, laid out here and nowhere else. The loop is LLVM text and becomes part of the kernel's object
file, so that a cached kernel starts without compiling anything.
"""

from __future__ import annotations

# Fields of a job, eight bytes each, in order.
JOB_FIELDS = (
    "contexts",  # address of the first context
    "warps",  # warps per thread block
    "threads",  # threads per thread block
    "grid_x",
    "grid_y",
    "grid_z",
    "block_x",
    "block_y",
    "block_z",
    "shared",  # address of the shared memory of the thread block that runs
    "shared_bytes",  # static and dynamic
    "dynamic_bytes",  # dynamic alone
    "params",  # address of the parameter block
    "local",  # address of the local memory of the thread block's threads
    "local_end",
    "sink",  # middle of an area that dead lanes access instead
    "variables",  # address of a table of the module variables' addresses
    "budget",  # warp instructions that backward branches may still spend
    "counters",  # address of the counters
    "block",  # number of the thread block that runs
    "epoch",  # grows with every block barrier released and every thread block started (debug)
    "random",  # state of the warp order (debug)
    "check",  # address of the access check (debug)
    "check_data",  # its own data (debug)
    "stop_warp",  # where a fault stopped the launch: warp in its block,
    "stop_segment",  # and segment of the kernel
    "order",  # scratch: ready warps (debug)
    "stranded",  # thread blocks in which some warps ended while others waited at a barrier (debug)
    "stranded_segment",
    "segments",  # address of a table: cycles and issue slots of each segment (profile)
    "cas_trip",  # cycles of one round of a float atomic in shared memory,
    "cas_issue",  # and what it takes of the issue slots (profile)
    # Votes of reducing barriers (lanes that hold the predicate, lanes that arrived), three barriers in rotation: while
    # one is read and the next is filled, the third is cleared.
    "votes_0",
    "arrived_0",
    "votes_1",
    "arrived_1",
    "votes_2",
    "arrived_2",
    "stranded_block",  # first thread block that was stranded,
    "stranded_waiting",  # and its warps that waited, as bits (debug)
    "mixed",  # barriers at which warps of a thread block waited in different places (debug),
    "mixed_block",
    "mixed_segment",
    "mixed_other",
    "split_mask",  # where lanes part, they do so in the unusual order if these bits of ``random`` are zero (debug)
    "wake_last",  # scratch: where the warp waited that was woken last, or -1 (debug)
)
JOB = {name: 8 * position for position, name in enumerate(JOB_FIELDS)}
JOB_BYTES = 8 * len(JOB_FIELDS)

# Fields of a context, in bytes.
CONTEXT_RESUME = 0  # i32: segment to go on with; 0 starts the kernel
CONTEXT_LIVE = 4  # i32: lanes that have not ended
CONTEXT_STATE = 8  # i32: READY, WAITING or ENDED
CONTEXT_WARP = 12  # i32: number in the block
CONTEXT_CTAID = 16  # 3 x i32
CONTEXT_BARRIER = 28  # i32: segment of the barrier it waits at
CONTEXT_WARP_EPOCH = 32  # i64: grows with every barrier that orders this warp's own lanes (debug)
CONTEXT_REDUCTIONS = 40  # i64: reducing barriers that the warp has arrived at in this thread block
CONTEXT_WAITED = 48  # i32: lanes that others have waited for and that have not come yet
CONTEXT_STUCK = 52  # i32: status to end with if those never come,
CONTEXT_STUCK_SEGMENT = 56  # i32: and the segment where the others wait
CONTEXT_SET_ASIDE = 60  # i16: whether a random choice has put lanes off (debug)
CONTEXT_FENCED = 62  # i16: whether the warp has passed a fence since its last plain store to global memory (debug)
CONTEXT_TID = 64  # 3 x 32 x i32
CONTEXT_CLOCK = CONTEXT_TID + 3 * 128  # i64: cycles that the warp's instructions took, waits for memory apart (profile)
CONTEXT_TRACE = CONTEXT_CLOCK + 8  # i64: where its next request is recorded (profile),
CONTEXT_TRACE_LIMIT = CONTEXT_TRACE + 8  # i64: and from where on it should stop at the next backward branch
CONTEXT_ISSUE = (
    CONTEXT_TRACE_LIMIT + 8
)  # i64: what its instructions took of the SM's issue slots, in ISSUE_UNITS (profile)
CONTEXT_SHARED = CONTEXT_ISSUE + 8  # i64: cycles of the shared-memory pipe that it took (profile)
CONTEXT_SLOTS = CONTEXT_CLOCK + 64  # what the code generator lays out: pending masks, registers

READY, WAITING, ENDED = 0, 1, 2

# What a warp's code returns.
STATUS_BARRIER = 1
STATUS_ENDED = 2
STATUS_YIELD = 3
FAULT_DIVERGENT_BARRIER = 4
FAULT_BUDGET = 5
FAULT_TRAP = 6
FAULT_MASK = 7
FIRST_FAULT = FAULT_DIVERGENT_BARRIER

ISSUE_UNITS = 1024  # parts of a cycle, fixed point
NEVER_SPLIT = -1  # split masks: the state of the generator is never zero;
OFTEN_SPLIT = 1 << 40  # every other parting

POISON = 0xFF  # 0xFFFFFFFF is a NaN, as a number it is -1


def _context_fields(count: str = "%w") -> str:
    return f"""  %context.at = mul i64 {count}, %stride
  %context.address = add i64 %contexts, %context.at
  %context = inttoptr i64 %context.address to ptr"""


def launch_text(context_bytes: int, hardware_ftz: bool, debug: bool) -> str:
    """LLVM text of ``i32 @launch(ptr job)``: 0, or the status of the fault that stopped the launch."""
    loads = "\n".join(
        f"  %{name}.field = getelementptr i8, ptr %job, i64 {JOB[name]}\n  %{name} = load i64, ptr %{name}.field"
        for name in ("contexts", "warps", "threads", "grid_x", "grid_y", "grid_z", "shared", "shared_bytes")
    )
    body = _RANDOM_ROUND if debug else _PLAIN_ROUND
    fields = {name: str(offset) for name, offset in JOB.items()}
    for name, value in fields.items():
        body = body.replace(f"@{name}@", value)
    enter, leave = _flushing_mode(hardware_ftz)  # for the whole launch
    poison = _POISON_BLOCK if debug else "  br label %round\n"
    return f"""
define i32 @launch(ptr noalias %job) {{
entry:
{enter}{loads}
  %stride = add i64 0, {context_bytes}
  %grid_xy = mul i64 %grid_x, %grid_y
  %blocks = mul i64 %grid_xy, %grid_z
  %block.field = getelementptr i8, ptr %job, i64 {JOB["block"]}
  %epoch.field = getelementptr i8, ptr %job, i64 {JOB["epoch"]}
  %none = icmp eq i64 %blocks, 0
  br i1 %none, label %done, label %block.next

block.next:
  %b = phi i64 [ 0, %entry ], [ %b.after, %block.ended ]
  store i64 %b, ptr %block.field
  %votes.field = getelementptr i8, ptr %job, i64 {JOB["votes_0"]}
  %arrived.field = getelementptr i8, ptr %job, i64 {JOB["arrived_0"]}
  store i64 0, ptr %votes.field
  store i64 0, ptr %arrived.field
  %epoch.old = load i64, ptr %epoch.field
  %epoch.new = add i64 %epoch.old, 1
  store i64 %epoch.new, ptr %epoch.field
  %b.x = urem i64 %b, %grid_x
  %b.row = udiv i64 %b, %grid_x
  %b.y = urem i64 %b.row, %grid_y
  %b.z = udiv i64 %b, %grid_xy
  %ctaid.x = trunc i64 %b.x to i32
  %ctaid.y = trunc i64 %b.y to i32
  %ctaid.z = trunc i64 %b.z to i32
  br label %start

start:
  %w.start = phi i64 [ 0, %block.next ], [ %w.start.next, %start ]
  %start.at = mul i64 %w.start, %stride
  %start.address = add i64 %contexts, %start.at
  %start.context = inttoptr i64 %start.address to ptr
  %start.live = getelementptr i8, ptr %start.context, i64 {CONTEXT_LIVE}
  %start.state = getelementptr i8, ptr %start.context, i64 {CONTEXT_STATE}
  %start.x = getelementptr i8, ptr %start.context, i64 {CONTEXT_CTAID}
  %start.y = getelementptr i8, ptr %start.context, i64 {CONTEXT_CTAID + 4}
  %start.z = getelementptr i8, ptr %start.context, i64 {CONTEXT_CTAID + 8}
  %first.thread = shl i64 %w.start, 5
  %threads.left = sub i64 %threads, %first.thread
  %is.full = icmp sge i64 %threads.left, 32
  %tail.left = trunc i64 %threads.left to i32
  %tail.shift = and i32 %tail.left, 31
  %tail.bit = shl i32 1, %tail.shift
  %tail.mask = sub i32 %tail.bit, 1
  %live = select i1 %is.full, i32 -1, i32 %tail.mask
  %start.reductions = getelementptr i8, ptr %start.context, i64 {CONTEXT_REDUCTIONS}
  store i64 0, ptr %start.reductions
  %start.flags = getelementptr i8, ptr %start.context, i64 {CONTEXT_SET_ASIDE}
  store i32 0, ptr %start.flags
  store i32 0, ptr %start.context
  store i32 %live, ptr %start.live
  store i32 {READY}, ptr %start.state
  store i32 %ctaid.x, ptr %start.x
  store i32 %ctaid.y, ptr %start.y
  store i32 %ctaid.z, ptr %start.z
  %w.start.next = add i64 %w.start, 1
  %more = icmp ult i64 %w.start.next, %warps
  br i1 %more, label %start, label %poisoning

poisoning:
{poison}
{body}
block.ended:
  %b.after = add i64 %b, 1
  %more.blocks = icmp ult i64 %b.after, %blocks
  br i1 %more.blocks, label %block.next, label %done

fault:
  %fault.warp = getelementptr i8, ptr %job, i64 {JOB["stop_warp"]}
  store i64 %w, ptr %fault.warp
{leave}  ret i32 %status

done:
{leave}  ret i32 0
}}
declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)
"""


def resume_text(hardware_ftz: bool) -> str:
    """LLVM text of ``i32 @resume(ptr context, ptr job)``: one warp until it stops, for a scheduler outside."""
    enter, leave = _flushing_mode(hardware_ftz)
    return f"""
define i32 @resume(ptr noalias align 64 %context, ptr noalias %job) {{
entry:
{enter}  %status = call i32 @warp(ptr %context, ptr %job)
{leave}  ret i32 %status
}}
"""


def _flushing_mode(hardware_ftz: bool) -> tuple[str, str]:
    """FTZ (bit 15) and DAZ (bit 6) of MXCSR: code that sets them, and that puts back what was there."""
    if not hardware_ftz:
        return "", ""
    enter = """  %mode.saved = alloca i32
  %mode.new = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %mode.saved)
  %mode = load i32, ptr %mode.saved
  %mode.flush = or i32 %mode, 32832
  store i32 %mode.flush, ptr %mode.new
  call void @llvm.x86.sse.ldmxcsr(ptr %mode.new)
"""
    return enter, "  call void @llvm.x86.sse.ldmxcsr(ptr %mode.saved)\n"


_POISON_BLOCK = f"""  %shared.start = inttoptr i64 %shared to ptr
  call void @llvm.memset.p0.i64(ptr %shared.start, i8 {POISON - 256}, i64 %shared_bytes, i1 false)
  br label %round
"""

# Warps in order, each to its next barrier or its end; a round in which all have arrived releases them together.
_PLAIN_ROUND = f"""
round:
  br label %warp.next

warp.next:
  %w = phi i64 [ 0, %round ], [ %w.next, %warp.done ]
  %running = phi i64 [ 0, %round ], [ %running.next, %warp.done ]
{_context_fields()}
  %state.field = getelementptr i8, ptr %context, i64 {CONTEXT_STATE}
  %state = load i32, ptr %state.field
  %is.ended = icmp eq i32 %state, {ENDED}
  br i1 %is.ended, label %warp.done, label %warp.run

warp.run:
  %status = call i32 @warp(ptr %context, ptr %job)
  %is.fault = icmp uge i32 %status, {FIRST_FAULT}
  br i1 %is.fault, label %fault, label %warp.stopped

warp.stopped:
  %now.ended = icmp eq i32 %status, {STATUS_ENDED}
  %new.state = select i1 %now.ended, i32 {ENDED}, i32 {READY}
  store i32 %new.state, ptr %state.field
  %one.more = select i1 %now.ended, i64 0, i64 1
  br label %warp.done

warp.done:
  %arrived = phi i64 [ 0, %warp.next ], [ %one.more, %warp.stopped ]
  %running.next = add i64 %running, %arrived
  %w.next = add i64 %w, 1
  %more.warps = icmp ult i64 %w.next, %warps
  br i1 %more.warps, label %warp.next, label %round.done

round.done:
  %again = icmp ne i64 %running.next, 0
  br i1 %again, label %round, label %block.ended
"""

# Any ready warp, chosen by a xorshift generator, runs to its next shared access, barrier or end. When none is ready,
# the barrier opens; warps that had ended by then never arrived at it.
_RANDOM_ROUND = f"""
round:
  br label %look

look:
  %look.w = phi i64 [ 0, %round ], [ %look.next, %look.done ]
  %ready = phi i64 [ 0, %round ], [ %ready.next, %look.done ]
  %ended = phi i64 [ 0, %round ], [ %ended.next, %look.done ]
  %look.at = mul i64 %look.w, %stride
  %look.address = add i64 %contexts, %look.at
  %look.context = inttoptr i64 %look.address to ptr
  %look.field = getelementptr i8, ptr %look.context, i64 {CONTEXT_STATE}
  %look.state = load i32, ptr %look.field
  %look.ready = icmp eq i32 %look.state, {READY}
  br i1 %look.ready, label %look.note, label %look.done

look.note:
  %order.field = getelementptr i8, ptr %job, i64 @order@
  %order.address = load i64, ptr %order.field
  %order = inttoptr i64 %order.address to ptr
  %order.slot = getelementptr i64, ptr %order, i64 %ready
  store i64 %look.w, ptr %order.slot
  br label %look.done

look.done:
  %ready.one = zext i1 %look.ready to i64
  %ready.next = add i64 %ready, %ready.one
  %look.ended = icmp eq i32 %look.state, {ENDED}
  %ended.one = zext i1 %look.ended to i64
  %ended.next = add i64 %ended, %ended.one
  %look.next = add i64 %look.w, 1
  %look.more = icmp ult i64 %look.next, %warps
  br i1 %look.more, label %look, label %looked

looked:
  %all.ended = icmp eq i64 %ended.next, %warps
  br i1 %all.ended, label %block.ended, label %pick

pick:
  %any.ready = icmp ne i64 %ready.next, 0
  br i1 %any.ready, label %choose, label %release

choose:
  %random.field = getelementptr i8, ptr %job, i64 @random@
  %random.0 = load i64, ptr %random.field
  %random.a = shl i64 %random.0, 13
  %random.1 = xor i64 %random.0, %random.a
  %random.b = lshr i64 %random.1, 7
  %random.2 = xor i64 %random.1, %random.b
  %random.c = shl i64 %random.2, 17
  %random.3 = xor i64 %random.2, %random.c
  store i64 %random.3, ptr %random.field
  %random.high = lshr i64 %random.3, 11
  %chosen = urem i64 %random.high, %ready.next
  %chosen.field = getelementptr i8, ptr %job, i64 @order@
  %chosen.order.address = load i64, ptr %chosen.field
  %chosen.order = inttoptr i64 %chosen.order.address to ptr
  %chosen.slot = getelementptr i64, ptr %chosen.order, i64 %chosen
  %w = load i64, ptr %chosen.slot
{_context_fields()}
  %status = call i32 @warp(ptr %context, ptr %job)
  %is.fault = icmp uge i32 %status, {FIRST_FAULT}
  br i1 %is.fault, label %fault, label %stopped

stopped:
  %state.field = getelementptr i8, ptr %context, i64 {CONTEXT_STATE}
  %now.ended = icmp eq i32 %status, {STATUS_ENDED}
  %now.waiting = icmp eq i32 %status, {STATUS_BARRIER}
  %state.wait = select i1 %now.waiting, i32 {WAITING}, i32 {READY}
  %state.new = select i1 %now.ended, i32 {ENDED}, i32 %state.wait
  store i32 %state.new, ptr %state.field
  br label %round

release:
  %epoch.before = load i64, ptr %epoch.field
  %epoch.after = add i64 %epoch.before, 1
  store i64 %epoch.after, ptr %epoch.field
  %some.ended = icmp ne i64 %ended.next, 0
  br i1 %some.ended, label %strand, label %wake.start

strand:
  %stranded.field = getelementptr i8, ptr %job, i64 @stranded@
  %stranded.old = load i64, ptr %stranded.field
  %stranded.new = add i64 %stranded.old, 1
  store i64 %stranded.new, ptr %stranded.field
  %stranded.block.field = getelementptr i8, ptr %job, i64 @stranded_block@
  %stranded.block.old = load i64, ptr %stranded.block.field
  %stranded.first = icmp eq i64 %stranded.old, 0
  %stranded.block.new = select i1 %stranded.first, i64 %b, i64 %stranded.block.old
  store i64 %stranded.block.new, ptr %stranded.block.field
  br label %wake.start

wake.start:
  %wake.first = phi i1 [ false, %release ], [ %stranded.first, %strand ]
  %wake.last.field = getelementptr i8, ptr %job, i64 @wake_last@
  store i64 -1, ptr %wake.last.field
  br label %wake

wake:
  %wake.w = phi i64 [ 0, %wake.start ], [ %wake.next, %wake.done ]
  %wake.at = mul i64 %wake.w, %stride
  %wake.address = add i64 %contexts, %wake.at
  %wake.context = inttoptr i64 %wake.address to ptr
  %wake.field = getelementptr i8, ptr %wake.context, i64 {CONTEXT_STATE}
  %wake.state = load i32, ptr %wake.field
  %wake.waits = icmp eq i32 %wake.state, {WAITING}
  br i1 %wake.waits, label %wake.up, label %wake.done

wake.up:
  store i32 {READY}, ptr %wake.field
  %wake.barrier.field = getelementptr i8, ptr %wake.context, i64 {CONTEXT_BARRIER}
  %wake.barrier = load i32, ptr %wake.barrier.field
  %wake.segment = zext i32 %wake.barrier to i64
  %stranded.segment.field = getelementptr i8, ptr %job, i64 @stranded_segment@
  %wake.kept = load i64, ptr %stranded.segment.field
  %wake.noted = select i1 %some.ended, i64 %wake.segment, i64 %wake.kept
  store i64 %wake.noted, ptr %stranded.segment.field
  %wake.waiting.field = getelementptr i8, ptr %job, i64 @stranded_waiting@
  %wake.waiting.old = load i64, ptr %wake.waiting.field
  %wake.bit = shl i64 1, %wake.w
  %wake.bit.kept = select i1 %wake.first, i64 %wake.bit, i64 0
  %wake.waiting = or i64 %wake.waiting.old, %wake.bit.kept
  store i64 %wake.waiting, ptr %wake.waiting.field
  %wake.last = load i64, ptr %wake.last.field
  store i64 %wake.segment, ptr %wake.last.field
  %wake.any = icmp ne i64 %wake.last, -1
  %wake.differs = icmp ne i64 %wake.last, %wake.segment
  %wake.mixed = and i1 %wake.any, %wake.differs
  br i1 %wake.mixed, label %wake.mix, label %wake.done

wake.mix:
  %mixed.field = getelementptr i8, ptr %job, i64 @mixed@
  %mixed.old = load i64, ptr %mixed.field
  %mixed.new = add i64 %mixed.old, 1
  store i64 %mixed.new, ptr %mixed.field
  %mixed.block.field = getelementptr i8, ptr %job, i64 @mixed_block@
  store i64 %b, ptr %mixed.block.field
  %mixed.segment.field = getelementptr i8, ptr %job, i64 @mixed_segment@
  store i64 %wake.segment, ptr %mixed.segment.field
  %mixed.other.field = getelementptr i8, ptr %job, i64 @mixed_other@
  store i64 %wake.last, ptr %mixed.other.field
  br label %wake.done

wake.done:
  %wake.next = add i64 %wake.w, 1
  %wake.more = icmp ult i64 %wake.next, %warps
  br i1 %wake.more, label %wake, label %round
"""
