"""Start Mitsuba on a working LLVM or on CUDA, and set how freed memory is kept."""
