"""LLVM text -> machine code of this processor, as object files that a disk cache can keep."""

from __future__ import annotations

import ctypes
import ctypes.util
import functools
from collections.abc import Sequence
from pathlib import Path

import llvmlite
import llvmlite.binding as llvm

from mpmbench.simt import cache

# Functions of the C library that compiled code may call where the processor has no instruction for them.
_LIBM = ("exp2", "log2", "sin", "cos", "tanh", "exp2f", "log2f", "sinf", "cosf", "tanhf", "fma", "fmaf")


@functools.cache
def _target() -> tuple[llvm.TargetMachine, str]:
    """The machine to compile for, and its description as part of cache keys."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    cpu = llvm.get_host_cpu_name()
    features = llvm.get_host_cpu_features().flatten()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=2, reloc="pic", codemodel="jitdefault"
    )
    _add_libm()
    version = ".".join(map(str, llvm.llvm_version_info))
    return machine, f"llvm {version} llvmlite {llvmlite.__version__} {cpu} {features}"


def _add_libm() -> None:
    library = ctypes.CDLL(ctypes.util.find_library("m"))
    for name in _LIBM:
        llvm.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)


@functools.cache
def machine_identity() -> str:
    """Everything besides the text that decides what machine code comes out."""
    return f"{_target()[1]} {cache.source_digest(Path(__file__).parent)}"


def compile_text(text: str) -> bytes:
    """LLVM text -> object file."""
    machine, _ = _target()
    module = llvm.parse_assembly(text)
    passes = llvm.create_new_module_pass_manager()
    passes.add_sroa_pass()
    passes.add_instruction_combine_pass()
    passes.add_simplify_cfg_pass()
    passes.add_aggressive_dce_pass()
    passes.run(module, llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2)))
    return machine.emit_object(module)


class LoadedCode:
    """An object file linked into this process."""

    def __init__(self, data: bytes) -> None:
        _target()
        # An execution engine takes over its target machine, so it gets one of its own.
        own = llvm.Target.from_default_triple().create_target_machine(
            cpu=llvm.get_host_cpu_name(),
            features=llvm.get_host_cpu_features().flatten(),
            reloc="pic",
            codemodel="jitdefault",
        )
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), own)
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(data))
        self._engine.finalize_object()

    def address(self, function: str) -> int:
        return self._engine.get_function_address(function)

    def export(self, functions: Sequence[str]) -> None:
        """Let objects that are loaded later call these functions."""
        for name in functions:
            llvm.add_symbol(name, self.address(name))
