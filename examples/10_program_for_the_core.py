# %% [markdown]
# # 10 A program for the core in the pixel
# The core reads timestamps one by one. This program counts them in 16 coarse bins of 64 fine ones.

# %%
import numpy as np

import scene2spad as s2s

SOURCE = """
.space codes, u8, 16
.reg bin, r1
.reg count, r2
.reg last, r3

loop:   BNT  idle                  ; no timestamp waits
        RDT  bin
        SHR  bin, bin, #4
        SHR  bin, bin, #2          ; the coarse bin, timestamp / 64
        LDB  count, [codes + bin]
        ADD  count, count, #1
        SATB count, count          ; stays at 255
        STB  [codes + bin], count
        JMP  loop
idle:   BFE  end                   ; the frame ends
        JMP  loop
end:    MOV  bin, #0
        MOV  last, #16
drain:  LDB  count, [codes + bin]
        OUTB count
        ADD  bin, bin, #1
        BLT  bin, last, drain
        HALT
"""
program = s2s.assemble(SOURCE)
print(len(program.words), "instructions,", program.ram_bits // 8, "bytes of RAM")

# %%
timestamps = np.random.default_rng(10).normal(500, 60, 200).astype(int)
core = s2s.Core(program)
core.start(timestamps)
core.run()
print("out:", list(core.out))
print("right:", np.bincount(timestamps // 64, minlength=16).tolist() == list(core.out))
