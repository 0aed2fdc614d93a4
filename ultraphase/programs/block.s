; place = address of the sums of the block of 256 bins that t falls into: codes + 2 K (t / 256), by its bits 8 and 9.

        MOV  place, #codes
        BBC  t, #8, even
        ADD  place, place, #2*K
even:   BBC  t, #9, early
        ADD  place, place, #4*K
early:
