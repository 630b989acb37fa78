"""Settings of all tests."""

import os
import signal

from hypothesis import HealthCheck, settings

# As in the command line; NumPy reads it when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# On a busy machine examples take longer: none has a deadline, and none is too slow.
settings.register_profile(
    "untimed", max_examples=50, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("untimed")

# Background jobs of a shell ignore Ctrl-C and Ctrl-\, and jobs under nohup a hangup; processes that
# tests start and interrupt would inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGHUP, signal.SIGQUIT):
    signal.signal(number, signal.SIG_DFL)
