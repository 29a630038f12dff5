"""Records of an audit."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Says what is wrong, where, and how to fix it.

    Attributes:
        kind: one word for programs, such as ``missing`` or ``changed``.
        where: ``stage item``, or a file of the dataset.
        what: is wrong, in words.
        fix: how it was fixed, or how to fix it.
        fixed: True once nothing is left to do but to run the stage.
    """

    kind: str
    where: str
    what: str
    fix: str
    fixed: bool = False


@dataclass
class Audit:
    """Collects findings, notes and how much was read.

    Attributes:
        findings: what is wrong.
        notes: what is worth knowing and not a fault.
        files, bytes: how much was compared.
        hashed: bytes that were read.
    """

    findings: list[Finding] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    files: int = 0
    bytes: int = 0
    hashed: int = 0

    @property
    def sound(self) -> bool:
        """True when nothing wrong is left."""
        return all(finding.fixed for finding in self.findings)
