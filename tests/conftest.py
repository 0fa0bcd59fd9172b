"""What all tests share."""

import signal

from hypothesis import settings

# Machines that run tests are slow at times; a slow example is no defect.
settings.register_profile("pronk", deadline=None)
settings.load_profile("pronk")

# What is started in the background, or by nohup, ignores these, and so would all it starts.
for number, usual in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGQUIT, signal.SIG_DFL),
    (signal.SIGHUP, signal.SIG_DFL),
):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, usual)
