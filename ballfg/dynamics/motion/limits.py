"""Numbers that every integration and every search for a contact keeps to, in torch and in machine code."""

from typing import Final

MAX_STEP: Final = 0.02
"""s. Longer intervals are cut into equal steps. The error of a step of 0.02 s is 2e-9 m at 6 m/s, 2e-7 m at
20 m/s."""
SEARCH_STEPS: Final = 12
"""Upper bound on the search for a contact from a guess; one or two are enough for a contact within 20 ms."""
TIME_TOLERANCE: Final = 1e-13
"""s. The search stops when the bound on every contact time's error is below."""
GAP_TOLERANCE: Final = 1e-10
"""m. A grazing ball whose search stalled this close to the surface has touched it."""
TYPICAL_JERK: Final = 60.0
"""m/s^3, in the bound on the search's error."""
LEAST_FALL: Final = 1.0
"""m/s^2. The search takes a ball to fall at least as fast as this."""
LONGEST_FALL: Final = 20.0
"""s. A contact further away counts as none."""
BEYOND: Final = 0.3
"""s. A contact that lies further away than its interval's length and this is no continuation of it any more: NaN."""
MIN_SPEED: Final = 1e-6
"""m/s. Least normal speed that a Newton step divides by; a ball that grazes more gently is at its apex."""
