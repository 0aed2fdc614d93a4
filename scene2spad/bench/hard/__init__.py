"""State hard cases with a known answer, and the closed forms that give it."""
