; Adds cos and sin of the phase p to two neighbouring 16-bit sums, place + 4 h - 4 and place + 4 h - 2, from one quarter
; of a cosine. Nine instructions in every quadrant. Stands in a loop over h, which only numbers sums and labels.
;
; Before it:  quarter, QUARTER, BIT, place, p and the registers i, a and b, as `harmonics.s` tells.

        AND  i, p, #QUARTER - 1
        LDB  a, [quarter + i]
        XOR  i, i, #QUARTER - 1
        LDB  b, [quarter + i]
        BBS  p, #BIT + 1, half{h}
        BBS  p, #BIT, second{h}
        ADDM [place + 4*h - 4], a              ; first quadrant: cos = a, sin = b
        ADDM [place + 4*h - 2], b
        JMP  next{h}
second{h}:
        SUBM [place + 4*h - 4], b
        ADDM [place + 4*h - 2], a
        JMP  next{h}
half{h}:
        BBS  p, #BIT, fourth{h}
        SUBM [place + 4*h - 4], a
        SUBM [place + 4*h - 2], b
        JMP  next{h}
fourth{h}:
        ADDM [place + 4*h - 4], b
        SUBM [place + 4*h - 2], a
        JMP  next{h}
next{h}:
