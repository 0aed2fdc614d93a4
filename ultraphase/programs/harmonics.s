; Adds cos and sin of harmonics 1 .. K/2 at time t to 16-bit sums, from one quarter of a cosine.
;
; Before it:  QUARTER   entries of the table: cos(2 pi (i + 1/2) / (4 QUARTER)), a power of two
;             place     where the sums are: a constant address or a register
;             t, u      two registers in a row: the time in bins, and t + 1
;             p         a register that holds 0
;
; Harmonic h at the bin's centre has phase h (t + 1/2), counted in 4 QUARTER steps a turn. p = h t + floor(h / 2) and the
; table's own half step make that exact for odd h, and half a step late for even h. The two top bits of p are its
; quadrant. In each the table is read forwards (a) and backwards (b): thanks to the half step, backwards is
; QUARTER - 1 - i for every i, so that there is no special case on the axes, where (QUARTER - i) would leave the table.
;
; Ten instructions a harmonic in all four quadrants: the last JMP makes the fourth as long as the others, so that
; the time a photon takes does not depend on when it came.

.equ BIT, 6 + (QUARTER / 256) * 2              ; lower of the two quadrant bits: log2 of QUARTER, 64 or 256
.reg i, r5
.reg a, r6
.reg b, r7

.for h in 1..K/2
        .reg step, t + (h + 1) % 2             ; t for odd h, u = t + 1 for even h
        ADD  p, p, step
.include "harmonic.s"
.end
