; Truncated Fourier, K codes for each of the SPADS of one core, where timestamps carry their SPAD's address in the bits
; above the ten of time. The chip of S.2 does not keep that address; a core that did would be fed like this.
; 16 SPADs x 8 codes x 16 bits beside the quarter wave fill the 4,096 bits of RAM to the last one.

.equ K, 8
.equ SPADS, 16
.equ QUARTER, 256
.equ TIME_BITS, 10

.table quarter, u8, QUARTER
.space codes, s16, SPADS * K
.reg p, r1
.reg t, r2
.reg u, r3
.reg place, r8

loop:   BNT  idle
        RDT  t
        MOV  place, t
.for n in 1..TIME_BITS / MAX_SHIFT
        SHR  place, place, #MAX_SHIFT
.end
.for n in 1..TIME_BITS % MAX_SHIFT             ; the rest, bit by bit
        SHR  place, place, #1
.end
        MUL  place, place, #2*K
        ADD  place, place, #codes
        ADD  u, t, #1                          ; the address above the time falls away in the phase modulo 1,024
        MOV  p, #0
.include "harmonics.s"
        JMP  loop

idle:   BFE  end
        JMP  loop

.equ SUMS, SPADS * K
.include "drain16.s"
