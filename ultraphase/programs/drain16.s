; Frame end of one core: SUMS numbers of 16 bits from `codes` on leave the sensor, and start again at 0.

.reg number, r5
.reg at, r6
.reg last, r7
.reg zero, r9

end:    MOV  at, #0
        MOV  last, #2*SUMS
        MOV  zero, #0
drain:  LDH  number, [codes + at]
        OUTH number
        STH  [codes + at], zero
        ADD  at, at, #2
        BLT  at, last, drain
        HALT
