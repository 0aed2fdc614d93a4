; Truncated Fourier, K codes of 1,024 bins, from a quarter wave of 256 bytes.

.equ K, 16
.equ QUARTER, 256

.table quarter, u8, QUARTER
.space codes, s16, K
.equ place, codes
.reg p, r1
.reg t, r2
.reg u, r3

loop:   BNT  idle
        RDT  t
        ADD  u, t, #1
        MOV  p, #0
.include "harmonics.s"
        JMP  loop

idle:   BFE  end
        JMP  loop

.equ SUMS, K
.include "drain16.s"
