"""Audit of a dataset against its ledger: what is wrong, and what of it can be mended."""

from express50.dataset.audit.dataset import Audit, audit
from express50.dataset.audit.finding import Finding

__all__ = ["Audit", "Finding", "audit"]
