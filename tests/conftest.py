"""What all tests share."""

from hypothesis import settings

# A busy machine is no fault of what is tested: no example has a deadline.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")
