"""The real-time loop: servo, safety filter, state machine, policy process and log."""
