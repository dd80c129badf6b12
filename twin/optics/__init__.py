"""Light transport with Mitsuba and DrJit.

Importing this package starts the ray tracer: its array types exist only once a variant is chosen, and a working LLVM must be
found before DrJit looks for one itself.
"""

from twin.llvm import load_mitsuba

load_mitsuba()
