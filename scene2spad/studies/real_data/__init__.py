"""Find depth in captures of the LinoSPAD prototype (supplement S.4)."""
