"""Audit a dataset against its ledger: report what is wrong, and set aside what can be remade."""

from express50.dataset.audit.dataset import Audit, audit
from express50.dataset.audit.finding import Finding

__all__ = ["Audit", "Finding", "audit"]
