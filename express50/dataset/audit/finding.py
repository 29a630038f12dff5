"""What an audit finds."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Finding:
    """Something wrong.

    Attributes:
        kind: one word for programs, such as ``missing`` or ``changed``.
        what: ``stage item``, or a file of the dataset.
        why: what is wrong, in words.
        mend: how it was mended, or how to mend it.
        mended: whether it was.
    """

    kind: str
    what: str
    why: str
    mend: str
    mended: bool = False

    def line(self) -> str:
        """One line for people."""
        return f"{self.what}: {self.why}; {'MENDED' if self.mended else 'to mend'}: {self.mend}"
