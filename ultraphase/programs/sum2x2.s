; Frame end of 2 x 2 cores: every sum times this core's spatial weight of its code, added over the four cores, leaves
; the sensor from the one in the north-west.
;
; A core has one weight a code, so that sum_n w c(t_n) = w sum_n c(t_n): once a frame instead of once a photon, and the
; same to the last bit. Products and their sum are 32-bit words; weights are in 1/128, so one rounding by 7 bits follows.
; Before it:  codes, weight, K, and the register place.

.reg id, r1
.reg k, r2
.reg all, r3
.reg last, r4
.reg zero, r5
.reg a, r6
.reg b, r7

end:    ID   id
        MOV  place, #codes
        MOV  last, #codes + 8*K
        MOV  all, #K
        MOV  zero, #0
block:  MOV  k, #0
code:   LDH  a, [place + 0]
        LDBS b, [weight + k]
        MUL  a, a, b
        STH  [place + 0], zero
        BBS  id, #0, give_west
        RECV b, east
        ADD  a, a, b
        BBS  id, #1, give_north
        RECV b, south
        ADD  a, a, b
        ADD  a, a, #64
        SAR  a, a, #4
        SAR  a, a, #3
        SATH a, a
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
