"""The UltraPhase in-pixel processor: assembler, cores, programs, proofs and power.

UltraPhase-constrained: the chip's published limits and costs, with an instruction set of our own (`chip.ASSUMPTIONS`).
"""

from ultraphase.array import CoreArray
from ultraphase.assembly.assembler import assemble, assemble_file
from ultraphase.assembly.program import Program, disassemble, listing
from ultraphase.catalog import Method, method
from ultraphase.chip import ChipSpec
from ultraphase.compiler import compile_code
from ultraphase.core import Core
from ultraphase.integer_code import IntegerCode
from ultraphase.products import Tabulated
from ultraphase.verify import verify

__all__ = [
    "ChipSpec",
    "Core",
    "CoreArray",
    "IntegerCode",
    "Method",
    "Program",
    "Tabulated",
    "assemble",
    "assemble_file",
    "compile_code",
    "disassemble",
    "listing",
    "method",
    "verify",
]
