; Separable 256 x 2 x 2 with learned temporal codes: K x 256 bytes of table. One code is all that a core's RAM holds.

.equ K, 1

.table learned, s8, 256*K
.table weight, s8, K
.space codes, s16, 4*K
.reg t, r2
.reg c, r3
.reg place, r8

loop:   BNT  idle
        RDT  t
.include "block.s"
        AND  t, t, #255
.for k in 0..K - 1
        LDBS c, [learned + 256*k + t]
        ADDM [place + 2*k], c
.end
        JMP  loop

idle:   BFE  end
        JMP  loop

.include "sum2x2.s"
