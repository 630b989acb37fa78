"""What all tests share."""

import os
import signal

from hypothesis import HealthCheck, settings

# As the command line has it; NumPy reads it when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A busy machine is no fault of what is tested: no example has a deadline, and none is too slow.
settings.register_profile(
    "untimed", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("untimed")

# A shell has its background jobs ignore Ctrl-C and Ctrl-\, and nohup the end of a terminal; what
# tests start and interrupt would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGHUP, signal.SIGQUIT):
    signal.signal(number, signal.SIG_DFL)
