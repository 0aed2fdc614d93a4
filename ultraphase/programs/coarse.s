; Coarse histogram of K bins with 8-bit counters that stay at 255.
;
; The timestamp without its low SHIFT bits is the counter's address.

.equ K, 16
.equ SHIFT, 6
.equ STEP, MAX_SHIFT                           ; bits that one instruction shifts by
.equ STEPS, (SHIFT + STEP - 1) / STEP

.space codes, u8, K
.reg bin, r1
.reg count, r2
.reg last, r3
.reg zero, r4

loop:   BNT  idle
        RDT  bin
.for n in 1..STEPS - 1
        SHR  bin, bin, #STEP
.end
        SHR  bin, bin, #SHIFT - STEP * (STEPS - 1)
        LDB  count, [codes + bin]
        ADD  count, count, #1
        SATB count, count
        STB  [codes + bin], count
        JMP  loop

idle:   BFE  end
        JMP  loop

end:    MOV  bin, #0                           ; the frame leaves, and the counters start again at 0
        MOV  last, #K
        MOV  zero, #0
drain:  LDB  count, [codes + bin]
        OUTB count
        STB  [codes + bin], zero
        ADD  bin, bin, #1
        BLT  bin, last, drain
        HALT
