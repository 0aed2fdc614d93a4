; Frame end of a block of cores of any size: every sum times this core's spatial weight of its code, added over the
; block, leaves the sensor from the core in the north-west. `sum2x2.s` is the same for 2 x 2 cores that go by their ID.
;
; A row's cores pass their part sums west, and the first column's then north. What a core takes and gives is told by a
; byte of its RAM, `ways`: bit 0 takes from the east, 1 gives to the west, 2 takes from the south, 3 gives to the north.
; Products and their sum are 32-bit words; one rounding by SHIFT bits follows, with HALF of a step added before it: as
; many bits as no sum of 16-bit numbers can need more than 16 afterwards. Without weights (WEIGHTED 0: a full tensor,
; whose tables hold them) the plain sums are added.
; Before it:  codes, SUMS of them, K, WEIGHTED, weight where that is 1, ways, SHIFT, HALF, and the register place.

.reg links, r1
.reg k, r2
.reg all, r3
.reg last, r4
.reg zero, r5
.reg a, r6
.reg b, r7

end:    LDB  links, [ways]
        MOV  place, #codes
        MOV  last, #codes + 2*SUMS
        MOV  all, #K
        MOV  zero, #0
block:  MOV  k, #0
code:   LDH  a, [place + 0]
.for n in 1..WEIGHTED
        LDBS b, [weight + k]
        MUL  a, a, b
.end
        STH  [place + 0], zero
        BBC  links, #0, row
        RECV b, east
        ADD  a, a, b
row:    BBS  links, #1, give_west
        BBC  links, #2, column
        RECV b, south
        ADD  a, a, b
column: BBS  links, #3, give_north
        ADD  a, a, #HALF
.for n in 1..SHIFT / MAX_SHIFT
        SAR  a, a, #MAX_SHIFT
.end
.for n in 1..(SHIFT % MAX_SHIFT + MAX_SHIFT - 1) / MAX_SHIFT
        SAR  a, a, #SHIFT % MAX_SHIFT          ; the rest
.end
        OUTH a
        JMP  done
give_north:
        SEND north, a
        JMP  done
give_west:
        SEND west, a
done:   ADD  place, place, #2
        ADD  k, k, #1
        BLT  k, all, code
        BLT  place, last, block
        HALT
