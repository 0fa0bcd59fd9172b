"""What all tests share."""

from hypothesis import settings

# Machines that run tests are slow at times; a slow example is no defect.
settings.register_profile("pronk", deadline=None)
settings.load_profile("pronk")
