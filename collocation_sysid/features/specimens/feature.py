"""Likely errors in the description of homogeneous specimens."""

from __future__ import annotations

from ..feature import Feature
from .hypotheses import find_specimen_misspecifications

SPECIMENS = Feature(fit_hypotheses=find_specimen_misspecifications)
