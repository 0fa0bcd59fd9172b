"""Estimate the frequency response of each joint from a log."""

from pronk.identify.response.estimate import estimate, operators
from pronk.identify.response.h1 import H1Operator
from pronk.identify.response.response import Estimator, FrequencyResponse, load, save

__all__ = ["Estimator", "FrequencyResponse", "H1Operator", "estimate", "load", "operators", "save"]
