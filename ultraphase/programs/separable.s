; Separable 256 x 2 x 2: K temporal codes (truncated Fourier of 256 bins, from a quarter wave of 64 bytes) for each of
; the four blocks of 256 bins, and learned spatial weights, one a code and core, used at the frame's end.

.equ K, 16
.equ QUARTER, 64

.table quarter, u8, QUARTER
.table weight, s8, K
.space codes, s16, 4*K
.reg p, r1
.reg t, r2
.reg u, r3
.reg place, r8

loop:   BNT  idle
        RDT  t
        ADD  u, t, #1
        MOV  p, #0                             ; h t modulo 256 depends on t modulo 256 alone: no mask
.include "block.s"
.include "harmonics.s"
        JMP  loop

idle:   BFE  end
        JMP  loop

.include "sum2x2.s"
